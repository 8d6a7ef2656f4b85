"""Searches without gradients on functions whose minimum is known: how near they come, and what they
keep to."""

import math
import sys

import numpy as np
import optuna
import pytest
import torch

from codesign.errors import DomainError, MissingPackageError, NonFiniteError
from studies.placement.searches import SEARCHES, Trail, available

D = torch.float64
MINIMUM = torch.tensor([0.3, 0.62, 0.71, 0.9], dtype=D)
START = torch.full((4,), 0.15, dtype=D)


def coupled(share):
    """A quadratic with eigenvalues 1, 1, 1 and 5: all numbers depend on each other."""
    offset = share - MINIMUM
    return float(offset.square().sum() + offset.sum().square())


def valley(share):
    """Rosenbrock's function over -2..2, minimum 0 at (1, 1)."""
    x, y = (4 * share - 2).tolist()
    return (1 - x) ** 2 + 100 * (y - x**2) ** 2


@pytest.fixture(params=SEARCHES)
def search(request):
    return SEARCHES[request.param]


def test_a_quadratic_is_solved():
    """Of the cube 5.8 % has an error below 0.2, so that 200 random points miss it once in 100,000
    searches, and 0.02 % one below 0.01, which needs more than chance."""
    limits = {"random": 0.2, "CMA-ES": 1e-2, "TPE": 1e-2}
    for name, limit in limits.items():
        for seed in range(2):
            trail = SEARCHES[name](coupled, START, 200, seed)
            assert float(trail.error.min()) < limit, name
            assert trail.error[trail.best] == coupled(trail.share[trail.best])


def test_what_is_refused_costs_no_look(search):
    """A quarter of the square is refused, the minimum beside it; then all but the start."""
    goal = torch.tensor([0.55, 0.4], dtype=D)
    looked = []

    def judge(share):
        looked.append(share)
        return float((share - goal).square().sum())

    def refused(share):
        return 2.0 if float(share.max()) < 0.5 else None

    trail = search(judge, torch.tensor([0.7, 0.7], dtype=D), 40, 0, refused=refused)
    assert len(trail.error) == len(looked) == 40
    assert float(trail.share.amax(1).min()) >= 0.5
    assert float(trail.error.min()) < 0.02
    alone = search(judge, torch.tensor([0.7, 0.7], dtype=D), 3, 0, refused=lambda share: 2.0)
    assert alone.share.tolist() == [[0.7, 0.7]]


def test_the_valley_is_followed():
    """From its far end at (-1.2, 1), where the error is 24. Of the square 1.5 % is below 1, which
    250 random points miss once in 40 searches, and 0.2 % below 0.1. CMA-ES learns its bend."""
    start = torch.tensor([0.2, 0.75], dtype=D)
    limits = {"random": (250, 1.0), "CMA-ES": (500, 1e-2), "TPE": (250, 0.1)}
    for name, (count, limit) in limits.items():
        assert float(SEARCHES[name](valley, start, count, 3).error.min()) < limit, name


@pytest.mark.parametrize(("corner", "numbers"), [(0.0, 3), (1.0, 3), (1.0, 1)])
def test_a_minimum_in_a_corner_is_found_and_bounds_are_kept(search, corner, numbers):
    asked = []

    def slope(share):
        asked.append(share)
        return float((share - corner).abs().sum())

    trail = search(slope, torch.full((numbers,), 1 - corner, dtype=D), 150, 5)
    assert torch.equal(trail.share, torch.stack(asked))
    assert trail.share[0].tolist() == [1 - corner] * numbers
    assert float(trail.share.min()) >= 0
    assert float(trail.share.max()) <= 1
    # the best of 150 even points in a unit cube has 150 V = 1 at the corner's simplex, V = e^3 / 6:
    # e = 0.34
    assert float(trail.error.min()) < 0.6


def test_the_same_seed_gives_the_same_trail(search):
    state = random_state()
    one = search(coupled, START, 40, 7)
    assert random_state() == state, "the global generators are left alone"
    shorter = search(coupled, START, 13, 7)  # ends in the middle of a generation
    assert torch.equal(shorter.share, one.share[:13])
    assert torch.equal(shorter.error, one.error[:13])
    assert not torch.equal(search(coupled, START, 40, 8).share, one.share)


def random_state():
    """Of numpy's and torch's global generators."""
    return str(np.random.get_state()), torch.get_rng_state().tolist()  # noqa: NPY002 - read, never used


def test_a_flat_judge_does_not_end_a_search(search):
    heard = []
    verbosity = optuna.logging.get_verbosity()
    trail = search(lambda share: 1.0, torch.tensor([0.5, 0.0], dtype=D), 300, 0, heard.append)
    assert heard == [1.0] * 300
    assert len(trail.share.unique(dim=0)) > 100, "it looks on elsewhere"
    assert optuna.logging.get_verbosity() == verbosity


def test_best_is_the_first_of_the_least():
    trail = Trail(torch.zeros(3, 1), torch.tensor([2.0, 1.0, 1.0]))
    assert trail.best == 1


@pytest.mark.parametrize(("name", "library"), [("CMA-ES", "cma"), ("TPE", "optuna")])
def test_a_missing_library_is_one_sentence_before_the_first_call(monkeypatch, name, library):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(
        MissingPackageError,
        match=rf"^the search {name} needs {library}; install it with: pip install 'codesign\[search\]'$",
    ):
        available(SEARCHES)
    assert list(available(["random"])) == ["random"]


def test_what_cannot_be_searched_is_refused(search):
    with pytest.raises(
        DomainError, match="search 'cmaes' is unknown; choose from random, CMA-ES, TPE"
    ):
        available(["random", "cmaes"])
    with pytest.raises(NonFiniteError, match="the judge says nan of the shares"):
        search(lambda share: math.nan, START, 3, 0)
