// Faults of a laid-out page, sent to the frame around it: what stands beside the screen without
// scrolling, and text on text.
function scrolls(element) {
  for (let at = element.parentElement; at; at = at.parentElement) {
    const overflow = getComputedStyle(at).overflowX;
    const box = at.getBoundingClientRect();
    if ((overflow === "auto" || overflow === "scroll") && box.right <= innerWidth + 1) return true;
  }
  return false;
}

function lines() {
  const found = [];
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    const node = walk.currentNode;
    const hidden = ["SCRIPT", "STYLE"].includes(node.parentElement.tagName) || !node.parentElement.checkVisibility();
    if (hidden || !node.textContent.trim()) continue;
    const range = document.createRange();
    range.selectNodeContents(node);
    for (const box of range.getClientRects()) found.push({ node, box });
  }
  return found;
}

function faults() {
  const found = [];
  for (const element of document.body.querySelectorAll("*")) {
    const box = element.getBoundingClientRect();
    if (element.checkVisibility() && box.width && (box.right > innerWidth + 1 || box.left < -1) && !scrolls(element))
      found.push(`${element.tagName} ends at ${Math.round(box.right)} of ${innerWidth} px`);
  }
  const all = lines();
  for (const { node, box } of all)
    if (box.right > innerWidth + 1 && !scrolls(node.parentElement))
      found.push(`'${node.textContent.slice(0, 30)}' ends at ${Math.round(box.right)} of ${innerWidth} px`);
  all.sort((a, b) => a.box.top - b.box.top).forEach((a, k) => {
    for (let other = k + 1; other < all.length && all[other].box.top < a.box.bottom - 3; other++) {
      const b = all[other];
      const across = Math.min(a.box.right, b.box.right) - Math.max(a.box.left, b.box.left);
      const down = Math.min(a.box.bottom, b.box.bottom) - b.box.top;
      if (a.node !== b.node && across > 3 && down > 3)
        found.push(`'${a.node.textContent.slice(0, 30)}' under '${b.node.textContent.slice(0, 30)}'`);
    }
  });
  return found;
}

onload = () => {
  const found = faults();
  for (const each of document.querySelectorAll("details")) each.open = true;
  parent.postMessage([...found, ...faults()].slice(0, 20).map(fault => `${innerWidth} px: ${fault}`), "*");
};
