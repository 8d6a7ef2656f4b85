"""Motion of what only one of two frames shows: that of seen pixels nearby which look alike, and not that of
what hides it."""

import torch

DOUBTED = 0.5  # visibility below which the flow of a pixel is replaced
SAMPLES = 4  # on each side: a neighbourhood is looked at in 9 x 9 places
REACH = 1.5  # times the largest difference of motion: a hidden strip is at most as wide as that
ALIKE = 0.15  # log units
NEAR = 0.3  # share of the reach: standard deviation of the weight by distance
WORKED_ON = 1 << 14  # pixels at a time


@torch.no_grad()
def repaired(levels, flows, seen):
    """Flow with the values of doubted pixels replaced.

    Args:
      levels: [2, H, W] log levels of both frames. flows: [2, 2, H, W] both ways. seen: [2, H, W] visibility
        of either frame in the other.
    Returns: [2, 2, H, W]: in doubted pixels the median of the flow over seen pixels around, weighted by
      visibility, likeness and nearness.
    Source: weighted median of Sun, Roth and Black, Secrets of optical flow estimation and their principles,
      CVPR 2010, section 5.
    """
    height, width = levels.shape[-2:]
    spread_px = float((flows.amax((2, 3)) - flows.amin((2, 3))).max())
    spacing = max(1.0, REACH * spread_px / SAMPLES)
    steps = (torch.arange(-SAMPLES, SAMPLES + 1, device=levels.device) * spacing).round().long()
    dy, dx = (step.flatten() for step in torch.meshgrid(steps, steps, indexing="ij"))
    near = torch.exp(-(dx.square() + dy.square()) / (2 * (NEAR * SAMPLES * spacing) ** 2))
    flows = flows.clone()
    for flow, level, weight, mask in zip(flows, levels, seen, seen < DOUBTED, strict=True):
        old = flow.clone()
        for y, x in zip(*(place.split(WORKED_ON) for place in mask.nonzero().T), strict=True):
            row = y[:, None] + dy
            column = x[:, None] + dx
            within = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            at = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
            unlike = (level.flatten()[at] - level[y, x][:, None]).abs()
            vote = within * near * torch.exp(-unlike / ALIKE) * (weight * (weight >= DOUBTED)).flatten()[at]
            found = vote.sum(1) > 0
            for component in range(2):
                flow[component, y, x] = torch.where(
                    found, _weighted_median(old[component].flatten()[at], vote), old[component, y, x]
                )
    return flows


def _weighted_median(values, weights):
    """Weighted median along the last axis, [N, K] each."""
    ordered, index = values.sort(1)
    below = weights.gather(1, index).cumsum(1)
    middle = torch.searchsorted(below, below[:, -1:] / 2).clamp(max=values.shape[1] - 1)
    return ordered.gather(1, middle)[:, 0]
