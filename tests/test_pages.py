"""The pages that a newcomer copies from: every block of Python on them runs, top to bottom."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = (
    "README.md",
    "docs/chain.md",
    "docs/diffraction.md",
    "docs/your_own.md",
    "docs/mounts.md",
    "docs/placement.md",
    "docs/worlds.md",
    "docs/robots_and_worlds.md",
)


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
