"""Pages as a browser shows them, wide and on a phone: nothing on the console, nothing beside the
screen but what scrolls, no text on text."""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from codesign.report import page, prose
from studies.flow_recording import __main__ as flow_recording
from studies.frame.run import main
from studies.placement import __main__ as placement

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no chromium is installed")
WIDTHS_PX = (1280, 390)
MEASURE = (Path(__file__).parent / "browser_faults.js").read_text(encoding="utf-8")


def faults(report: Path, width_px: int, folder: Path) -> list[str]:
    """What the browser finds wrong with a page in a frame of that width, as it opens and with all that
    unfolds unfolded; and what it writes to its console."""
    inside, outside = folder / "inside.html", folder / "outside.html"
    text = report.read_text(encoding="utf-8")
    inside.write_text(
        text.replace("</body>", f"<script>{MEASURE}</script></body>"), encoding="utf-8"
    )
    outside.write_text(
        f"<iframe src='inside.html' style='border:0;width:{width_px}px;height:900px'></iframe><p id='found'></p>"
        "<script>onmessage = said => { document.getElementById('found').textContent = said.data; };</script>",
        encoding="utf-8",
    )
    flags = (
        "--headless --no-sandbox --disable-gpu --enable-logging=stderr --virtual-time-budget=20000"
    )
    size = f"--window-size={width_px + 100},1000"
    command = [BROWSER, *flags.split(), size, f"--user-data-dir={folder / 'profile'}", "--dump-dom"]
    shown = subprocess.run(
        [*command, outside.as_uri()], capture_output=True, text=True, timeout=100
    )
    found = re.search(r"<p id=\"found\">(.+?)</p>", shown.stdout, flags=re.S)
    assert found is not None, shown.stderr[-2000:]
    said = [line for line in shown.stderr.splitlines() if "CONSOLE" in line]
    return [*json.loads(html.unescape(found[1])), *said]


def worst_page(folder: Path, wide: str = "") -> Path:
    """A page of what is hard to lay out: long words, many cards, a wide figure, a table of many
    columns."""
    figure = Figure(figsize=(12, 3))
    figure.subplots().plot(np.arange(9))
    figure.savefig(folder / "wide.png", dpi=160)
    rows = [[f"case {k}", *(k * 10.0**power for power in range(-6, 8))] for k in range(12)]
    section = page.Section("Of_everything_that_is_" + "long_" * 12)
    section.blocks += [
        ("prose", prose.to_html("A path: `" + "/folder" * 30 + "`. And *a word*" + " more" * 80)),
        ("picture", page.picture(folder / "wide.png", "Nine numbers, in order.")),
        (
            "table",
            page.table("Wide", ["case", *("quantity " * 2 for _ in range(14))], rows, "Said " * 60),
        ),
    ]
    cards = [
        page.Card("A figure of some length", f"{10**k:,} events", "a note " * k) for k in range(9)
    ]
    facts = {"Configuration": {"path": "/long" * 60, "a_name_that_is_long_" * 4: 1}}
    report = folder / "report.html"
    text = page.render_page(
        "A title that is quite long for a phone", "Lead. " * 30, cards, [section], facts
    )
    report.write_text(text.replace("</main>", f"{wide}</main>"), encoding="utf-8")
    return report


@pytest.mark.parametrize("width_px", WIDTHS_PX)
def test_the_worst_page(width_px, tmp_path):
    assert faults(worst_page(tmp_path), width_px, tmp_path) == []


def test_faults_are_seen(tmp_path):
    """A box of 2000 px, text on text, and a call that fails."""
    wrong = (
        "<div style='width:2000px'>wide</div><p style='margin:0'>one text</p><p style='margin:-1.4em 0 0'>on another</p>"
        "<script>console.log('said')</script>"
    )
    found = " ".join(faults(worst_page(tmp_path, wrong), 390, tmp_path))
    assert "DIV ends at 20" in found
    assert "'one text' under 'on another'" in found
    assert "CONSOLE" in found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "given"),
    [(placement, ["--look"]), (flow_recording, [])],
    ids=["placement", "flow_recording"],
)
def test_pages_of_studies(module, given, tmp_path):
    out = tmp_path / "run"
    assert main(module.study, module.Config, [*given, "--quick", "--out", str(out)]) == 0
    assert (out / "report.html").stat().st_size < 2e6
    for width_px in WIDTHS_PX:
        assert faults(out / "report.html", width_px, tmp_path) == []
