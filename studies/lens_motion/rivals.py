"""Designers that need no rendered frame: the same lens, variables and limits, minimised for spots,
for MTF over all directions, or for MTF along the motion."""

import math
from collections.abc import Callable
from itertools import combinations, product

import numpy as np
import scipy
import torch
from torch import Tensor

from codesign.errors import CodesignError
from codesign.lens import GeoLens
from studies.lens_motion.forms import Form
from studies.lens_motion.motions import Motion
from studies.lens_opt.spots import SpotRays, spot_rays
from studies.lens_opt.task import DISTANCE_M, LIGHT, PITCH_MM

FREQUENCY_PER_PX = 0.15
ALL_ROUND = torch.arange(8, dtype=torch.float64) * (math.pi / 8)
GRID = 12
MISSED = 10.0  # weight of rays that fail
FAILED = 1e3  # the value of a lens through which no light comes
DRAWN = 30  # random starts, beside those on a line of film places
TRIED = 2  # of the starts, the best, from which is descended
NAMES = ("refocused", "spots", "mtf", "mtf_along")


def mtf(rays: SpotRays, directions_rad: Tensor) -> Tensor:
    """Contrast of a grating of FREQUENCY_PER_PX by the rays alone, without the pixel's own.

    Args:
      directions_rad: [F, D] of the grating's wave vector, from the radius (y of the rays), per
        point.
    Returns: [F, D] in [0, 1]. Gradient: to the rays.
    """
    per_mm = FREQUENCY_PER_PX / PITCH_MM
    wave = torch.stack([directions_rad.sin(), directions_rad.cos()], -1) * (2 * math.pi * per_mm)
    phase = torch.einsum("fdk,fnk->fdn", wave, rays.spread()[0])
    share = rays.share[:, None]
    return torch.hypot((share * phase.cos()).sum(-1), (share * phase.sin()).sum(-1))


def rays_at(optics: GeoLens, at_px: Tensor, grid: int) -> SpotRays:
    """Rays of the wall at places of the film, [P, 2] from the axis, by the field angles of a lens
    without distortion."""
    angles = (at_px.norm(dim=1) * PITCH_MM / optics.first_order().efl_mm.detach()).atan()
    return spot_rays(optics, angles.tolist(), DISTANCE_M, LIGHT, grid=grid)


def rms_px(rays: SpotRays) -> float:
    """RMS radius of the point images, root mean square over the windows, pixels."""
    return float(rays.rms_mm().square().mean().sqrt()) / PITCH_MM


def objective(name: str, motion: Motion) -> Callable[[SpotRays], Tensor]:
    """What a designer minimises, of rays at the windows' centres."""
    if name in ("refocused", "spots"):
        return lambda rays: rays.rms_mm().square().mean().log()
    along = motion.directions_rad()
    directions = along if name == "mtf_along" else ALL_ROUND.expand(len(along), -1)
    return lambda rays: -mtf(rays, directions).mean()


def design(name: str, form: Form, motion: Motion, seed: int, steps: int) -> list[float]:
    """Variables of the best lens of a designer: quasi-Newton descent from the best of many starts.

    Args:
      name: of NAMES; "refocused" moves the film alone.
      steps: most evaluations of a descent.
    """
    bounds = np.array(form.bounds)
    if name == "refocused":
        bounds[1:] = 0.0
    at, loss = motion.points_px(), objective(name, motion)

    def value(point):
        variables = torch.tensor(point, requires_grad=True)
        try:
            optics = form.optics(variables)
            rays = rays_at(optics, at, GRID)
        except CodesignError:  # no light, or no focus: a failed step
            return FAILED, np.zeros(len(point))
        total = loss(rays) + form.penalty(optics) + MISSED * rays.missed
        total.backward()
        return total.item(), variables.grad.numpy()

    drawn = np.random.default_rng(seed).uniform(bounds[:, 0], bounds[:, 1], (DRAWN, len(bounds)))
    line = [[film, *np.zeros(len(bounds) - 1)] for film in np.linspace(-30, 3, 12)]
    starts = sorted(([*line, *drawn]), key=lambda point: value(np.asarray(point))[0])
    how = {"jac": True, "method": "L-BFGS-B", "bounds": bounds, "options": {"maxfun": steps}}
    found = [scipy.optimize.minimize(value, start, **how) for start in starts[:TRIED]]
    return min(found, key=lambda result: result.fun).x.tolist()


def between(answers: dict[str, list[float]]) -> dict[str, list[float]]:
    """Lenses at a third and two thirds of the way from one answer to another, by name."""
    found = {}
    for (one, other), share in product(combinations(answers, 2), (1 / 3, 2 / 3)):
        a, b = np.array(answers[one]), np.array(answers[other])
        found[f"{share:.2f} from {one} to {other}"] = ((1 - share) * a + share * b).tolist()
    return found
