"""A page as chromium shows it, wide and on a phone: nothing on the console, nothing beside the
screen but what scrolls, no text on text."""

import html
import json
import re
import shutil
import subprocess
import tempfile
import warnings
from pathlib import Path

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
WIDTHS_PX = (1280, 390)
LARGEST_BYTES = 2_000_000
MEASURE = (Path(__file__).parent / "browser_faults.js").read_text(encoding="utf-8")
GATHER = """<p id='found'></p><script>const said = [];
onmessage = from => {
  said.push(from.data);
  if (said.length == WIDTHS) document.getElementById('found').textContent = JSON.stringify(said.flat());
};</script>"""


def check_page(study: str, folder: Path) -> None:
    """The page of a run of ``study`` is whole in one small file, and a browser finds no fault with
    it; where there is no browser, a warning says that its size alone was looked at.

    A test that runs a study calls this with the study's name as a literal, which test_browser looks
    for.
    """
    assert json.loads((folder / "config.json").read_text())["study"] == study
    assert (folder / "report.html").stat().st_size < LARGEST_BYTES
    if BROWSER is None:
        warnings.warn(f"no chromium: the page of {study} was not looked at", stacklevel=2)
    else:
        assert faults(folder / "report.html") == []


def faults(report: Path) -> list[str]:
    """What the browser finds wrong with a page in frames of both widths, as it opens and with all
    that unfolds unfolded; and what it writes to its console."""
    text = report.read_text(encoding="utf-8")
    frames = [
        f"<iframe src='inside.html' style='border:0;width:{width_px}px;height:900px'></iframe>"
        for width_px in WIDTHS_PX
    ]
    flags = (
        "--headless --no-sandbox --disable-gpu --enable-logging=stderr --virtual-time-budget=20000"
    )
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        folder = Path(name)
        outside, inside = folder / "outside.html", folder / "inside.html"
        measured = text.replace("</body>", f"<script>{MEASURE}</script></body>")
        inside.write_text(measured, encoding="utf-8")
        # messages come when the page around is read: what gathers them stands first
        gather = GATHER.replace("WIDTHS", str(len(WIDTHS_PX)))
        outside.write_text(gather + "".join(frames), encoding="utf-8")
        size = f"--window-size={max(WIDTHS_PX) + 100},2000"
        command = [BROWSER, *flags.split(), size, f"--user-data-dir={folder / 'profile'}"]
        shown = subprocess.run(
            [*command, "--dump-dom", outside.as_uri()], capture_output=True, text=True, timeout=100
        )
    found = re.search(r"<p id=\"found\">(.+?)</p>", shown.stdout, flags=re.S)
    assert found is not None, shown.stderr[-2000:]
    said = [line for line in shown.stderr.splitlines() if "CONSOLE" in line]
    return [*json.loads(html.unescape(found[1])), *said]
