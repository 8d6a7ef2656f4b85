"""Point images in numbers, and which of the numbers tells the flow error best."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import isotonic_regression
from torch import Tensor

from codesign import render
from codesign.errors import DomainError
from codesign.lens.analysis import pupil_grid
from studies.flow_needs.cases import WALL_M, WINDOW_PX
from studies.flow_needs.summary import first_above

Array = NDArray[np.float64]
FREQUENCIES = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4)  # cycles per pixel
DIRECTIONS = 8
MOST_DOUBLED = 2**10
ACROSS = 3  # points of the window in each direction


def point_images_px(camera: render.Camera, distance_m: float = WALL_M, grid: int = 48) -> Tensor:
    """What pixels see of a plane across the axis, about their mean: [P, M, 2] pixels, of ACROSS x ACROSS points of
    the window. It is the point image of the plane, turned about by 180 degrees.

    Raises: DomainError for rays that fail.
    """
    at = torch.linspace(0, WINDOW_PX - 1, ACROSS, dtype=torch.float64)
    y, x = torch.meshgrid(at, at, indexing="ij")
    corner = torch.tensor(camera.film.windows_px or ((0, 0),), dtype=torch.float64)[0]
    pixels = corner + torch.stack([x.reshape(-1), y.reshape(-1)], 1)
    pupil = pupil_grid(grid).double()
    with torch.no_grad():
        rays = camera.rays_through(pixels.repeat_interleave(len(pupil), 0), pupil.repeat(len(pixels), 1))
        if bool((rays.weight <= 0.5).any()):
            raise DomainError(
                "rays of the point images fail or are clipped; make the lens's apertures larger."
            )
        along = (distance_m - rays.origin_m[:, 2]) / rays.direction[:, 2]
        seen_m = rays.origin_m[:, :2] + rays.direction[:, :2] * along[:, None]
        points = (seen_m / (distance_m * camera.slope_per_px())).reshape(len(pixels), len(pupil), 2)
    return points - points.mean(1, keepdim=True)


def rms_px(points: Tensor) -> float:
    """RMS radius of point images [P, M, 2], over all of them."""
    return float(points.square().sum(-1).mean().sqrt())


def encircled_px(points: Tensor, share: float) -> float:
    """Radius about the mean that holds a share of the light, mean over the point images [P, M, 2]."""
    return float(points.norm(dim=-1).quantile(share, dim=1).mean())


def mtf(points: Tensor, cycles_per_px: float) -> float:
    """Modulation of point images [P, M, 2] at a frequency, mean over directions; the pixel itself is not in it."""
    angle = torch.arange(DIRECTIONS, dtype=points.dtype) * (math.pi / DIRECTIONS)
    phase = 2 * math.pi * cycles_per_px * points @ torch.stack([angle.cos(), angle.sin()])
    return float(torch.hypot(phase.cos().mean(1), phase.sin().mean(1)).mean())


def predictors(points: Tensor) -> dict[str, float]:
    """Every number by name; all grow with blur (1 - MTF)."""
    found = {
        "RMS radius, px": rms_px(points),
        "mean radius, px": float(points.norm(dim=-1).mean()),
        "radius of 50 % of the light, px": encircled_px(points, 0.5),
        "radius of 80 % of the light, px": encircled_px(points, 0.8),
    }
    return found | {f"MTF at {f:g} cycles/px": 1 - mtf(points, f) for f in FREQUENCIES}


def left_out_residual(numbers: Sequence[float], logs: Sequence[float], families: Sequence[str]) -> float:
    """How well a number tells a logarithm: RMS residual of families of lenses that the rule was not fitted to.

    The rule is a rising one through (0, 0): isotonic least squares, joined by straight lines, constant beyond.
    Raises: DomainError for fewer than two families.
    """
    x, y, owner = np.asarray(numbers, float), np.asarray(logs, float), np.asarray(families)
    if len(set(families)) < 2:
        raise DomainError(
            f"a number is judged on families it was not fitted to; got {sorted(set(families))}, give two."
        )
    residuals = []
    for family in sorted(set(families)):
        kept = owner != family
        residuals.append(y[~kept] - np.interp(x[~kept], *_rule(x[kept], y[kept])))
    return float(np.sqrt(np.square(np.concatenate(residuals)).mean()))


def bearable(numbers: Sequence[float], logs: Sequence[float], rise: float) -> float:
    """Number at which the rule fitted to all lenses reaches an error of 1 + ``rise``; inf where it does not."""
    at, fitted = _rule(np.asarray(numbers, float), np.asarray(logs, float))
    return float(first_above(at, fitted[None], math.log1p(rise))[0])


def _rule(x, y):
    order = np.argsort(x, kind="stable")
    return np.concatenate([[0.0], x[order]]), isotonic_regression(np.concatenate([[0.0], y[order]])).x


def ramp(make: Callable[[float], Any], camera: render.Camera, wanted_px: float, first: float) -> Any:
    """The lens of a family whose point images in the camera's window have an RMS radius of ``wanted_px``: by doubling
    its amplitude from ``first``, and bisection.

    Raises: DomainError when none has.
    """

    def blur_px(amplitude):
        return rms_px(point_images_px(camera.with_lens(make(amplitude))))

    low, high = 0.0, first
    if not blur_px(0.0) < wanted_px:
        raise DomainError(f"the lens has more than {wanted_px} px of blur to begin with; give a sharper one.")
    while blur_px(high) < wanted_px:
        low, high = high, 2 * high
        if high > MOST_DOUBLED * first:
            raise DomainError(
                f"an amplitude of {low:g} makes less than {wanted_px} px of blur; give a larger one."
            )
    while high - low > 1e-3 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if blur_px(middle) < wanted_px else (low, middle)
    return make(high)
