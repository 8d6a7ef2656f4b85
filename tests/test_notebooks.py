"""The notebooks run from their first cell to their last, as somebody without a checkout reads them."""

import json
import re

import pytest

from codesign import backend
from codesign.errors import BackendError
from tests.processes import ROOT, python

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
MOST_CELLS = 12


def cells(path, kind):
    """Sources of the cells of a kind, "code" or "markdown"."""
    found = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in found if cell["cell_type"] == kind]


def run(path, folder, **environment):
    """All code cells in one fresh process, as a notebook without its pictures."""
    (folder / "cells.py").write_text("\n".join(cells(path, "code")), encoding="utf-8")
    return python("cells.py", cwd=folder, PYTHONPATH=str(ROOT), **environment)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_short_draws_and_stores_no_output(path):
    stored = json.loads(path.read_text(encoding="utf-8"))
    assert stored["nbformat"] == 4
    assert len(stored["cells"]) <= MOST_CELLS
    assert not any(cell.get("outputs") for cell in stored["cells"])
    assert "codesign.show(" in "".join(cells(path, "code"))
    assert f"notebooks/{path.name}" in (ROOT / "docs/notebooks.md").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_cells_of_a_notebook_run(path, tmp_path):
    try:
        backend.require_renderer()
    except BackendError as error:
        pytest.skip(f"nothing is rendered here: {error}")
    done = run(path, tmp_path)
    assert done.returncode == 0, done.stderr
    if path.stem == "lens_for_events":
        found = re.findall(r"([\d.]+) px (?:before|after)|refocused ([\d.]+) px", done.stdout)
        before_px, after_px, focused_px = (float(one or other) for one, other in found)
        assert after_px < (before_px + focused_px) / 2, "nearer to the lens that geometry focuses"


def test_without_llvm_a_notebook_ends_in_one_sentence(tmp_path):
    done = run(ROOT / "notebooks/lens_for_events.ipynb", tmp_path, DRJIT_LIBLLVM_PATH="/absent.so")
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("codesign.errors.BackendError: no usable LLVM library was found")
