"""The error of a velocity that its flow lets expect: an objective that points where the error of
the hard sensor falls, without the noise of single draws.

Least squares makes of flow f = c J v + e the velocity M^-1 J^T W f with M = c J^T W J + L, L the
prior's precision. Its error is M^-1 (J^T W (f - c J v) - L v), so with flow errors of mean b and
covariance V per point it has

    mean  M^-1 (J^T W b - L v),   covariance  M^-1 (J^T W V W J) M^-1.

V is what the flow's estimator claims, and what it does not know of: a share of the flow's length
(windows are not affine, pictures change), and a flow of which nothing is left once it is beyond the
estimator's reach; both are taken of J v rather than of the c J v that the estimator would read, and
as independent from point to point, though flow that is lost is drawn to zero in whole windows. b is
the flow that the estimator of the velocity expects wrongly, because it believes in another depth
than there is. What only single draws know, in which way an error points, is not in it: of that the
gradient would change its sign with every pixel by which the picture shifts.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.checks import check_number, check_positive
from codesign.errors import DomainError, ShapeError
from codesign.mount.ego_velocity import EgoVelocity, Readings
from codesign.mount.sight import LINEAR, NAMES


@dataclass(frozen=True)
class FlowErrors:
    """Errors of flow beyond the covariance that its estimator claims.

    claimed: factor on the claimed deviation. share: deviation per component, of the flow's length.
      reach_px:
    flow of this length is lost half of the time; width_px: by which the odds of that grow to e
    times.
    """

    claimed: float = 1.0
    share: float = 0.05
    reach_px: float = 20.0
    width_px: float = 3.0

    def __post_init__(self):
        for name in ("claimed", "share"):
            check_number(getattr(self, name), name, least=0.0)
        for name in ("reach_px", "width_px"):
            check_positive(getattr(self, name), name)

    def covariance(self, read: Readings, flow_px: Tensor) -> Tensor:
        """[N, P, 2, 2] px^2 of the errors at readings whose true flow is [N, P, 2] px. Gradient:
        both."""
        squared = flow_px.square().sum(-1)
        length = (squared + 1e-12).sqrt()
        lost = torch.sigmoid((length - self.reach_px) / self.width_px)
        unknown = (self.share**2 + lost / 2) * squared
        claimed = (
            self.claimed**2 * read.confidence[..., None, None] * torch.linalg.inv(read.precision)
        )
        return claimed + unknown[..., None, None] * torch.eye(
            2, dtype=claimed.dtype, device=claimed.device
        )


@dataclass(frozen=True)
class Expected:
    """What flow lets expect of N estimates of K velocities: mean [N, K] and covariance [N, K, K] of
    their errors, m/s and rad/s."""

    mean: Tensor
    covariance: Tensor

    @property
    def squared(self) -> Tensor:
        """[N, K]: mean squared errors."""
        return self.covariance.diagonal(dim1=-2, dim2=-1) + self.mean.square()


def expected_errors(
    estimator: EgoVelocity,
    read: Readings,
    twist: Tensor,
    true_rows: Tensor | None = None,
    errors: FlowErrors = FlowErrors(),
) -> Expected:
    """Errors to be expected of a velocity by least squares.

    Args:
      estimator: whose prior, axes and outliers count.
      read: what it reads.
      twist: [N, 6] true, m/s and rad/s.
      true_rows: [N, P, 2, K] px of flow per velocity at the true depth, where the estimator
        believes in another one; None: ``read.rows``.
      errors: of the flow.
    Outliers count less by the mean of the squared misfit to be expected of a component, where the
    estimator goes by that of the draw.
    Gradient: readings, twist, rows. Raises: DomainError for readings whose depth is estimated with
      the velocity.
    """
    if read.parallax is not None:
        raise DomainError(
            "errors are expected of velocities whose depth is known; give the estimator a depth."
        )
    velocity = twist[:, list(estimator.axes)].to(read.flow_px)[:, None, :, None]
    rows = read.rows if true_rows is None else true_rows
    flow_px = (rows @ velocity)[..., 0]
    covariance = errors.covariance(read, flow_px)
    wrong = read.confidence[..., None] * (flow_px - (read.rows @ velocity)[..., 0])
    second = covariance + wrong[..., :, None] * wrong[..., None, :]
    misfit = (read.precision * second).sum((-2, -1))  # E e^T W e: 2 c where the claim is right
    kept = 1.0 if estimator.outlier is None else (1 + misfit / 2 / estimator.outlier**2) ** -2
    believed = kept * read.share
    weighed = read.rows.mT @ read.precision  # [N, P, K, 2]
    prior = torch.diag(read.flow_px.new_tensor(estimator.prior) ** -2)
    normal = ((believed * read.confidence)[..., None, None] * (weighed @ read.rows)).sum(1) + prior
    inverse = torch.linalg.inv(normal)
    scatter = ((believed * kept)[..., None, None] * (weighed @ covariance @ weighed.mT)).sum(1)
    pulled = (believed[..., None, None] * (weighed @ wrong[..., None])).sum(1) - prior @ velocity[
        :, 0
    ]
    return Expected((inverse @ pulled)[..., 0], inverse @ scatter @ inverse)


UNIT_M_S, UNIT_SHARE, UNIT_RAD_S = 0.05, 0.1, 0.15  # errors that count 1
PERCENTILES = (5, 10, 25, 50, 75, 90, 95)


@dataclass(frozen=True)
class VelocityErrors:
    """error: [N, K] estimate less truth, m/s and rad/s. speed_m_s: [N] of the body. axes: K of the
    six velocities."""

    error: Tensor
    speed_m_s: Tensor
    axes: tuple[int, ...]

    @property
    def unit(self) -> Tensor:
        """[N, K]: the error that counts 1: 0.05 m/s plus a tenth of the speed, and 0.15 rad/s."""
        linear = (UNIT_M_S + UNIT_SHARE * self.speed_m_s)[:, None].expand(self.error.shape)
        axes = torch.tensor(self.axes, device=linear.device)
        return torch.where(axes < LINEAR, linear, UNIT_RAD_S)

    def squared(self) -> Tensor:
        """[N]: mean over the velocities of the squared error in units of ``unit``."""
        return (self.error / self.unit).square().mean(1)

    def bounded(self) -> Tensor:
        """[N] in 0..1: q / (1 + q) of ``squared``, in which a lost sample counts 1 and no more."""
        squared = self.squared()
        return squared / (1 + squared)

    def table(self) -> dict[str, dict[str, float]]:
        """Name of the velocity -> rms, bias, median, and percentiles of the size of its error; of
        linear ones also the median over the speed."""
        found = {}
        for column, axis in zip(self.error.detach().T, self.axes, strict=True):
            size = column.abs()
            unit = "m_s" if axis < LINEAR else "rad_s"
            row = {
                f"rms_{unit}": float(size.square().mean().sqrt()),
                f"bias_{unit}": float(column.mean()),
            }
            levels = size.new_tensor(PERCENTILES) / 100
            for percent, value in zip(
                PERCENTILES, torch.quantile(size, levels).tolist(), strict=True
            ):
                row[f"p{percent}_{unit}"] = value
            if axis < LINEAR:
                row["median_over_speed"] = float((size / self.speed_m_s.clamp_min(1e-12)).median())
            found[NAMES[axis]] = row
        return found


def velocity_errors(velocity: Tensor, twist: Tensor, axes: Sequence[int]) -> VelocityErrors:
    """Errors of estimated velocities.

    Args:
      velocity: [N, K] estimated, m/s and rad/s.
      twist: [N, 6] of the body: m/s forward, left, up, rad/s about these axes.
      axes: which K of the six were estimated.
    Gradient: velocity, twist. Raises: ShapeError where they do not fit; DomainError for other axes.

    >>> twist = torch.tensor([[2.0, 0.0, 0.0, 0.0, 0.0, 0.5]])
    >>> errors = velocity_errors(torch.tensor([[1.75, 0.0, 0.5]]), twist, (0, 1, 5))
    >>> errors.squared().tolist()  # a quarter of a metre per second where 0.05 + 0.1 * 2 count 1
    [0.3333333432674408]
    """
    if not axes or not set(axes) <= set(range(len(NAMES))):
        raise DomainError(f"axes = {tuple(axes)}; choose from 0 to 5: {', '.join(NAMES)}.")
    if twist.shape != (len(velocity), len(NAMES)) or velocity.shape != (len(twist), len(axes)):
        raise ShapeError(
            f"velocities are {list(velocity.shape)}, twists {list(twist.shape)}; give [N, {len(axes)}] and [N, 6]."
        )
    speed = torch.linalg.vector_norm(twist[:, :LINEAR], dim=1)
    return VelocityErrors(velocity - twist[:, list(axes)], speed, tuple(axes))
