"""The small studies: what they compare with what, and how they choose."""

import pytest
import torch

from codesign.errors import DomainError
from studies.frame.bench import Timing
from studies.speed_error import chain, events, lens

# level -> processor seconds of five turns, and its error
TURNS = {
    "pinhole": ((8.7, 8.2, 9.4, 8.1, 8.8), 0.02),
    "thin": ((8.3, 8.6, 8.2, 8.5, 8.4), 0.01),
    "traced": ((17.0, 16.0, 18.0, 17.5, 16.5), 0.0),
    "coarse": ((1.0, 1.0, 1.0, 1.0, 1.0), 0.2),
}


@pytest.mark.parametrize(
    ("tolerance", "expected"),
    [
        (0.5, ["dearer", "dearer", "dearer", "cheapest"]),
        (0.05, ["undecided", "undecided", "dearer", "not tolerated"]),
        (0.01, ["not tolerated", "cheapest", "dearer", "not tolerated"]),
    ],
)
def test_levels_whose_times_differ_from_turn_to_turn_are_undecided(tolerance, expected):
    """The pinhole is the quicker in two of five turns; the traced lens takes twice as long in
    each."""
    timed = {name: Timing(cpu_s, cpu_s) for name, (cpu_s, _) in TURNS.items()}
    errors = {name: error for name, (_, error) in TURNS.items()}
    rows = chain.verdicts(timed, errors, tolerance)
    assert [row["verdict"] for row in rows] == expected


def test_without_a_peer_the_first_line_is_of_the_quickest_trace():
    cases = [("float32", 131.2, 1.4e-5), ("float64", 70.0, 3e-14)]
    names = ("precision", "million_ray_surfaces_per_s", "error_mm")
    said = lens.alone([dict(zip(names, case, strict=True)) for case in cases])
    assert said.startswith(
        "Rays meet 131 million surfaces a second, 1.4e-05 mm off at most (float32)"
    )


def test_where_none_is_good_enough_all_are_told_so():
    timed = {"thin": Timing((1.0, 1.0), (1.0, 1.0))}
    (row,) = chain.verdicts(timed, {"thin": 0.1}, 0.01)
    assert row["verdict"] == "not tolerated"
    with pytest.raises(DomainError, match="no level"):
        chain.verdicts({}, {}, 0.1)


def test_the_convolution_of_the_bench_is_the_layer_up_to_its_cut_kernel():
    """77 taps leave out 1 % of the response; where the drive stays below threshold it is the
    potential's size."""
    assert len(events.taps(events.TAU_S, 1.0)) == 77
    drive = 0.9 * torch.rand(40, 1, 4, 4, generator=torch.Generator().manual_seed(0))
    agree = (events.convolution(drive) == events.ours(drive)).double().mean()
    assert float(events.ours(drive).sum()) > 50
    assert float(agree) > 0.97


@pytest.mark.parametrize(
    ("seconds", "within"),
    [
        (
            (4.0, 1.0, 0.5, 0.1),
            ("4.00 times as fast as the finest (b)", "8.00 times as fast as the finest (c)"),
        ),
        ((0.4, 1.0, 0.3, 0.1), ("the finest itself", "1.33 times as fast as the finest (c)")),
    ],
)
def test_the_first_line_names_the_cheapest_chain_within_1_and_10_percent(seconds, within):
    cases = zip("abcd", seconds, (0.0, 0.01, 0.09, 0.11), strict=True)
    finest, *coarser = (
        {"levels": name, "cpu_s": cpu_s, "share": share, "faster": f"{seconds[0] / cpu_s:.2f}"}
        for name, cpu_s, share in cases
    )
    assert chain.headline([*coarser, finest]) == (
        f"Held against the finest chain, within 1 % of its flow the cheapest is {within[0]}; "
        f"within 10 % of its flow the cheapest is {within[1]}."
    )
