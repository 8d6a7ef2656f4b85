"""The cost of a step is that of a whole one: every stage is counted, and all that is to be designed gets a
gradient."""

import torch

from studies import placement_step
from studies.frame.run import main


def test_stages_make_up_the_step_and_gradients_arrive_everywhere():
    system, batch, pair = placement_step.ground_case(placement_step.Config(worlds=1, drives=1))
    found = placement_step.one_step(system, batch, pair)
    stages = [found[name] for name in placement_step.NAMES.values()]
    # the loss itself and the sum of gradients into mount and lens are in the step only
    assert 0.9 * found["step"] < sum(stages) <= found["step"] + 1e-6
    assert min(stages) > 0
    assert found["forward"] < found["step"]
    asking = {name: p.grad for name, p in system.named_parameters() if p.requires_grad}
    assert {name.split(".")[0] for name in asking} == {"lens", "mount", "events"}
    assert all(bool(torch.isfinite(grad).all()) and float(grad.abs().max()) > 0 for grad in asking.values())


def test_sizes_are_checked(tmp_path, capsys):
    arguments = ["--repeats", "1", "--out", str(tmp_path / "run")]
    assert main(placement_step.study, placement_step.Config, arguments) != 0
    assert "two repeats" in capsys.readouterr().err
