"""The main job with other event layers and estimators: what goes together, and a run that is resumed after its end."""

import json

import pytest
import torch

from codesign import events, flow
from codesign.errors import DomainError
from studies.frame.config import configured
from studies.frame.run import main
from studies.lens_opt import __main__ as lens_opt
from studies.lens_opt.stages import estimator, weights_of

SMALL = ["--quick", "--steps", "2", "--cases", "1", "--scored", "1", "--judged", "1"]


@pytest.mark.parametrize(
    ("name", "train", "objective", "sentence"),
    [
        ("closed-form", True, "flow", "has no weights, so there is nothing to train"),
        ("flownet", False, "flow", "random weights, whose flow means nothing; add --train-network"),
        ("refiner", True, "edge", "looks at event frames only"),
        ("nothing.safetensors", False, "flow", "neither a network file nor one of closed-form, refiner"),
    ],
)
def test_what_makes_no_sense_is_refused_with_the_reason(name, train, objective, sentence):
    with pytest.raises(DomainError, match=sentence):
        estimator(name, train, objective, 10_000, 0)


def test_networks_come_trained_or_to_be_trained():
    assert estimator("closed-form", False, "flow", 1, 0) is flow.estimate_lk
    assert weights_of(flow.estimate_lk) == []
    assert weights_of(estimator("refiner", False, "flow", 1, 0)) == []
    trained = weights_of(estimator("spiking", True, "flow", 30_000, 0))
    assert 30_000 <= sum(p.numel() for p in trained) < 60_000


@pytest.mark.parametrize("layer", ["sigmoid", "srm", "physical"])
def test_every_event_layer_hands_the_lens_a_gradient(layer):
    options = configured(lens_opt.Config, True, events=layer, cases=1, scored=1)
    job = lens_opt.prepare(options)
    (slope,) = torch.autograd.grad(job.system(job.probe).loss, job.camera.variables)
    assert int((slope != 0).sum()) == slope.numel()
    assert layer in events.LAYERS


def test_a_run_resumed_after_its_last_step_ends_with_the_same_figures(tmp_path, capsys):
    folder = tmp_path / "a run"
    assert main(lens_opt.study, lens_opt.Config, [*SMALL, "--out", str(folder)]) == 0
    first = json.loads((folder / "metrics.json").read_text())
    (folder / "report.html").unlink()
    assert main(lens_opt.study, lens_opt.Config, ["--resume", str(folder)]) == 0
    again = json.loads((folder / "metrics.json").read_text())
    assert (folder / "report.html").exists()
    for name in ("flow_error_mrad_hard_optimised", "rms_spot_um_optimised", "steps", "seconds_per_step"):
        assert again[name] == pytest.approx(first[name], rel=1e-6)


def test_sizes_below_one_are_refused(tmp_path, capsys):
    assert main(lens_opt.study, lens_opt.Config, ["--steps", "0", "--out", str(tmp_path / "x")]) == 2
    assert "--steps is 0; at least 1 is needed" in capsys.readouterr().err
