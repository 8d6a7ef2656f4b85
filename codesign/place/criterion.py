"""By what a mount is judged before anything moves: the error of the body's velocity that its flow lets expect, and the
motions it is blind to."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError, check_finite
from codesign.place.observability import FREE

NAMES = ("forward", "left", "up", "roll", "pitch", "yaw")
LINEAR = 3  # of the six, m/s; the others rad/s
NOTHING = 1e-12  # share of the largest eigenvalue below which a motion leaves all flow as it is, in float64


def flow_precision(covariance: Tensor, confidence: Tensor | None = None, floor: float = 0.0) -> Tensor:
    """Inverse covariance of flow as a measurement, out of what an estimator says of its flow.

    Args: covariance: [..., 3] of the error (xx, xy, yy), px^2 as of FlowField.covariance_px2, or px^2/s^2. confidence:
      [...] in 0..1, None: 1. A flow with a prior has precision S^-1 of which about confidence S^-1 came from events.
      floor: standard deviation of errors that no covariance knows of, px.
    Returns: [..., 2, 2], confidence (S + floor^2)^-1, for ``information`` and ``velocity_from_flow`` (times the square of
      the interval where the covariance is in px^2). Gradient: both.
    Raises: ShapeError; DomainError for what is no covariance.

    >>> flow_precision(torch.tensor([2.0, 1.0, 1.0]), torch.tensor(0.5)).tolist()
    [[0.5, -0.5], [-0.5, 1.0]]
    """
    if covariance.shape[-1:] != (3,):
        raise ShapeError(f"a covariance of flow is [..., 3] (xx, xy, yy), got {tuple(covariance.shape)}.")
    check_finite(covariance, "covariance of flow")
    xx, xy, yy = covariance.unbind(-1)
    xx = xx + floor**2
    yy = yy + floor**2
    determinant = xx * yy - xy * xy
    if not bool(((xx > 0) & (determinant > 0)).all()):
        raise DomainError(
            "a covariance of flow is not positive (xx > 0 and xx yy > xy^2 are needed); give a floor above 0."
        )
    inverse = torch.stack([torch.stack([yy, -xy], -1), torch.stack([-xy, xx], -1)], -2)
    share = 1.0 if confidence is None else confidence[..., None, None]
    return share * inverse / determinant[..., None, None]


def expected_error(
    information: Tensor, unit: Sequence[float] | Tensor, prior: Sequence[float] | Tensor
) -> Tensor:
    """Root mean square error of K velocities, in units of ``unit``, that the best unbiased use of the flow leaves.

    Args: information: [..., K, K] as of ``place.information`` without prior, or of an estimator: the inverse of
      ``task.Motion.covariance`` less the prior's. unit: [K] errors that count 1. prior: [K] standard deviations of the
      velocities around zero, by which what no flow shows counts.
    Returns: [...]. Gradient: information.
    Raises: ShapeError; DomainError for units or priors that are not positive.
    Source: Cramer-Rao bound with a prior (Van Trees, 1968).

    >>> round(float(expected_error(torch.diag(torch.tensor([3.0, 0.0])), (1.0, 1.0), (1.0, 2.0))), 3)  # 1/4 and 4
    1.458
    """
    unit = _scales(unit, information, "unit")
    deviation = _scales(prior, information, "prior")
    covariance = torch.linalg.inv(information.double() + torch.diag(deviation**-2))
    return (covariance.diagonal(dim1=-2, dim2=-1) / unit**2).mean(-1).sqrt()


@dataclass(frozen=True)
class Sight:
    """What flow tells of K velocities.

    axes: which of the six. deviation: [K] standard deviation of each where none is known, m/s and rad/s, infinite for
    what leaves no trace in the flow; alone: [K] where all others are known. weakest: [K] motion that shows least, of
    length 1 in units of ``unit``; weakest_deviation: its standard deviation in these units. unit: [K].
    """

    axes: tuple[int, ...]
    deviation: Tensor
    alone: Tensor
    weakest: Tensor
    weakest_deviation: float
    unit: Tensor

    def blind(self, limit: float = 1.0) -> list[str]:
        """Names of the velocities whose deviation is above ``limit`` units."""
        return [
            NAMES[axis]
            for axis, over in zip(self.axes, self.deviation / self.unit > limit, strict=True)
            if over
        ]

    def weakest_named(self, least: float = 0.2) -> str:
        """The weakest motion in words and shares of its units, such as "+0.71 left -0.70 roll"; parts below ``least``
        are left out."""
        parts = [
            f"{share:+.2f} {NAMES[axis]}"
            for axis, share in zip(self.axes, self.weakest.tolist(), strict=True)
            if abs(share) >= least
        ]
        return " ".join(parts)


@torch.no_grad()
def sight(information: Tensor, unit: Sequence[float] | Tensor, axes: Sequence[int] = FREE) -> Sight:
    """What a mount sees and what it is blind to.

    Args: information: [K, K] without prior. unit: [K] by which metres and radians per second are compared. axes: which
      of the six velocities the K are. Returns: Sight; no gradient.
    Raises: ShapeError; DomainError.

    >>> sight(torch.diag(torch.tensor([100.0, 4.0, 0.0])), (0.1, 0.1, 0.1), (0, 1, 5)).blind()
    ['left', 'yaw']
    """
    scale = _scales(unit, information, "unit")
    if information.shape != (len(scale), len(scale)) or len(axes) != len(scale):
        raise ShapeError(
            f"sight: one information [K, K] and K axes are needed, got {tuple(information.shape)}."
        )
    scaled = scale[:, None] * information.double() * scale
    values, vectors = torch.linalg.eigh(scaled)
    dark = values <= NOTHING * values[-1].clamp_min(0)
    shares = vectors.square()
    spread = torch.where(dark, 0.0, 1 / torch.where(dark, 1.0, values))
    lost = (shares * dark).sum(1) > 1e-9
    deviation = torch.where(lost, torch.inf, (shares * spread).sum(1).sqrt())
    weakest = vectors[:, 0] * torch.sign(vectors[vectors[:, 0].abs().argmax(), 0])
    return Sight(
        tuple(axes),
        deviation * scale,
        scaled.diagonal().clamp_min(0).rsqrt() * scale,
        weakest,
        torch.inf if bool(dark[0]) else float(values[0].rsqrt()),
        scale,
    )


def _scales(values, information, name):
    given = torch.as_tensor(values, dtype=torch.float64, device=information.device)
    if information.shape[-2:] != (len(given), len(given)):
        raise ShapeError(
            f"{name} has {len(given)} numbers for an information {tuple(information.shape)}; give one per velocity."
        )
    if not bool(((given > 0) & given.isfinite()).all()):
        raise DomainError(f"{name} is {given.tolist()}; finite numbers > 0 are needed (m/s, rad/s).")
    return given
