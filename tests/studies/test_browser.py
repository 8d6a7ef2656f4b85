"""The page of every study as a browser shows it, and the faults that a browser would find."""

import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from codesign import events
from codesign.report import page, prose
from studies.frame.listing import studies
from studies.stability import __main__ as stability
from tests.studies import browser
from tests.studies.browser import BROWSER, WIDTHS_PX, check_page, faults
from tests.studies.runs import module_of, ran

TESTS = Path(__file__).parents[1]
# studies that no other test runs to their page
ALONE = {
    "chain_picture": "--width-px 64 --height-px 48 --samples 2",
    "hero": "--quick --tolerance 1",
    "lens_tolerance": "--trials 3",
    "speed_error": "--quick --stages growth",
    "spike_esim": "--quick --frames 40 --steps 4",
    "stability": "",
    "viewer": "--quick",
}
WITH_BROWSER = pytest.mark.skipif(BROWSER is None, reason="no chromium is installed")


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


@WITH_BROWSER
def test_the_worst_page(tmp_path):
    assert faults(worst_page(tmp_path)) == []


@WITH_BROWSER
def test_faults_are_seen(tmp_path):
    """A box of 2000 px, text on text, and a call that fails."""
    wrong = (
        "<div style='width:2000px'>wide</div><p style='margin:0'>one text</p><p style='margin:-1.4em 0 0'>on another</p>"
        "<script>console.log('said')</script>"
    )
    found = " ".join(faults(worst_page(tmp_path, wrong)))
    for width_px in WIDTHS_PX:
        assert f"{width_px} px: DIV ends at 2" in found
        assert f"{width_px} px: 'one text' under 'on another'" in found
    assert "CONSOLE" in found


@WITH_BROWSER
def test_a_video_plays_by_itself(tmp_path):
    black = np.zeros((20, 32, 32), dtype=np.uint8)
    events.write_video(tmp_path / "loop.mp4", black, fps=10)
    section = page.Section("Loop", [("picture", page.picture(tmp_path / "loop.mp4", "Black."))])
    ask = "console.log(`still: ${document.querySelector('video').paused}`)"
    text = page.render_page("Loop", "", [], [section], {}).replace(
        "</main>", f"<script>setTimeout(() => {ask}, 2000)</script></main>"
    )
    (tmp_path / "report.html").write_text(text, encoding="utf-8")
    found = " ".join(faults(tmp_path / "report.html"))
    assert "still: false" in found
    assert "still: true" not in found


def test_the_page_of_every_study_is_looked_at():
    said = "".join(path.read_text(encoding="utf-8") for path in TESTS.rglob("test_*.py"))
    looked_at = set(re.findall(r'check_page\("(\w+)"', said))
    assert sorted([*looked_at, *ALONE]) == list(studies())


def test_a_page_that_no_browser_saw_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(browser, "BROWSER", None)
    (tmp_path / "config.json").write_text('{"study": "lens_opt"}')
    (tmp_path / "report.html").write_text("<p>")
    with pytest.warns(UserWarning, match="no chromium: the page of lens_opt"):
        browser.check_page("lens_opt", tmp_path)


def uncounted(case, tries, seed):
    """Rows of a case of `studies.stability`, whose page is asked for and not its minutes."""
    row = {"stage": case.stage, "expected": "0.123", "seen": "0.125", "off": 2e-3, "allowed": 1e-3}
    return [{**row, "kind": kind, "passed": kind != "value"} for kind in case.kinds]


@pytest.mark.slow
@pytest.mark.parametrize("name", ALONE)
def test_pages_of_studies_that_no_other_test_runs(name, tmp_path, monkeypatch):
    monkeypatch.setattr(stability, "cells", uncounted)
    out = tmp_path / "run"
    assert ran(module_of(name), f"{ALONE[name]} --out", out) == 0
    check_page(name, out)
