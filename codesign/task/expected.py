"""The error of a velocity that its flow lets expect: an objective that points where the error of the hard sensor falls,
without the noise of single draws.

Least squares makes of flow f = c J v + e the velocity M^-1 J^T W f with M = c J^T W J + L, L the prior's precision. Its
error is M^-1 (J^T W (f - c J v) - L v), so with flow errors of mean b and covariance V per point it has

    mean  M^-1 (J^T W b - L v),   covariance  M^-1 (J^T W V W J) M^-1.

V is what the flow's estimator claims, and what it does not know of: a share of the flow's length (windows are not affine,
pictures change), and a flow of which nothing is left once it is beyond the estimator's reach; both are taken of J v
rather than of the c J v that the estimator would read, and as independent from point to point, though flow that is lost
is drawn to zero in whole windows. b is the flow that the
estimator of the velocity expects wrongly, because it believes in another depth than there is. What only single draws
know, in which way an error points, is not in it: of that the gradient would change its sign with every pixel by which
the picture shifts.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.flow.checks import check_number
from codesign.task.ego_velocity import EgoVelocity, Readings


@dataclass(frozen=True)
class FlowErrors:
    """Errors of flow beyond the covariance that its estimator claims.

    claimed: factor on the claimed deviation. share: deviation per component, of the flow's length. reach_px: flow of
    this length is lost half of the time; width_px: by which the odds of that grow to e times.
    """

    claimed: float = 1.0
    share: float = 0.05
    reach_px: float = 20.0
    width_px: float = 3.0

    def __post_init__(self):
        for name in ("claimed", "share"):
            check_number(getattr(self, name), name, least=0.0)
        for name in ("reach_px", "width_px"):
            check_number(getattr(self, name), name, above=0.0)

    def covariance(self, read: Readings, flow_px: Tensor) -> Tensor:
        """[N, P, 2, 2] px^2 of the errors at readings whose true flow is [N, P, 2] px. Gradient: both."""
        squared = flow_px.square().sum(-1)
        length = (squared + 1e-12).sqrt()
        lost = torch.sigmoid((length - self.reach_px) / self.width_px)
        unknown = (self.share**2 + lost / 2) * squared
        claimed = self.claimed**2 * read.confidence[..., None, None] * torch.linalg.inv(read.precision)
        return claimed + unknown[..., None, None] * torch.eye(2, dtype=claimed.dtype, device=claimed.device)


@dataclass(frozen=True)
class Expected:
    """What flow lets expect of N estimates of K velocities: mean [N, K] and covariance [N, K, K] of their errors, m/s and
    rad/s."""

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

    Args: estimator: whose prior, axes and outliers count. read: what it reads. twist: [N, 6] true, m/s and rad/s.
      true_rows: [N, P, 2, K] px of flow per velocity at the true depth, where the estimator believes in another one;
      None: ``read.rows``. errors: of the flow.
    Outliers count less by the mean of the squared misfit to be expected of a component, where the estimator goes by that
    of the draw.
    Gradient: readings, twist, rows. Raises: DomainError for readings whose depth is estimated with the velocity.
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
    pulled = (believed[..., None, None] * (weighed @ wrong[..., None])).sum(1) - prior @ velocity[:, 0]
    return Expected((inverse @ pulled)[..., 0], inverse @ scatter @ inverse)
