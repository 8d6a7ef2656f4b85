"""The examples in docstrings run, and give what they say."""

import doctest
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "codesign").rglob("*.py")
    if ">>> " in path.read_text()
)
FIRST_MET = {  # modules whose examples a user meets first
    "codesign.events.files",
    "codesign.events.layers.comparators",
    "codesign.events.level_path",
    "codesign.events.layers.memory",
    "codesign.events.layers.soft",
    "codesign.events.sensor.model",
    "codesign.events.sensor.simulate",
    "codesign.events.spiking.srm",
    "codesign.events.volumes.volume",
    "codesign.flow.baselines.flownet_events",
    "codesign.flow.baselines.spike_flownet",
    "codesign.flow.checkpoint",
    "codesign.flow.export",
    "codesign.flow.files",
    "codesign.flow.lk.estimate",
    "codesign.flow.losses",
    "codesign.flow.metrics",
    "codesign.flow.refiner",
    "codesign.grad.jacobian",
    "codesign.lens.analysis.spots",
    "codesign.lens.solves",
    "codesign.lens.files.load",
    "codesign.lens.geolens",
    "codesign.lens.glass",
    "codesign.lens.spectrum",
    "codesign.lens.surface",
    "codesign.optimise.least_squares",
    "codesign.mount.body",
    "codesign.mount.pose",
    "codesign.mount.observability",
    "codesign.mount.starts",
    "codesign.pose",
    "codesign.render.camera",
    "codesign.render.sequence",
    "codesign.render.truth",
}


def test_what_a_user_meets_first_has_an_example():
    assert set(MODULES) >= FIRST_MET


@pytest.mark.parametrize("name", MODULES)
def test_examples_give_what_they_say(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # examples may write files
    found = doctest.testmod(importlib.import_module(name))
    assert found.attempted > 0
    assert found.failed == 0
