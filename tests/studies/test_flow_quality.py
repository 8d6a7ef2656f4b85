"""Figures of the study of the refiner's quality, against numbers worked out by hand; and its quick form from
the command line."""

import json

import numpy as np
import pytest

from codesign.flow.checkpoint import DELIVERED
from studies import flow_quality
from studies.frame.run import main, open_run


def test_figures_of_a_set(tmp_path):
    """Two windows: zero flow 2 and 4 px, closed form 1 and 5 px, refiner 0.5 and 1 px with squared errors
    0.25 and 4 times the claim."""
    run = open_run("flow_quality", flow_quality.Config(out=tmp_path))
    row = flow_quality._row(run, "set", np.array([[2.0, 1.0, 0.5, 0.25], [4.0, 5.0, 1.0, 4.0]]))
    assert run.metrics["set_closed_form_ratio"] == pytest.approx(1.0)
    assert run.metrics["set_refiner_ratio"] == pytest.approx(0.25)
    assert run.metrics["set_refiner_over_closed_form"] == pytest.approx(0.25)
    assert run.metrics["set_closed_form_worse_percent"] == 50.0
    assert run.metrics["set_refiner_worse_percent"] == 0.0
    assert run.metrics["set_error_over_claimed"] == pytest.approx(2.125**0.5)
    assert run.metrics["set_refiner_ratio_low"] == pytest.approx(
        0.25
    )  # the ratio is 0.25 in both windows, so in every draw
    assert run.metrics["set_refiner_ratio_high"] == pytest.approx(0.25)
    assert row[0] == "set"


@pytest.mark.skipif(not DELIVERED["refiner"].exists(), reason="no trained refiner in this checkout")
def test_quick_form(tmp_path):
    """The delivered refiner beats zero flow on fine textures and in the worlds by far: a broken file or a
    wrong convention would not."""
    assert main(flow_quality.study, flow_quality.Config, ["--quick", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "metrics.json").read_text(encoding="utf-8"))
    assert found["fine_theta_0.1_refiner_ratio"] < 0.2
    assert found["worlds_refiner_ratio"] < 0.8
    assert found["worlds_windows"] == 5
    assert (tmp_path / "report.html").exists()


def test_too_few_windows_are_refused(tmp_path, capsys):
    assert main(flow_quality.study, flow_quality.Config, ["--windows", "1", "--out", str(tmp_path)]) == 2
    assert "at least 2 are needed" in capsys.readouterr().err
