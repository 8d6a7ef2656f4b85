"""How well flow is known where it is longer or nearer, in the mean over textures: the part of the
gradient of its precision that is not the draw's.

The precision that an estimator gives a window jumps with the texture under it: moved by a pixel,
the picture has other edges. Its derivative to a pose is that jump times hundreds of pixels per
radian, and has no mean. What goes on when the jumps are averaged is that flow is told better where
there is more of it, until it is too fast, where the surface and its texture are near, and where the
robot's own body, whose image stands still, does not reach into the window. That trend is fitted
over all points seen so far, and is followed instead; or, over steps that no slope describes, what
was told from one place is carried to another by it.
"""

from dataclasses import replace

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.mount.ego_velocity import Readings

LEAST_PX = 0.5  # flow below which a length says no more
LEAST_PER_M = 0.3  # nearness below which a distance says no more
RIDGE = 1e-5
SURE = 1e-4  # of a confidence from 0 and 1


class PrecisionTrend:
    """Regression of the logarithm of precision, and of the log odds of confidence, on flow length
    (third order), nearness, and the share of the window that the body covers (second).

    Where lenses differ too, every call is given ``optics`` [N, windows, 2] of its readings
    (``window_optics``):
    nearness then counts in pixels per metre, and blur is a term (second order, and with the
    length).

    >>> trend = PrecisionTrend()
    """

    def __init__(self) -> None:
        self._normal: Tensor | None = None
        self._right: Tensor | None = None

    @torch.no_grad()
    def add(
        self,
        read: Readings,
        flow_px: Tensor,
        covered: Tensor | None = None,
        optics: Tensor | None = None,
    ) -> "PrecisionTrend":
        """Take in readings whose true flow is [N, P, 2] px; points without a surface are left out.

        covered: share of each window that the robot's own body covers, [windows]
          (``OwnBody.covered``) or [N, windows].
        """
        seen = read.share > 0
        terms = _terms(read, flow_px, covered, optics)[seen]
        wanted = torch.stack([_log_precision(read), _log_odds(read.confidence)], -1)[seen]
        normal, right = terms.mT @ terms, terms.mT @ wanted
        self._normal = normal if self._normal is None else self._normal + normal
        self._right = right if self._right is None else self._right + right
        return self

    def followed(self, read: Readings, flow_px: Tensor, covered: Tensor | None = None) -> Readings:
        """The same readings, whose precision and confidence have the gradient of the trend to flow,
        depth and cover.

        Raises: DomainError where nothing has been added.
        """
        told = self.told(read, flow_px, covered)
        change = told - told.detach()
        precision = read.precision.detach() * change[..., 0].exp()[..., None, None]
        confidence = torch.sigmoid(_log_odds(read.confidence.detach()) + change[..., 1])
        return replace(read, precision=precision, confidence=confidence)

    def told(
        self,
        read: Readings,
        flow_px: Tensor,
        covered: Tensor | None = None,
        optics: Tensor | None = None,
    ) -> Tensor:
        """[N, P, 2]: logarithm of precision and log odds of confidence by the trend alone.
        Arguments and errors as ``followed``."""
        return _terms(read, flow_px, covered, optics) @ self._coefficients()

    def carried(
        self,
        here: Readings,
        told_here: Tensor,
        there: Readings,
        told_there: Tensor,
    ) -> Readings:
        """Readings of the same points and textures as if they had been made from another place, no
        picture of which there is.

        Args:
          here: what was read.
          told_here, told_there: what the trend tells of either place (``told``).
          there: depth, rows and share from the other place; its estimates are not looked at.
        Precision and confidence are those of here, changed as the trend tells. A point that shows a
        surface only from there takes what the nearest window with surfaces had beside the trend: a
        mean would be too good, since a window in three without texture says less than all of them
        with a little. Gradient:
        readings of here, what is told.
        """
        seen = here.share > 0
        own = torch.stack([_log_precision(here), _log_odds(here.confidence)], -1)
        beside = own - told_here
        told = (
            torch.where(seen[..., None], beside, _of_nearest_window(here, beside, seen))
            + told_there
        )
        grown = (told - own)[..., 0].exp()[..., None, None] * here.precision
        alone = told[..., 0].exp()[..., None, None] * torch.eye(
            2, dtype=told.dtype, device=told.device
        )
        precision = torch.where(seen[..., None, None], grown, alone)
        return replace(there, precision=precision, confidence=torch.sigmoid(told[..., 1]))

    def _coefficients(self):
        if self._normal is None:
            raise DomainError(
                "the trend of precision has seen no readings; add some before it is followed."
            )
        weight = self._normal[0, 0].clamp_min(1)  # the number of points: the first term is 1
        ridge = RIDGE * weight * torch.eye(len(self._normal)).to(self._normal)
        return torch.linalg.solve(self._normal + ridge, self._right)


def _terms(read, flow_px, covered, optics=None):
    """[N, P, 10] of true flow, depth and cover; [N, P, 13] where the optics are told."""
    length = ((flow_px.square().sum(-1) + 1e-12).sqrt() + LEAST_PX).log()
    near = torch.where(read.depth_m.isfinite(), 1 / read.depth_m, 0.0)
    nearness = (near.clamp_min(0) + LEAST_PER_M).log()
    soft = []
    if optics is not None:
        focal, blur = read.of_windows(optics).unbind(-1)
        nearness = nearness + focal
        soft = [blur, blur**2, blur * length]
    one = torch.ones_like(length)
    terms = [one, length, length**2, length**3, nearness, nearness**2]
    hidden = torch.zeros_like(length)
    if covered is not None:
        hidden = read.of_windows(covered.to(length).expand(len(length), read.windows))
    return torch.stack(
        [*terms, length * nearness, length**2 * nearness, hidden, hidden**2, *soft], -1
    )


def _of_nearest_window(read, values, seen):
    """[N, P, C]: the mean of values over what is seen in the nearest window that shows anything."""
    windows = read.windows
    count = seen.unflatten(1, (windows, -1)).sum(2)  # [N, W]
    total = (values * seen[..., None]).unflatten(1, (windows, -1)).sum(2)
    middle = read.pixels.detach().unflatten(1, (windows, -1)).mean(2)
    away = torch.cdist(middle, middle).masked_fill((count == 0)[:, None], torch.inf)
    lender = away.argmin(2)[..., None].expand(-1, -1, values.shape[-1])
    lent = (total / count.clamp_min(1)[..., None]).gather(1, lender)
    return read.of_windows(lent)


def _log_precision(read):
    return 0.5 * torch.logdet(read.precision)


def _log_odds(confidence):
    inside = confidence.clamp(SURE, 1 - SURE)
    return (inside / (1 - inside)).log()
