"""The velocity of a body when nobody knows how far the surfaces are.

The flow of a point is (R0 + rho R1) v with rho = 1 / depth. With rho anywhere between two bounds,
everywhere as likely, the likelihood of v takes in all depths,

    p(flow | v) = 1 / (hi - lo)  integral over rho of  N(flow; (R0 + rho R1) v, precision),

whose integrand is a Gaussian in rho, cut off at the bounds: nodes laid over where it is not nothing
give it and its moments. Slope and curvature in v follow from the moments (Fisher's and Louis'
identities: the mean of the slope at known depth; the mean of its curvature less the covariance of
that slope). The likelihood has other maxima, where points stand at a bound: flow is believed a
thousandth at first, and the maximum is followed while the belief grows (Rose, Deterministic
annealing, 1998).
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.mount.depth import hidden_by_objects
from codesign.types import ChiefRayCamera

BELIEFS = (1e-3, 1e-2, 1e-1, 1.0)  # of the precision, one after the other
CUT = 18.0  # below its largest logarithm the integrand is nothing
NODES, WEIGHTS = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(20))
LEAST = 1e-12


@dataclass(frozen=True)
class UnknownDepth:
    """No map: surfaces anywhere from ``nearest_m`` to ``farthest_m``, evenly in 1 / depth.
    ``depth`` of an EgoVelocity.

    Raises: DomainError unless 0 < nearest_m < farthest_m; the farthest may be infinite.
    """

    nearest_m: float = 0.3
    farthest_m: float = math.inf

    def __post_init__(self):
        if not 0 < self.nearest_m < self.farthest_m:
            raise DomainError(
                f"depth from {self.nearest_m:g} to {self.farthest_m:g} m; a nearest > 0 and a farthest beyond it are needed."
            )

    @property
    def bounds_per_m(self) -> tuple[float, float]:
        """Of 1 / depth."""
        return 1 / self.farthest_m, 1 / self.nearest_m

    @property
    def mean_per_m(self) -> float:
        """Of 1 / depth."""
        return sum(self.bounds_per_m) / 2

    def __call__(
        self, camera: ChiefRayCamera, pixels: Tensor, T_world_cam: Tensor, scene: Any = None
    ) -> Tensor:
        """The depth of mean nearness [N, P] m, infinite where an object of a MovingScene is
        seen."""
        depth = pixels.new_full(pixels.shape[:-1], 1 / self.mean_per_m, dtype=torch.float64)
        return depth.masked_fill(hidden_by_objects(camera, pixels, T_world_cam, scene), torch.inf)


@dataclass(frozen=True)
class Points:
    """What the flow of N bodies says at P points, for any depths.

    precision: [N, P, 2, 2] px^-2. told: [N, P, 2], precision times flow. far, near: rows
    [N, P, 2, K] px at infinite depth, and what each 1 / m adds. weight: [N, P] of a point's
    logarithmic likelihood. prior: [K, K] precision of the velocities. bounds: of nearness, 1 / m.
    """

    precision: Tensor
    told: Tensor
    far: Tensor
    near: Tensor
    weight: Tensor
    prior: Tensor
    bounds: tuple[float, float]


class Look(NamedTuple):
    """At velocities [N, K]: value [N], less by a constant than minus the logarithm of the posterior
    density; its slope [N, K] and curvature [N, K, K]; mean of nearness [N, P] 1/m."""

    value: Tensor
    slope: Tensor
    curvature: Tensor
    nearness: Tensor


def look(points: Points, velocity: Tensor) -> Look:
    """Gradient: points and velocity."""
    v = velocity[:, None, :, None]
    still, moved = ((rows @ v)[..., 0] for rows in (points.far, points.near))
    missed = points.told - (points.precision @ still[..., None])[..., 0]
    pushed = (points.precision @ moved[..., None])[..., 0]
    tilt, bend = (moved * missed).sum(-1), (moved * pushed).sum(-1)
    mass, mean, second, third, fourth = _moments(tilt, bend, *points.bounds)
    rows = points.far + mean[..., None, None] * points.near
    at_mean = missed - mean[..., None] * pushed  # precision times what is left of the flow
    # the slope at known nearness mean + d is zeroth + d first + d^2 second_order
    zeroth = _times(rows, at_mean)
    first = _times(points.near, at_mean) - _times(rows, pushed)
    second_order = -_times(points.near, pushed)
    slope = zeroth + second[..., None] * second_order
    weight = points.weight[..., None]
    ahead = (points.prior @ velocity[..., None])[..., 0]
    sloped = ahead - (weight * slope).sum(1)
    weighed = points.precision * weight[..., None]
    curved = (rows.mT @ weighed @ rows).sum(1)
    curved = curved + ((second[..., None, None] * points.near.mT) @ weighed @ points.near).sum(1)
    for factor, a, b in (
        (second, first, first),
        (third, first, second_order),
        (third, second_order, first),
        (fourth - second**2, second_order, second_order),
    ):
        curved = curved - ((weight * factor[..., None] * a).mT @ b)
    fit = (still * (points.told + missed)).sum(-1) / 2 + mass
    value = (velocity * ahead).sum(1) / 2 - (points.weight * fit).sum(1)
    return Look(value, sloped, curved + points.prior, mean)


def follow(points: Points, velocity: Tensor, steps: int = 12) -> Tensor:
    """Velocities [N, K] of greatest posterior density, from where others are, over the BELIEFS. No
    gradient."""
    with torch.no_grad():
        for belief in BELIEFS:
            part = replace(points, precision=belief * points.precision, told=belief * points.told)
            velocity = descend(part, velocity, steps)
    return velocity


def descend(points: Points, velocity: Tensor, steps: int) -> Tensor:
    """Damped Newton steps, only downwards. No gradient."""
    damping = torch.full_like(velocity[:, :1], 1e-3)
    here = look(points, velocity)
    for _ in range(steps):
        there = velocity - _solve(here.curvature, here.slope, damping)
        found = look(points, there)
        better = found.value <= here.value
        velocity = torch.where(better[:, None], there, velocity)
        here = Look(
            *(
                torch.where(better.reshape(-1, *(1,) * (old.dim() - 1)), new, old)
                for old, new in zip(here, found, strict=True)
            )
        )
        damping = torch.where(better[:, None], damping / 5, 8 * damping + 1e-2)
    return velocity


def settled(points: Points, velocity: Tensor) -> Tensor:
    """One more Newton step, with the gradient that the maximum has to the points."""
    found = look(points, velocity)
    return velocity - _solve(found.curvature.detach(), found.slope, 0.0)


def covariance(points: Points, velocity: Tensor) -> Tensor:
    """[N, K, K]: the inverse of the curvature, taken for positive where it is not. Gradient:
    both."""
    curvature = look(points, velocity).curvature
    # detached: eigenvectors have no gradient where two values are alike
    values, vectors = torch.linalg.eigh(curvature.detach())
    lifted = values.abs().clamp_min(LEAST) - values
    return torch.linalg.inv(curvature + vectors @ (lifted[..., None] * vectors.mT))


def _solve(curvature, slope, damping):
    """A step down whatever the signs of the curvature."""
    values, vectors = torch.linalg.eigh(curvature)
    bent = values.abs().clamp_min(LEAST) * (1 + damping)
    return (vectors @ ((vectors.mT @ slope[..., None]) / bent[..., None]))[..., 0]


def _moments(tilt, bend, low, high):
    """Of exp(tilt rho - bend rho^2 / 2) over bounds: logarithm of its mean, mean of rho, central
    moments 2 to 4."""
    with torch.no_grad():
        peak = (tilt / bend.clamp_min(LEAST)).clamp(low, high)
        fall = (tilt - bend * peak).abs()
        reach = 2 * CUT / (fall + (fall.square() + 2 * CUT * bend).sqrt()).clamp_min(LEAST)
        start, end = (peak - reach).clamp_min(low), (peak + reach).clamp_max(high)
        half = (end - start).clamp_min(LEAST) / 2
    rho = ((start + end) / 2)[..., None] + half[..., None] * NODES.to(tilt)
    power = tilt[..., None] * rho - bend[..., None] * rho**2 / 2 + WEIGHTS.to(tilt).log()
    share = power.softmax(-1)
    mass = torch.logsumexp(power, -1) + half.log() - math.log(high - low)
    mean = (share * rho).sum(-1)
    off = rho - mean[..., None]
    return mass, mean, *((share * off**order).sum(-1) for order in (2, 3, 4))


def _times(rows, pixels):
    """Rows [N, P, 2, K] transposed times [N, P, 2]."""
    return (rows.mT @ pixels[..., None])[..., 0]
