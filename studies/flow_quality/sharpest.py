"""Flow of a packet by contrast maximisation, independent of every estimator: a dense search and a
simplex, on single events, with numpy alone.

Source: Gallego, Rebecq, Scaramuzza, A unifying contrast maximization framework for event cameras,
CVPR 2018, with an image for each polarity.
"""

import copy
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from codesign.errors import DomainError

REACH_PX = 16.0  # of the dense search
STEP_PX = 2.0
SEARCHED = 6000  # events looked at in it
COARSE_PX = 2  # a side of the cells of its images
FINE_PX = 1
BLUR = 0.7  # cells
STARTS = 3  # of its best that are refined
# slope of an affine flow, per window: steeper ones could squeeze all events together
STEEPEST = 0.3


@dataclass(frozen=True)
class Sharpest:
    """flow_px: [2, H, W] px over the packet on the pixels of its start. contrast: variance of the
    image it makes, over the unwarped one's."""

    flow_px: np.ndarray
    contrast: float


def rotation(packet, focal_px) -> Sharpest:
    """The turn of a pinhole camera, its axis in the image's middle, that makes the events of a
    packet sharpest.

    Args:
      packet: with stream, t0_us, t1_us.
      focal_px: focal length, px.
    """
    events = _Events(packet)

    def speed(p, x, y):  # p: px at the middle; roll as px at the corner
        wx, wy, roll = p[1] / focal_px, -p[0] / focal_px, p[2] / events.corner_px
        a, b = x / focal_px, y / focal_px
        u = focal_px * (a * b * wx - (1 + a * a) * wy) - roll * y
        v = focal_px * ((1 + b * b) * wx - a * b * wy) + roll * x
        return u, v

    best = _best(events, speed, 3)
    h = np.diag([focal_px, focal_px, 1.0])
    turn = Rotation.from_rotvec(
        [-best[1] / focal_px, best[0] / focal_px, best[2] / events.corner_px]
    )
    x, y = events.pixels()
    seen = np.einsum(
        "ij,jhw->ihw", h @ turn.as_matrix() @ np.linalg.inv(h), np.stack([x, y, np.ones_like(x)])
    )
    return Sharpest(seen[:2] / seen[2] - np.stack([x, y]), events.relative(best, speed))


def affine(packet) -> Sharpest:
    """The affine flow that makes the events of a packet sharpest."""
    events = _Events(packet)
    half = events.corner_px
    limit = STEEPEST * half

    def speed(p, x, y):
        zoom, roll, *shear = limit * np.tanh(p[2:] / limit) / half
        return (
            p[0] + (zoom + shear[0]) * x + (shear[1] - roll) * y,
            p[1] + (shear[1] + roll) * x + (zoom - shear[0]) * y,
        )

    best = _best(events, speed, 6)
    x, y = events.pixels()
    at = np.stack([x, y])
    flow = np.stack(speed(best, x, y))
    # from the middle of the packet, where the fit lives, to the pixels of its start
    for _ in range(8):
        flow = np.stack(speed(best, *(at + flow / 2)))
    return Sharpest(flow, events.relative(best, speed))


def _best(events, speed, count):
    """Parameters of the sharpest image: translations searched densely, the rest by simplex."""
    some = events.some(SEARCHED)
    ticks = np.arange(-REACH_PX, REACH_PX + STEP_PX / 2, STEP_PX)
    tried = np.zeros((len(ticks) ** 2, count))
    tried[:, :2] = np.stack(np.meshgrid(ticks, ticks), -1).reshape(-1, 2)
    scores = np.array([some.contrast(speed(p, some.x, some.y), COARSE_PX) for p in tried])
    starts = tried[np.argsort(-scores)[:STARTS]]
    found = [_climb(some, speed, start, COARSE_PX, STEP_PX) for start in starts]
    best = max(found, key=lambda p: some.contrast(speed(p, some.x, some.y), COARSE_PX))
    return _climb(events, speed, best, FINE_PX, STEP_PX / 4)


def _climb(events, speed, start, cell_px, step_px):
    simplex = np.vstack([start, start + step_px * np.eye(len(start))])
    options = {"initial_simplex": simplex, "xatol": 5e-3, "fatol": 1e-7, "maxiter": 300}
    return minimize(
        lambda p: -events.contrast(speed(p, events.x, events.y), cell_px),
        start,
        method="Nelder-Mead",
        options=options,
    ).x


class _Events:
    """Events of a packet: centred x, y, time from -1/2 to 1/2."""

    def __init__(self, packet):
        stream = packet.stream
        if not len(stream):
            raise DomainError(
                f"the packet {packet.name} holds no event, so nothing can be made sharp."
            )
        self.height = stream.height_px
        self.width = stream.width_px
        self.corner_px = np.hypot(self.height, self.width) / 2
        self.x = stream.x.numpy() - (self.width - 1) / 2
        self.y = stream.y.numpy() - (self.height - 1) / 2
        self.on = (stream.p.numpy() > 0).astype(int)
        self.t = (stream.t_us.numpy() - packet.t0_us) / (packet.t1_us - packet.t0_us) - 0.5

    def some(self, count):
        """Every so many-th event."""
        other = copy.copy(self)
        every = max(1, len(self.x) // count)
        for name in ("x", "y", "t", "on"):
            setattr(other, name, getattr(self, name)[::every])
        return other

    def pixels(self):
        y, x = np.mgrid[: self.height, : self.width].astype(float)
        return x - (self.width - 1) / 2, y - (self.height - 1) / 2

    def contrast(self, flow, cell_px):
        """Variance of the images of the events moved to the middle of the packet, both polarities
        added, on cells of cell_px px.

        Every event is spread by the quadratic B-spline, whose width does not depend on where it
        falls: with bilinear shares the unmoved image, whose events sit on pixels, would be the
        sharpest.
        """
        height, width = (-(-side // cell_px) for side in (self.height, self.width))
        x = (self.x - self.t * flow[0] + self.width / 2) / cell_px - 0.5
        y = (self.y - self.t * flow[1] + self.height / 2) / cell_px - 0.5
        column, share_x = _spread(x)
        row, share_y = _spread(y)
        inside = (column > -2) & (column <= width) & (row > -2) & (row <= height)
        first = ((self.on * (height + 4) + row + 2) * (width + 4) + column + 2)[inside]
        steps = (np.arange(-1, 2)[:, None] * (width + 4) + np.arange(-1, 2)).reshape(9, 1)
        shares = (share_y[:, None] * share_x).reshape(9, -1)[:, inside]
        images = np.bincount(  # OFF, ON, with a margin
            (first + steps).ravel(), shares.ravel(), minlength=2 * (height + 4) * (width + 4)
        )
        images = images.reshape(2, height + 4, width + 4)[:, 2:-2, 2:-2]
        return gaussian_filter(images, (0, BLUR, BLUR)).var((1, 2)).sum()

    def relative(self, parameters, speed):
        still = self.contrast((0.0, 0.0), FINE_PX)
        return self.contrast(speed(parameters, self.x, self.y), FINE_PX) / still


def _spread(place):
    """Nearest pixel, and the shares of it and its neighbours by the quadratic B-spline."""
    nearest = np.floor(place + 0.5).astype(int)
    offset = place - nearest
    shares = ((0.5 - offset) ** 2 / 2, 0.75 - offset**2, (0.5 + offset) ** 2 / 2)
    return nearest, np.stack(shares)
