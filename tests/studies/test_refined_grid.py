"""The refined grid that searches are measured by: where its cubes lie, and that luck does not move them."""

import math

import pytest
import torch

from codesign.errors import DomainError, NonFiniteError
from studies.placement.grid import FINALISTS, looks, refined_grid

D = torch.float64
MINIMUM = torch.tensor([0.3, 0.62, 0.71, 0.9], dtype=D)
STAGES = ((0, 128, 1 / 2), (128, 153, 1 / 6), (153, 178, 1 / 18))


def coupled(share):
    """A quadratic with eigenvalues 1, 1, 1 and 5: all numbers depend on each other."""
    offset = share - MINIMUM
    return float(offset.square().sum() + offset.sum().square())


def test_the_grid_closes_in():
    """Each part is a Sobol set in its own cube: as wide as said, whole inside, about the best of the parts before."""
    heard = []
    points, finals = refined_grid(lambda share, again: coupled(share), 4, 128, seed=3, advance=heard.append)
    assert len(points.error) == 128 + 2 * 25
    assert len(finals.error) == 3 * FINALISTS
    assert len(heard) == looks(128)
    for first, last, half in STAGES:
        middle = torch.full((4,), 0.5, dtype=D)
        if first:
            middle = points.share[int(points.error[:first].argmin())].clamp(half, 1 - half)
        offset = (points.share[first:last] - middle) / half
        assert 0.9 < float(offset.abs().max()) <= 1 + 1e-12
        # means of n even numbers from -1 to 1 have a standard deviation of 1 / sqrt(3 n); four of them
        assert float(offset.mean(0).abs().max()) < 4 / math.sqrt(3 * (last - first))
    best = [float(points.error[:last].min()) for _, last, _ in STAGES]
    assert best[2] < best[0] / 2
    assert finals.error[finals.best] == best[2]
    same, _ = refined_grid(lambda share, again: coupled(share), 4, 128, seed=3)
    assert same.share.tolist() == points.share.tolist()


def test_cubes_stay_inside_at_a_wall():
    points, _ = refined_grid(lambda share, again: float(share.sum()), 2, 50, refinements=3, seed=0)
    assert float(points.share.min()) >= 0
    assert float(points.error.min()) < 0.05


def test_a_lucky_point_does_not_draw_the_next_cube_to_it():
    """By the first look the points of one corner are the best; by the second they are what they are."""

    def look(share, again):
        lucky = float((share - 0.05).norm()) < 0.45
        return coupled(share) - (10.0 if lucky and not again else 0.0)

    points, finals = refined_grid(look, 4, 500, seed=1)
    assert bool((points.error < -5).any())
    honest = torch.tensor([coupled(share) for share in finals.share], dtype=D)
    assert finals.error.tolist() == honest.tolist()
    for first, _, half in ((500, 600, 1 / 6), (600, 700, 1 / 18)):
        count = FINALISTS * (1 if first == 500 else 2)
        middle = finals.share[int(honest[:count].argmin())].clamp(half, 1 - half)
        assert float((points.share[first : first + 100] - middle).abs().max()) <= half * (1 + 1e-12)


def test_only_what_is_allowed_is_an_answer():
    points, finals = refined_grid(
        lambda share, again: coupled(share), 4, 128, allowed=lambda share: bool(share[0] > 0.4)
    )
    assert bool((points.share[:, 0] <= 0.4).any())
    assert float(finals.share[:, 0].min()) > 0.4
    with pytest.raises(DomainError, match="of 178 mounts of the grid none keeps what is required"):
        refined_grid(lambda share, again: coupled(share), 4, 128, allowed=lambda share: False)


def test_an_error_that_is_no_number_is_refused():
    with pytest.raises(NonFiniteError, match=r"refined grid: the error of .* is nan"):
        refined_grid(lambda share, again: math.nan if share[0] > 0.5 else 1.0, 3, 20)
