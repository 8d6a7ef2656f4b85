"""The small studies: what they compare with what, and how they choose."""

import pytest
import torch

from codesign.errors import DomainError
from studies.frame.timing import measure
from studies.speed_error import __main__ as speed_error
from studies.speed_error.__main__ import Measured, cheapest
from studies.stability import __main__ as stability
from studies.stability.systems import KINDS, differences, draw_system, errors_of_systems, worst_error

LEVELS = [
    Measured("pinhole", 1.0, 1.0, 0.2),
    Measured("thin", 3.0, 1.0, 0.05),
    Measured("quick and good", 2.0, 9.0, 0.04),
    Measured("traced", 9.0, 5.0, 0.0),
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
    assert (best.name, enough) == (name, True)


def test_where_none_is_good_enough_the_best_is_named_as_such():
    best, enough = cheapest(LEVELS[:3], 0.01)
    assert (best.name, enough) == ("quick and good", False)
    with pytest.raises(DomainError, match="no level"):
        cheapest([], 0.1)


def test_gradients_of_random_lenses_with_coincidences_agree_with_differences():
    """Equal neighbours, flats, concentric surfaces, zeros: what has no effect today has a derivative."""
    errors = errors_of_systems(100, torch.Generator().manual_seed(1), alone_every=60)
    assert max(errors.values()) <= 1e-6


def test_the_differences_see_a_wrong_gradient():
    """Every kind's gradient moves the scalar: one that is left out, as the index of equal neighbours once was,
    is an error of 1."""
    system = draw_system(torch.Generator().manual_seed(2), "geaso")
    truth = differences(system) | {"glass": system.lens.glass.numpy()}
    for name in KINDS:
        if truth[name].size:
            assert worst_error({name: 0 * truth[name]}, truth)[name] == pytest.approx(1, rel=1e-12)


@pytest.mark.parametrize("name", stability.CASES)
def test_a_hard_case_ends_as_theory_says(name):
    outcome = stability.CASES[name]()
    assert outcome.passed, f"expected {outcome.expected}; seen {outcome.seen}"


def test_a_case_that_stops_is_a_miss_with_its_sentence():
    def refuses():
        raise DomainError("the lens is upside down")

    outcome = stability.judge(refuses)
    assert not outcome.passed
    assert "upside down" in outcome.seen


def test_times_count_the_repeats_only():
    calls = []
    timing = measure(lambda: calls.append(1), repeats=5, warm=2)
    assert (len(calls), len(timing.wall_s), len(timing.cpu_s)) == (7, 5, 5)
    assert min(timing.wall_s) <= timing.wall <= max(timing.wall_s)
    assert timing.wall_iqr >= 0


def test_speed_error_metric_names_are_plain():
    assert speed_error._metric("flow_affine, 2 levels") == "flow_affine_2_levels"
