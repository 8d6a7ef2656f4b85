"""Windows of events with exact flow, made on the fly: flat layers of texture before a moving
camera, hard events, sensor noise.

Every sample is drawn from its own random numbers (seed, index), so it is the same in any batch, on
any
process: frames, events and flow to the last bit on one machine, the volume to the rounding of its
  sums.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.events import from_counts, memory
from codesign.types import FlowField, FlowWindows
from scenes.windows import motion as motions
from scenes.windows import textures
from scenes.windows.layers import (
    Layer,
    Plane,
    compose,
    cover,
    gaussian,
    mirrored,
    pixels,
    topmost,
)

LEAD = 8  # frames before the window, over which the memorised levels are driven
BLUR_LEAST_PX = 0.4  # the pixel's own area
DARKEST = 1e-3  # radiance on the 0..255 scale
PROBES = 48  # looks at the motion for where a packet ends
SHORTEST = 1e-3  # packet, of the motion that is drawn
PACKET_LEAD = 0.3  # of the motion, over which memorised levels are driven before a packet
ONE_PLANE = {
    "similarity": motions.similarity,
    "rotation": motions.rotation,
    "vibration": motions.vibration,
    "zoom": motions.zoom,
    "roll": motions.roll,
    "out_and_back": motions.out_and_back,
}
MOTIONS = (*ONE_PLANE, "camera", "warps")


@dataclass(frozen=True)
class Draws:
    """Ranges (least, most) from which a sample is drawn.

    Args:
      textures: pool of scenes.windows.textures.
      motion: "similarity" (one plane; rotation, zoom, translation), "rotation" (a camera that
        turns), "vibration" (one that shakes), "zoom", "roll", "out_and_back", "camera" (tilted
        planes, perspective) or "warps" (layers that bend).
      layers: planes before the background.
      flow_px: see scenes.windows.motion.
      theta: contrast threshold, drawn evenly in its logarithm.
      mismatch: relative spread of thresholds over pixels.
      noise: background events per pixel, polarity and eighth of the window, evenly in the
        logarithm.
      contrast: factor on log radiance.
      scale: texels per pixel.
      blur_px: Gaussian defocus, standard deviation.
      distortion: radial, relative at the corner.
      on_over_off: ratio of the thresholds, evenly in the logarithm, half of it to either.
    """

    textures: str = "procedural"
    motion: str = "camera"
    layers: tuple[int, int] = (0, 3)
    flow_px: tuple[float, float] = (0.0, 8.0)
    theta: tuple[float, float] = (0.08, 0.3)
    mismatch: float = 0.03
    noise: tuple[float, float] = (0.0005, 0.01)
    contrast: tuple[float, float] = (0.6, 1.2)
    scale: tuple[float, float] = (0.7, 1.6)
    blur_px: tuple[float, float] = (0.0, 0.8)
    distortion: tuple[float, float] = (-0.04, 0.04)
    on_over_off: tuple[float, float] = (1.0, 1.0)


def planes(textures="fine", theta=0.2, noise=(0.0005, 0.01)):
    """The plain test case: one plane, rotation, zoom and translation up to 6 px, nothing else
    varied."""
    return Draws(
        textures,
        "similarity",
        layers=(0, 0),
        flow_px=(0.0, 6.0),
        theta=(theta, theta),
        noise=noise,
        contrast=(1.0, 1.0),
        scale=(0.8, 1.2),
        blur_px=(0.0, 0.0),
        distortion=(0.0, 0.0),
    )


class Windows:
    """Source of FlowWindows of interval 1 s; what makes one says how in ``_window``.

    Args:
      seed: other seeds give other samples.
      bins: time bins.
      intervals: frame intervals of a window.
    """

    def __init__(self, seed: int, bins: int, intervals: int) -> None:
        self.seed = seed
        self.bins = bins
        self.intervals = intervals

    def batch(self, indices: Sequence[int]) -> FlowWindows:
        """Samples of these numbers."""
        made = [self._window(int(index)) for index in indices]
        seen, flow, valid, frames = zip(*made, strict=True)
        t_s = torch.linspace(0, 1, self.intervals + 1, dtype=torch.float64)
        return FlowWindows(
            from_counts(self._counts(seen), t_s, self.bins),
            FlowField(torch.stack(flow), torch.stack(valid), 1.0),
            torch.stack(frames),
        )

    def _window(self, index: int) -> tuple[Any, Tensor, Tensor, Tensor]:
        """Counts [intervals, 2, H, W] (or what ``_counts`` makes them of), flow [2, H, W] on the
        pixels of the start, where it holds [H, W], and the frames at both ends [2, H, W]."""
        raise NotImplementedError

    def _counts(self, seen: Sequence[Any]) -> Tensor:
        """Counts [intervals, 2, B, H, W] of all samples."""
        return torch.stack(list(seen), 2)


@dataclass(frozen=True)
class Sample:
    """What was drawn for a window. theta: [2, H, W]. noise: [4, N] interval, polarity, row,
    column."""

    layers: list[Layer]
    distortion: float
    contrast: float
    theta: Tensor
    noise: Tensor


class RenderedWindows(Windows):
    """Truth is exact and valid everywhere (also where the point gets hidden).

    Args:
      draws: Draws.
      height_px, width_px: size. Others as Windows.
    """

    def __init__(self, draws=None, *, seed=0, height_px=64, width_px=64, bins=8, intervals=32):
        super().__init__(seed, bins, intervals)
        self.draws = draws or Draws()
        self.height_px = height_px
        self.width_px = width_px
        if self.draws.motion not in MOTIONS:
            raise DomainError(
                f"motion is {self.draws.motion!r}; {', '.join(MOTIONS)} are possible."
            )
        if self.draws.motion in ONE_PLANE and self.draws.layers[1] > 0:
            raise DomainError(
                f"motion {self.draws.motion!r} has one plane; give layers=(0, 0), or motion='camera'."
            )
        self.textures = textures.pool(self.draws.textures)
        self.crop = int(1.5 * max(height_px, width_px) * self.draws.scale[1]) + 16
        self.t = np.concatenate([np.arange(-LEAD, 0), np.arange(intervals + 1)]) / intervals

    def _window(self, index):
        sample = self._draw(index, self._times(index))
        points = self._undistorted(sample.distortion)
        frames = compose(sample.layers, points)
        seen = (self._level(sample, frames), sample.theta, sample.noise)
        return seen, *self._truth(sample, points), frames[[LEAD, -1]]

    def _level(self, sample, frames):
        """Log radiance [T, H, W] of a sample's frames, with its contrast."""
        return frames.clamp_min(DARKEST).log_() * sample.contrast

    def _counts(self, seen):
        """Of ideal pixels: (log radiance [T, H, W], thresholds, noise) of every sample; all at
        once, which is cheaper."""
        levels, thetas, noises = zip(*seen, strict=True)
        counts, _ = memory(torch.stack(levels, 1), *torch.stack(thetas, 1), log_input=True)
        counts = counts[LEAD:]
        for number, (time, polarity, row, column) in enumerate(noises):
            where = (time, polarity, torch.full_like(time, number), row, column)
            counts.index_put_(where, torch.ones(len(time)), accumulate=True)
        return counts

    def _times(self, index):
        """Times of the frames of a sample, those before the window among them; the motion drawn
        lasts from 0 to 1."""
        del index
        return self.t

    def _draw(self, index, t):
        d = self.draws
        draw = np.random.default_rng((self.seed, index))
        shape = (self.height_px, self.width_px)
        size = (self.width_px, self.height_px)
        count = 1 + int(draw.integers(d.layers[0], d.layers[1] + 1))
        if d.motion == "warps":
            motion = motions.warps(draw, t, *size, d.flow_px, count)
        else:
            matrices = (
                motions.camera(draw, t, *size, d.flow_px, count)
                if d.motion == "camera"
                else ONE_PLANE[d.motion](draw, t, *size, d.flow_px)
            )
            motion = [Plane(layer) for layer in torch.from_numpy(matrices).float()]
        blur_px = np.hypot(BLUR_LEAST_PX, draw.uniform(*d.blur_px))
        layers = []
        for number, moved in enumerate(motion):
            crop, place = self._texture(draw, number > 0, blur_px)
            layers.append(Layer(moved, crop, torch.from_numpy(place).float()))
        theta = log_uniform(draw, *d.theta)
        thetas = theta * np.clip(1 + d.mismatch * draw.standard_normal((2, *shape)), 0.2, None)
        rate = log_uniform(draw, *d.noise) * 8 if d.noise[1] > 0 else 0.0
        events = draw.poisson(rate * 2 * shape[0] * shape[1])
        noise = np.stack([draw.integers(0, high, events) for high in (self.intervals, 2, *shape)])
        distortion = draw.uniform(*d.distortion)
        contrast = draw.uniform(*d.contrast)
        ratio = log_uniform(draw, *d.on_over_off) ** 0.5
        thetas *= np.array([ratio, 1 / ratio])[:, None, None]
        return Sample(
            layers, distortion, contrast, torch.from_numpy(thetas).float(), torch.from_numpy(noise)
        )

    def _texture(self, draw, covering, blur_px):
        """A piece of a texture with its cover [2, C, C], blurred, and where pixels lie on it, [3,
        3], turned and mirrored at random. The radiance of one that does not cover everything is
        weighted with its cover."""
        texture = self.textures[draw.integers(len(self.textures))]
        size = min(self.crop, *texture.shape)
        top, left = (int(draw.integers(0, extent - size + 1)) for extent in texture.shape)
        values = torch.from_numpy(
            np.ascontiguousarray(texture[top : top + size, left : left + size])
        )
        piece = torch.ones(2, self.crop, self.crop)
        piece[0] = mirrored(values, self.crop)
        scale = draw.uniform(*self.draws.scale)
        angle = draw.uniform(0, 2 * np.pi)
        flip = draw.choice([-1.0, 1.0])
        if covering:
            piece[1] = cover(draw, self.crop, scale, min(self.height_px, self.width_px))
            piece[0] *= piece[1]
        turn = np.array(
            [[np.cos(angle), -np.sin(angle) * flip], [np.sin(angle), np.cos(angle) * flip]]
        )
        place = np.eye(3)
        place[:2, :2] = scale * turn * 2 / self.crop
        return gaussian(piece, blur_px * scale), place

    def _undistorted(self, distortion):
        """Where an ideal pinhole would see what each pixel sees, [H, W, 2]: x (1 + k r^2), r = 1 at
        the corner."""
        at = pixels(self.height_px, self.width_px)
        radius2 = at.square().sum(-1) / at.square().sum(-1).max()
        return at * (1 + torch.tensor(distortion, dtype=torch.float32) * radius2[..., None])

    def _distorted(self, ideal, distortion):
        """The inverse, by fixed point (contraction factor below 0.15 within twice the image)."""
        at = pixels(self.height_px, self.width_px)
        k = torch.tensor(distortion, dtype=torch.float32) / at.square().sum(-1).max()
        found = ideal
        for _ in range(12):
            found = ideal / (1 + k * found.square().sum(-1, keepdim=True)).clamp_min(0.5)
        return found

    def _truth(self, sample, points):
        """Flow [2, H, W] of the topmost layer at the start, and where it is valid."""
        at = pixels(self.height_px, self.width_px)

        def look(layer):
            end = self._distorted(layer.motion.end(points), sample.distortion)
            return (end - at).movedim(-1, 0), points

        return topmost(sample.layers, look), torch.ones(at.shape[:2], dtype=torch.bool)


