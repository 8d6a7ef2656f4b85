"""Lenses made from the same start without a single rendered frame: refocused, and optimised for
spot size.

Both have the free variables and the limits of the flow design, and both may choose: among light and
weights of the fields, by the flow error on development cases, which are neither optimised on nor
judged.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign import backend, lens
from codesign.errors import CodesignError, DomainError
from codesign.grad.jacobian import by_differences
from codesign.lens.design.modes import sizes_of
from codesign.optimise import DampedLeastSquares, StopRules
from studies.lens_opt.spots import refocused, spot_rays
from studies.lens_opt.task import DISTANCE_M, HALF_DIAGONAL_MM, LIGHT, PITCH_MM, LensTask, film

HEIGHTS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)  # of the half diagonal
EDGE_WEIGHT = 10.0  # pixels of spot per hundredth of the focal length that an edge is too thin
MISS_WEIGHT = 1.0  # of rays that fail
FIRST = "even"  # the weights that the others go on from
SPREAD = 0.05  # relative standard deviation of curvatures and thicknesses in further starts
DIFFERENCE = 1e-6  # relative step of the Jacobian's differences
# relative decrease of the squared spot in a step, below which the design has converged
SETTLED = 1e-3


@dataclass(frozen=True)
class Variant:
    """A lens, the setting that made it, its mean flow error on development cases, and what is wrong
    with it ("" if nothing)."""

    setting: str
    optics: lens.GeoLens
    error_mrad: float
    complaint: str = ""

    def numbers(self) -> dict[str, Any]:
        """All but the lens, for a state file."""
        return {name: value for name, value in vars(self).items() if name != "optics"}


def field_weights(task: LensTask) -> dict[str, tuple[float, ...]]:
    """Weights of HEIGHTS by name, sum 1. "windows" are the shares of the pixels that are looked
    at."""
    seen = film()
    radius = (seen.pixels() - seen.middle_px).norm(dim=1) * PITCH_MM / HALF_DIAGONAL_MM
    nearest = (radius[:, None] - torch.tensor(HEIGHTS, dtype=radius.dtype)).abs().argmin(1)
    counts = torch.bincount(nearest, minlength=len(HEIGHTS)).double()
    height = torch.tensor(HEIGHTS, dtype=torch.float64)
    found = {
        FIRST: torch.ones_like(height),
        "windows": counts,
        "inner": (1 - 0.8 * height).square(),
        "outer": (0.2 + 0.8 * height).square(),
    }
    return {name: tuple((w / w.sum()).tolist()) for name, w in found.items()}


def angles_rad(task: LensTask) -> tuple[float, ...]:
    """Field angles of HEIGHTS, without distortion."""
    tangents = torch.tensor(HEIGHTS, dtype=torch.float64) * HALF_DIAGONAL_MM / task.design.efl_mm
    return tuple(tangents.atan().tolist())


def refocus(task: LensTask, judge: Callable[[lens.GeoLens], float]) -> list[Variant]:
    """The start at every best focus there is: of the d line, or of all wavelengths by the weights
    of the fields."""
    weights = field_weights(task)
    settings = [
        ("d line", lens.Spectrum.line("d"), FIRST),
        *(("all wavelengths", LIGHT, name) for name in weights),
    ]
    found = []
    for colour, light, name in settings:
        optics = refocused(
            task.design.reference, angles_rad(task), DISTANCE_M, light, weights[name]
        )
        found.append(Variant(f"{colour}, fields {name}", optics, judge(optics)))
    return found


def shrink_spots(
    task: LensTask, judge: Callable[[lens.GeoLens], float], steps: int, starts: int, seed: int
) -> list[Variant]:
    """Designs of least weighted mean square spot, by damped least squares, one per weights of the
    fields.

    The even weights are optimised from ``starts`` starts, the detuned lens and others around it;
    the other weights go on from the best of them. Args:
      judge: mean flow error on development cases.
      steps: most steps of a run.
    Returns: the start itself, with a complaint, when no start gives a smaller spot than it had.
    """
    generator = torch.Generator().manual_seed(seed)
    weights = field_weights(task)
    size = sizes_of(task.design.reference)
    first = torch.zeros_like(size)
    tried = []
    for number in range(starts):
        drawn = torch.randn(len(size), generator=generator, dtype=size.dtype) if number else first
        start = SPREAD * drawn
        try:
            tried.append(_solved(task, size, weights[FIRST], start, steps))
        except CodesignError:  # a start through which no light comes, or no focal length
            continue
    best = min(tried, key=lambda solver: solver.loss, default=None)
    before = float(residuals(task, size, weights[FIRST])(first).square().sum()) / 2
    if best is None or not best.loss < before:
        complaint = (
            f"the spot designer finds no smaller spot from {starts} starts in {steps} steps, so its lens is the start; "
            "with more --spot-starts or --spot-steps it may do better than shown."
        )
        optics = task.design.reference.freeze()
        return [Variant("none smaller: the start", optics, judge(optics), complaint)]
    solved = {FIRST: best}
    for name in weights.keys() - {FIRST}:
        solved[name] = _solved(task, size, weights[name], best.variables, steps)
    found = []
    for name in weights:
        optics = _lens(task, size, solved[name].variables).freeze()
        complaint, why = "", solved[name].stopped
        if why in ("steps", "damping"):
            complaint = (
                f"the spot designer has not converged in {steps} steps (it stopped for: {why}); with more "
                "--spot-steps it may do better than shown."
            )
        found.append(Variant(f"fields {name}", optics, judge(optics), complaint))
    return found


def residuals(
    task: LensTask,
    size: Tensor,
    weights: tuple[float, ...],
) -> Callable[[Tensor], Tensor]:
    """Function of relative changes [V] to ray errors in pixels, whose squares sum to the weighted
    mean square spot; and to failed rays and edges below their floors."""
    kept = [(angle, w) for angle, w in zip(angles_rad(task), weights, strict=True) if w > 0]
    angles, shares = zip(*kept, strict=True)
    root = torch.tensor(shares, dtype=torch.float64).sqrt()[:, None, None]

    def found(changes):
        try:
            optics = _lens(task, size, changes)
            rays = spot_rays(optics, angles, DISTANCE_M, LIGHT, grid=8)
        except DomainError:  # no focal length, or no light: a failed step
            return changes.new_full((1,), torch.nan)
        error = root * rays.share.sqrt()[..., None] * rays.spread()[0] / PITCH_MM
        thin = task.design.shortfall(optics)
        return torch.cat(
            [error.reshape(-1), EDGE_WEIGHT * thin, MISS_WEIGHT * rays.missed.reshape(1)]
        )

    return found


def least(variants: list[Variant]) -> Variant:
    return min(variants, key=lambda variant: variant.error_mrad)


def _lens(task, size, changes):
    return task.design.changed(size * changes)


def _solved(task, size, weights, start, steps):
    solver = DampedLeastSquares(
        residuals(task, size, weights),
        start,
        by_differences(DIFFERENCE),
        stop=StopRules(steps=steps, loss=SETTLED),
    )
    with backend.threads(most=1):
        solver.run()
    return solver
