"""Lenses re-optimised around a move: an element taken out along a path, glasses exchanged for their
neighbours.

    def residuals(candidate):
        spots, _ = lens.spots(candidate, fields)
        errors = (spots - spots.mean(1, keepdim=True)).reshape(-1) / 0.01
        return torch.cat([errors, rows(evaluate(candidate, limits))])

    shorter = remove_element(geo, 1, residuals)
    better = exchange_glasses(shorter.lens, residuals)

All run damped least squares over the numbers named; the focal length is held by a curvature
throughout.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from codesign.errors import DomainError
from codesign.grad.jacobian import by_differences
from codesign.lens import GeoLens
from codesign.lens.design.moves import (
    elements,
    flattened,
    neighbour_glasses,
    with_glass,
    without_element,
)
from codesign.lens.glass import AIR
from codesign.lens.solves import focus_paraxial, hold_efl, holding_surface
from codesign.lens.variables import Bound
from codesign.optimise.least_squares import DampedLeastSquares

Residuals = Callable[[GeoLens], Tensor]
Bounds = Mapping[str, tuple[Bound, Bound]]
NAMES = ("curvature", "thickness", "focus")
STEP = 1e-3  # of the unit of a variable, which moves the rays by a thousandth of the focal length


@dataclass(frozen=True)
class Redesign:
    """A lens of its own after a move, the merit (sum of squared residuals) of the lens given and of
    this one, why the last run of least squares stopped, and what was done in words, a line each."""

    lens: GeoLens
    before: float
    after: float
    stopped: str
    log: tuple[str, ...] = ()


def reoptimise(
    lens: GeoLens,
    residuals: Residuals,
    names: Sequence[str] = NAMES,
    held: Sequence[int] = (),
    steps: int = 40,
    bounds: Bounds | None = None,
) -> Redesign:
    """Damped least squares on the residuals of a lens, its focal length held by a curvature.

    Args:
      residuals: lens -> [M]; limits enter as rows, see ``constraints.rows``. Values that are not
        finite, and a DomainError, make a failed step.
      names, bounds: as in ``GeoLens.variables``; thicknesses stay above 0.
      held: surfaces (from 0, from the last when negative) whose curvature is not to change.
      steps: most steps.
    Returns: Redesign; the lens given stays as it is.
    Raises: DomainError when the residuals of the lens given are not finite, a held surface is not
      there, or nothing can vary.
    """
    count = len(lens.surfaces)
    missing = [i for i in held if not -count <= i < count]
    if missing:
        raise DomainError(
            f"{lens.name}: there is no surface {missing[0]} to hold; it has 0 to {count - 1}."
        )
    held = [i % count for i in held]
    work = copy.deepcopy(lens)
    efl = float(work.first_order().efl_mm.detach())
    at = _holder(work, held)
    free = [i != at and i not in held for i in range(len(work.surfaces))]
    mask = {"curvature": free} if "curvature" in names else {}
    parameters = work.variables(*names, mask=mask, bounds=bounds)

    def build(x):
        vector_to_parameters(x, parameters)
        return hold_efl(work.replace(), efl, at)

    def guarded(x):
        with torch.no_grad():
            try:
                return residuals(build(x))
            except DomainError:
                return torch.full_like(at_start, torch.nan)

    at_start = residuals(hold_efl(work.replace(), efl, at)).detach()
    solver = DampedLeastSquares(
        guarded, parameters_to_vector(parameters).detach(), by_differences(STEP)
    )
    before = 2 * solver.loss
    with torch.no_grad():
        found = copy.deepcopy(build(solver.run(steps)))
    return Redesign(found, before, 2 * solver.loss, solver.stopped)


def remove_element(
    lens: GeoLens,
    element: int,
    residuals: Residuals,
    names: Sequence[str] = NAMES,
    path: int = 3,
    steps: int = 40,
    bounds: Bounds | None = None,
) -> Redesign:
    """The lens without an element, re-optimised: its curvatures are first led to a plate
    (see ``moves.flattened``) in ``path`` equal parts, each followed by a quarter of the ``steps``,
    so that the others take over its work.

    Args:
      element: its number in ``elements(lens)``.
      path: 0 removes at once. The rest as for ``reoptimise``.
    Returns: Redesign from the lens given to the one without the element.
    Raises: DomainError as ``without_element`` and ``reoptimise``.
    """
    now = flattened(lens, element, 0.0)
    faces = elements(lens)[element]
    before = float(residuals(lens).detach().square().sum())
    log = []
    for part in range(path):
        try:
            moved = _as_before(flattened(now, element, 1 / (path - part)), lens, faces)
            now = reoptimise(moved, residuals, names, faces, max(1, steps // 4), bounds).lens
        except DomainError as error:
            log.append(f"part {part + 1} of the path was left out: {error}")
    found = reoptimise(without_element(now, element), residuals, names, (), steps, bounds)
    return Redesign(found.lens, before, found.after, found.stopped, tuple(log))


def exchange_glasses(
    lens: GeoLens,
    residuals: Residuals,
    names: Sequence[str] = NAMES,
    count: int = 3,
    steps: int = 15,
    bounds: Bounds | None = None,
    among: Sequence[str] | None = None,
) -> Redesign:
    """The lens with the glass of one element after another exchanged for the best of its nearest
    catalogue neighbours, where that is better after re-optimisation.

    Args:
      count, among: neighbours tried per glass and the names they are chosen from, see
        ``neighbour_glasses``.
      steps: most steps per trial, and for the lens given first, so that a neighbour wins by its
        glass and not by its steps. The rest as for ``reoptimise``.
    Returns: Redesign; its log has a line per trial.
    Raises: DomainError for a lens without glass, or as ``reoptimise`` for the lens given.
    """
    pairs = elements(lens)
    if not pairs:
        raise DomainError(f"{lens.name}: it has no glass to exchange.")
    start = now = reoptimise(lens, residuals, names, (), steps, bounds)
    log = []
    for front, _ in pairs:
        best = now
        medium = now.lens.to_surfaces()[front].medium or AIR
        for candidate in neighbour_glasses(medium, count, among=among):
            label = f"{medium.name} behind surface {front + 1} -> {candidate.name}"
            try:
                moved = with_glass(now.lens, front, candidate)
                trial = reoptimise(moved, residuals, names, (), steps, bounds)
            except DomainError as error:
                log.append(f"{label}: no lens, {error}")
                continue
            log.append(f"{label}: {trial.after:.6g} against {now.after:.6g}")
            best = min(best, trial, key=lambda redesign: redesign.after)
        now = best
    return Redesign(now.lens, start.before, now.after, now.stopped, tuple(log))


def _as_before(lens, like, held):
    """The lens with the focal length and the defocus of another, by a curvature that is not among
    ``held``."""
    f = like.first_order()
    lens = hold_efl(lens, f.efl_mm.detach(), _holder(lens, held))
    return focus_paraxial(lens, defocus_mm=(like.thickness_mm[-1] - f.bfl_mm).detach())


def _holder(lens, held):
    """The surface that holds the focal length: ``holding_surface``, or the last that bends light
    and may change."""
    at = holding_surface(lens)
    if at not in held:
        return at
    index = lens.index().tolist()
    others = [i for i in range(len(lens.surfaces)) if index[i] != index[i + 1] and i not in held]
    if not others:
        raise DomainError(
            f"{lens.name}: no surface is left to hold the focal length; hold fewer curvatures."
        )
    return others[-1]