class PacketWindows(RenderedWindows):
    """Windows cut as real recordings are: they end where they hold ``events_per_px`` events of the
    scene per pixel, and at the latest where the motion drawn ends.

    So much contrast, fine texture and a low threshold make short windows of little motion; a few
    edges make long ones. Noise comes on top. Args: as RenderedWindows.
    """

    def __init__(self, draws, events_per_px, **sizes):
        super().__init__(draws, **sizes)
        if not events_per_px > 0:
            raise DomainError(f"events_per_px is {events_per_px}; a number > 0 is needed.")
        self.events_per_px = events_per_px

    def _times(self, index):
        lead = np.linspace(-PACKET_LEAD, 0, LEAD, endpoint=False)
        probes = np.linspace(0, 1, PROBES + 1) ** 2  # fine where packets of busy scenes end
        sample = self._draw(index, np.concatenate([lead, probes]))
        level = self._level(sample, compose(sample.layers, self._undistorted(sample.distortion)))
        so_far = self._counts([(level, sample.theta, sample.noise[:, :0])]).sum(
            (1, 2, 3, 4)
        ).cumsum(0).double() / (self.height_px * self.width_px)
        held = torch.cat([so_far.new_zeros(1), so_far]).numpy()
        end = np.interp(self.events_per_px, held, probes) if held[-1] > self.events_per_px else 1.0
        return np.concatenate([lead, max(end, SHORTEST) * np.linspace(0, 1, self.intervals + 1)])


