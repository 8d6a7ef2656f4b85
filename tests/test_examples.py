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
    f"codesign.{room}.{name}"
    for room, names in {
        "events": "files level_path sensor.model sensor.simulate spiking.srm volumes.volume",
        "events.layers": "comparators memory soft",
        "flow": "checkpoint export files losses metrics refiner lk.estimate",
        "flow.baselines": "flownet_events spike_flownet",
        "grad": "jacobian",
        "lens": "solves geolens glass spectrum surface analysis.spots files.load",
        "optimise": "least_squares",
        "mount": "body pose observability starts",
        "render": "camera sequence truth",
    }.items()
    for name in names.split()
} | {"codesign.pose"}


def test_what_a_user_meets_first_has_an_example():
    assert set(MODULES) >= FIRST_MET


@pytest.mark.parametrize("name", MODULES)
def test_examples_give_what_they_say(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # examples may write files
    found = doctest.testmod(importlib.import_module(name))
    assert found.attempted > 0
    assert found.failed == 0
