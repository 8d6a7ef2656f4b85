"""The pages that a newcomer copies from: every block of Python on them runs, top to bottom."""

import re

import pytest

from studies.frame.listing import studies
from tests.processes import ROOT, python

GUIDES = """
start chain select diffraction your_own mounts placement worlds robots_and_worlds flow_needs lens_files
lens_design flow events flow_closed_form srm silhouettes flow_metrics flow_recordings flow_training
event_files event_views sensor_fit upsampling run_many
"""
PAGES = ("README.md", *(f"docs/{name}.md" for name in GUIDES.split()))


@pytest.mark.parametrize("page", PAGES)
def test_blocks_of_a_page_run_in_one_session(page, tmp_path, monkeypatch, capsys):
    blocks = re.findall(
        r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), flags=re.S
    )
    assert blocks
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "page"}
    for block in blocks:
        exec(compile(block, page, "exec"), names)


def test_the_readme_is_short_and_names_every_study():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert text.count("\n") <= 100
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    cells = [re.sub(r"\]\([^)]*\)", "]", cell) for row in rows for cell in row.split("|")]
    assert max(len(cell.split()) for cell in cells) <= 20
    named = set(re.findall(r"`(\w+)", text[text.index("## Studies") : text.index("## Limits")]))
    assert set(studies()) <= named


def test_the_site_builds_without_a_warning(tmp_path):
    """Every link and anchor of the pages leads somewhere, every page has its place, the API reads."""
    pytest.importorskip("mkdocs", reason="the site needs codesign[docs]")
    # with --quiet there is no warning that --strict could refuse
    site = str(tmp_path / "site")
    built = python("-m", "mkdocs", "build", "--strict", "-d", site, NO_MKDOCS_2_WARNING="1")
    assert built.returncode == 0, built.stdout + built.stderr
    page = (tmp_path / "site/api/events/index.html").read_text(encoding="utf-8")
    assert 'id="codesign.events.simulate"' in page
    assert '<span class="gp">&gt;&gt;&gt; </span>' in page  # doctests are code
    assert (tmp_path / "site/search/search_index.json").stat().st_size > 100_000
