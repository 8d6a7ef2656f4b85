"""A quasi-random grid, refined about what stays good when it is looked at again: the judge of how near the best a search
ends."""

import math
from collections.abc import Callable
from itertools import islice
from typing import TypeAlias

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from codesign.errors import DomainError, NonFiniteError, check_whole
from studies.placement.searches import Trail

SHRINK = 3.0  # of each cube to the next
PART = 5  # a refinement has this part of the first points
FINALISTS = 20  # of every cube

Look: TypeAlias = Callable[[Tensor, bool], float]


def refined_grid(
    look: Look,
    dimensions: int,
    count: int,
    refinements: int = 2,
    seed: int = 0,
    allowed: Callable[[Tensor], bool] = lambda share: True,
    advance: Callable[[float], object] = lambda error: None,
) -> tuple[Trail, Trail]:
    """``count`` Sobol points in the cube, then ``refinements`` times a fifth as many in a cube a third as wide.

    Of hundreds of points the first by a noisy error is the luckiest, and a grid about it shows its luck again. So the best
    FINALISTS of every cube that are allowed are looked at again, and the next cube lies about the best of all these.
    Args: look: (share [V], again) -> error; the errors of another look, the steadier the better. advance: called with each.
    Returns: all points in order; those looked at again, whose ``best`` is the grid's. Smaller cubes stay whole inside the
      large one; the same for the same seed and looks.
    Raises: DomainError where no point is allowed, NonFiniteError for an error that is not finite.
    """
    engine = _sobol(dimensions, seed)
    part = max(1, check_whole(count, "refined grid: count") // PART)
    points: list[Tensor] = []
    errors: list[float] = []
    finalists: list[Tensor] = []
    finals: list[float] = []

    def told(share, again):
        error = look(share, again)
        if not math.isfinite(error):
            raise NonFiniteError(f"refined grid: the error of {share.tolist()} is {error}; give finite ones.")
        advance(error)
        return error

    middle = torch.full((dimensions,), 0.5, dtype=torch.float64)
    for level in range(refinements + 1):
        half = 0.5 / SHRINK**level
        middle = middle.clamp(half, 1 - half)
        draws = engine.draw(part if level else count, dtype=torch.float64)
        new = list((middle + half * (2 * draws - 1)).clamp(0, 1))
        seen = [told(share, False) for share in new]
        points, errors = points + new, errors + seen
        order = sorted(range(len(new)), key=seen.__getitem__)
        best = list(islice((new[k] for k in order if allowed(new[k])), FINALISTS))
        finalists, finals = finalists + best, finals + [told(share, True) for share in best]
        if finals:
            middle = finalists[min(range(len(finals)), key=finals.__getitem__)]
    if not finals:
        raise DomainError(
            f"of {len(points)} mounts of the grid none keeps what is required; give --grid more of them, or ask for less."
        )
    return _trail(points, errors), _trail(finalists, finals)


def first_points(dimensions: int, count: int, seed: int = 0) -> Tensor:
    """[count, V]: those of the first cube."""
    return _sobol(dimensions, seed).draw(count, dtype=torch.float64)


def looks(count: int, refinements: int = 2) -> int:
    """Most looks that a grid of ``count`` first points takes."""
    cubes = [count] + [max(1, count // PART)] * refinements
    return sum(points + min(points, FINALISTS) for points in cubes)


def _sobol(dimensions, seed):
    return SobolEngine(check_whole(dimensions, "refined grid: dimensions"), scramble=True, seed=seed)


def _trail(points, errors):
    return Trail(torch.stack(points), torch.tensor(errors, dtype=torch.float64))
