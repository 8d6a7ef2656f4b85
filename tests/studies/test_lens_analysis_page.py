"""The examples of docs/lens_analysis.md run as they stand, in one go, and every function the page
names exists."""

import re

import matplotlib.pyplot as plt

from codesign.lens import analysis, paraxial, seidel
from tests.processes import ROOT

PAGE = (ROOT / "docs" / "lens_analysis.md").read_text(encoding="utf-8")


def test_the_examples_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    assert len(blocks) == 6
    names = {}
    exec("\n".join(blocks), names)
    assert float(names["front"].weight.sum()) == names["front"].pupil.shape[0]
    assert names["psf"].energy.shape == (64, 64)
    assert names["geo"].curvature_per_mm.grad.abs().min() > 0
    assert (tmp_path / "layout.svg").read_bytes().startswith(b"<?xml")
    plt.close("all")


def test_the_page_names_every_function():
    missing = [name for name in analysis.__all__ if name[0].islower() and name not in PAGE]
    # what the others are made of
    assert missing == ["chief_height_mm", "chief_ray", "field_rays", "pupil_grid", "spectral_lines"]
    named = re.findall(r"`(paraxial|seidel)\.(\w+)\(", PAGE)
    assert named
    rooms = {"paraxial": paraxial, "seidel": seidel}
    assert all(hasattr(rooms[module], function) for module, function in named)
