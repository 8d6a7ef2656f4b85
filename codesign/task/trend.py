"""How well flow is known where it is longer or nearer, in the mean over textures: the part of the gradient of its
precision that is not the draw's.

The precision that an estimator gives a window jumps with the texture under it: moved by a pixel, the picture has other
edges. Its derivative to a pose is that jump times hundreds of pixels per radian, and has no mean. What goes on when the
jumps are averaged is that flow is told better where there is more of it, until it is too fast, where the surface and its
texture are near, and where the robot's own body, whose image stands still, does not reach into the window. That trend is
fitted over all points seen so far, and is followed instead.
"""

from dataclasses import replace

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.flow.checks import check_number
from codesign.task.ego_velocity import Readings

LEAST_PX = 0.5  # flow below which a length says no more
LEAST_PER_M = 0.3  # nearness below which a distance says no more
RIDGE = 1e-5
SURE = 1e-4  # of a confidence from 0 and 1


class PrecisionTrend:
    """Regression of the logarithm of precision, and of the log odds of confidence, on flow length (third order), nearness, and
    the share of the window that the body covers (second).

    >>> trend = PrecisionTrend()

    forget: share of what was seen before that each ``add`` leaves out, 0 for none. Raises: DomainError for no share.
    """

    def __init__(self, forget: float = 0.0) -> None:
        self.forget = check_number(forget, "forget", least=0.0)
        if self.forget > 1:
            raise DomainError(f"forget is {forget:g}; a share from 0 to 1 is needed.")
        self._normal: Tensor | None = None
        self._right: Tensor | None = None

    @torch.no_grad()
    def add(self, read: Readings, flow_px: Tensor, covered: Tensor | None = None) -> "PrecisionTrend":
        """Take in readings whose true flow is [N, P, 2] px; points without a surface are left out.

        covered: share of each window that the robot's own body covers, [windows] (``OwnBody.covered``) or [N, windows].
        """
        seen = read.share > 0
        terms = _terms(read, flow_px, covered)[seen]
        wanted = torch.stack([0.5 * torch.logdet(read.precision), _log_odds(read.confidence)], -1)[seen]
        normal, right = terms.mT @ terms, terms.mT @ wanted
        kept = 1 - self.forget
        self._normal = normal if self._normal is None else kept * self._normal + normal
        self._right = right if self._right is None else kept * self._right + right
        return self

    def followed(self, read: Readings, flow_px: Tensor, covered: Tensor | None = None) -> Readings:
        """The same readings, whose precision and confidence have the gradient of the trend to flow, depth and cover.

        Raises: DomainError where nothing has been added.
        """
        said = _terms(read, flow_px, covered) @ self._coefficients()
        change = said - said.detach()
        precision = read.precision.detach() * change[..., 0].exp()[..., None, None]
        confidence = torch.sigmoid(_log_odds(read.confidence.detach()) + change[..., 1])
        return replace(read, precision=precision, confidence=confidence)

    def _coefficients(self):
        if self._normal is None:
            raise DomainError("the trend of precision has seen no readings; add some before it is followed.")
        weight = self._normal[0, 0].clamp_min(1)  # the number of points: the first term is 1
        ridge = RIDGE * weight * torch.eye(len(self._normal), dtype=self._normal.dtype)
        return torch.linalg.solve(self._normal + ridge, self._right)


def _terms(read, flow_px, covered):
    """[N, P, 10] of true flow, depth and cover."""
    length = ((flow_px.square().sum(-1) + 1e-12).sqrt() + LEAST_PX).log()
    near = torch.where(read.depth_m.isfinite(), 1 / read.depth_m, 0.0)
    nearness = (near.clamp_min(0) + LEAST_PER_M).log()
    one = torch.ones_like(length)
    terms = [one, length, length**2, length**3, nearness, nearness**2]
    hidden = torch.zeros_like(length)
    if covered is not None:
        hidden = covered.to(length).expand(len(length), read.windows)
        hidden = hidden.repeat_interleave(length.shape[1] // read.windows, 1)
    return torch.stack([*terms, length * nearness, length**2 * nearness, hidden, hidden**2], -1)


def _log_odds(confidence):
    inside = confidence.clamp(SURE, 1 - SURE)
    return (inside / (1 - inside)).log()
