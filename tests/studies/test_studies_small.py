"""The small studies: what they compare with what, and how they choose."""

import pytest
import torch

from codesign.errors import DomainError
from studies.speed_error import chain, events
from studies.speed_error.levels import cheapest
from studies.stability.systems import (
    KINDS,
    differences,
    draw_system,
    errors_of_systems,
    worst_error,
)

LEVELS = [
    {"level": "pinhole", "cpu_s": 1.0, "error": 0.2},
    {"level": "thin", "cpu_s": 3.0, "error": 0.05},
    {"level": "quick and good", "cpu_s": 2.0, "error": 0.04},
    {"level": "traced", "cpu_s": 9.0, "error": 0.0},
]


@pytest.mark.parametrize(
    ("tolerance", "name"),
    [
        (0.5, "pinhole"),
        (0.2, "pinhole"),
        (0.1, "quick and good"),
        (0.04, "quick and good"),
        (0.01, "traced"),
        (0.0, "traced"),
    ],
)
def test_the_cheapest_level_within_the_tolerance_is_chosen(tolerance, name):
    best, enough = cheapest(LEVELS, tolerance)
    assert (best["level"], enough) == (name, True)


def test_where_none_is_good_enough_the_best_is_named_as_such():
    best, enough = cheapest(LEVELS[:3], 0.01)
    assert (best["level"], enough) == ("quick and good", False)
    with pytest.raises(DomainError, match="no level"):
        cheapest([], 0.1)


def test_gradients_of_random_lenses_with_coincidences_agree_with_differences():
    """Equal neighbours, flats, concentric surfaces, zeros: what has no effect today has a
    derivative."""
    errors = errors_of_systems(100, torch.Generator().manual_seed(1), alone_every=60)
    assert max(errors.values()) <= 1e-6


def test_the_differences_see_a_wrong_gradient():
    """Every kind's gradient moves the scalar: one that is left out, as the index of equal
    neighbours once was, is an error of 1."""
    system = draw_system(torch.Generator().manual_seed(2), "geaso")
    truth = differences(system) | {"glass": system.lens.glass.numpy()}
    for name in KINDS:
        if truth[name].size:
            assert worst_error({name: 0 * truth[name]}, truth)[name] == pytest.approx(1, rel=1e-12)


def test_the_convolution_of_the_bench_is_the_layer_up_to_its_cut_kernel():
    """77 taps leave out 1 % of the response; where the drive stays below threshold it is the
    potential's size."""
    assert len(events.taps(events.TAU_S, 1.0)) == 77
    drive = 0.9 * torch.rand(40, 1, 4, 4, generator=torch.Generator().manual_seed(0))
    agree = (events.convolution(drive) == events.ours(drive)).double().mean()
    assert float(events.ours(drive).sum()) > 50
    assert float(agree) > 0.97


def test_the_stages_of_a_placement_make_up_its_step_and_gradients_arrive_everywhere():
    system, batch, pair = chain.case_of("ground", 0, worlds_of=1, drives=1)
    found = chain.one_step(system, batch, pair)
    stages = [found[name] for name in chain.PARTS.values()]
    # the loss itself and the sum of gradients into mount and lens are in the step only
    assert 0.9 * found["step"] < sum(stages) <= found["step"] + 1e-6
    assert min(stages) > 0
    assert found["forward"] < found["step"]
    asking = {name: p for name, p in system.named_parameters() if p.requires_grad}
    assert {name.split(".")[0] for name in asking} == {"lens", "mount", "events"}
    assert all(
        p.grad is not None and 0 < float(p.grad.abs().max()) < torch.inf for p in asking.values()
    )