@dataclass(frozen=True)
class Discs:
    """Ranges (least, most) of textured discs before a ground.

    Args:
      count: discs.
      radius_px: of a disc.
      speed_px: of a disc, px per window.
      ground_px: shift of the ground, px per window.
      dim: factor on the ground's log radiance about its mean.
    """

    count: tuple[int, int]
    radius_px: tuple[float, float]
    speed_px: tuple[float, float]
    ground_px: tuple[float, float]
    dim: float


class DiscWindows(RenderedWindows):
    """Discs that each shift by themselves. Args: as RenderedWindows; discs: Discs."""

    def __init__(self, draws: Draws, discs: Discs, **sizes: Any) -> None:
        super().__init__(draws, **sizes)
        self.discs = discs

    def _draw(self, index, t):
        sample = super()._draw(index, t)
        d = self.discs
        draw = np.random.default_rng((self.seed, index, 2))
        size = np.array([self.width_px, self.height_px])
        count = int(draw.integers(d.count[0], d.count[1] + 1))
        ground = sample.layers[0]
        radiance, whole = ground.crop
        level = radiance.clamp_min(1.0).log()
        mean = level.mean()
        dim = torch.stack([(mean + d.dim * (level - mean)).exp(), whole])
        layers = [Layer(_shift(draw, t, d.ground_px), dim, ground.place)]
        for _ in range(count):
            crop, place = self._texture(draw, False, BLUR_LEAST_PX)
            radius = draw.uniform(*d.radius_px)
            centre = draw.uniform(-0.5, 0.5, 2) * (size - 2 * radius)
            scale = float(np.hypot(*place[:2, 0])) * self.crop / 2
            y, x = np.mgrid[: self.crop, : self.crop] - (self.crop - 1) / 2
            round_cover = torch.from_numpy((np.hypot(x, y) < radius * scale).astype(np.float32))
            round_cover = gaussian(round_cover[None], BLUR_LEAST_PX * scale)[0]
            to_middle = np.eye(3)
            to_middle[:2, 2] = -centre
            layers.append(
                Layer(
                    _shift(draw, t, d.speed_px),
                    torch.stack([crop[0] * round_cover, round_cover]),
                    torch.from_numpy(place @ to_middle).float(),
                )
            )
        return replace(sample, layers=layers)


def _shift(draw, t, length_px):
    angle = draw.uniform(0, 2 * np.pi)
    way = draw.uniform(*length_px) * np.array([np.cos(angle), np.sin(angle)])
    matrices = np.tile(np.eye(3), (len(t), 1, 1))
    matrices[:, :2, 2] = np.outer(t, way)
    return Plane(torch.from_numpy(matrices).float())


def log_uniform(draw, least, most):
    """Drawn evenly in the logarithm."""
    return float(np.exp(draw.uniform(np.log(least), np.log(most))))
