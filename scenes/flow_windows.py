"""Windows of events with exact flow, made on the fly: flat layers of texture before a moving camera, hard
events, sensor noise.

Every sample is drawn from its own random numbers (seed, index), so it is the same in any batch, on any
process: frames, events and flow to the last bit on one machine, the volume to the rounding of its sums.
"""

from dataclasses import dataclass

import numpy as np
import torch

from codesign.errors import DomainError
from codesign.events import from_counts, memory
from codesign.types import FlowField, FlowWindows
from scenes import flow_motion, flow_textures
from scenes.flow_layers import Plane, apply, compose, cover, gaussian, lookup, mirrored
from scenes.flow_warps import warps

LEAD = 8  # frames before the window, over which the memorised levels settle
BLUR_LEAST_PX = 0.4  # the pixel's own area
ONE_PLANE = {
    "similarity": flow_motion.similarity,
    "rotation": flow_motion.rotation,
    "vibration": flow_motion.vibration,
    "zoom": flow_motion.zoom,
    "roll": flow_motion.roll,
    "out_and_back": flow_motion.out_and_back,
}
MOTIONS = (*ONE_PLANE, "camera", "warps")


@dataclass(frozen=True)
class Draws:
    """Ranges (least, most) from which a sample is drawn.

    textures: pool of scenes.flow_textures. motion: "similarity" (one plane; rotation, zoom, translation),
      "rotation" (a camera that turns), "vibration" (one that shakes), "zoom", "roll", "out_and_back", "camera"
      (tilted planes, perspective) or "warps" (layers that bend).
    layers: planes before the background. flow_px: see scenes.flow_motion. theta: contrast threshold, drawn
      evenly in its logarithm. mismatch: relative spread of thresholds over pixels. noise: background events
      per pixel, polarity and eighth of the window, evenly in the logarithm. contrast: factor on log radiance.
      scale: texels per pixel. blur_px: Gaussian defocus, standard deviation. distortion: radial, relative at
      the corner. on_over_off: ratio of the thresholds, evenly in the logarithm, half of it to either.
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
    """The plain test case: one plane, rotation, zoom and translation up to 6 px, nothing else varied."""
    return Draws(
        textures,
        "similarity",
        (0, 0),
        (0.0, 6.0),
        (theta, theta),
        0.03,
        noise,
        (1.0, 1.0),
        (0.8, 1.2),
        (0.0, 0.0),
        (0.0, 0.0),
    )


class RenderedWindows:
    """Source of FlowWindows: ``batch(indices)``.

    Args: draws: Draws. seed: other seeds give other samples. height_px, width_px: size. bins: time bins.
      intervals: frames per window.
    """

    def __init__(self, draws=None, *, seed=0, height_px=64, width_px=64, bins=8, intervals=32):
        self.draws = draws or Draws()
        self.seed = seed
        self.height_px = height_px
        self.width_px = width_px
        self.bins = bins
        self.intervals = intervals
        if self.draws.motion not in MOTIONS:
            raise DomainError(f"motion is {self.draws.motion!r}; {', '.join(MOTIONS)} are possible.")
        if self.draws.motion in ONE_PLANE and self.draws.layers[1] > 0:
            raise DomainError(
                f"motion {self.draws.motion!r} has one plane; give layers=(0, 0), or motion='camera'."
            )
        self.textures = flow_textures.pool(self.draws.textures)
        self.crop = int(1.5 * max(height_px, width_px) * self.draws.scale[1]) + 16
        self.t = np.concatenate([np.arange(-LEAD, 0), np.arange(intervals + 1)]) / intervals

    def batch(self, indices):
        """Samples of these numbers: FlowWindows of interval 1 s, truth on the pixels of the start, exact and
        valid everywhere (also where the point gets hidden)."""
        drawn = [self._draw(index, self._times(index)) for index in indices]
        frames = []
        levels = []
        truth = []
        for sample in drawn:  # one by one: products and logarithms may round by the place in a batch
            points = self._undistorted([sample["distortion"]])[0]  # [H, W, 2]
            frames.append(compose(sample, points))
            levels.append(log_level(frames[-1], sample))
            truth.append(self._truth(sample, points))
        frames = torch.stack(frames, 1)  # [T, B, H, W]
        level = torch.stack(levels, 1)
        theta = torch.stack([sample["theta"] for sample in drawn], 1)  # [2, B, H, W]
        counts, _ = memory(level, theta[0], theta[1], log_input=True)
        counts = counts[LEAD:]
        for number, sample in enumerate(drawn):
            time, polarity, row, column = sample["noise"]
            counts.index_put_(
                (time, polarity, torch.full_like(time, number), row, column),
                torch.ones(len(time)),
                accumulate=True,
            )
        t_s = torch.linspace(0, 1, self.intervals + 1, dtype=torch.float64)
        flow = torch.stack(truth)
        return FlowWindows(
            from_counts(counts, t_s, self.bins),
            FlowField(flow, torch.ones_like(flow[:, 0], dtype=torch.bool), 1.0),
            frames[[LEAD, -1]].transpose(0, 1),
        )

    def _times(self, index):
        """Times of the frames of a sample, those before the window among them; the motion drawn lasts from 0
        to 1."""
        del index
        return self.t

    def _draw(self, index, t):
        d = self.draws
        draw = np.random.default_rng((self.seed, int(index)))
        shape = (self.height_px, self.width_px)
        extra = int(draw.integers(d.layers[0], d.layers[1] + 1))
        size = (self.width_px, self.height_px)
        if d.motion == "warps":
            motion = warps(draw, t, *size, d.flow_px, 1 + extra)
        else:
            matrices = (
                flow_motion.camera(draw, t, *size, d.flow_px, 1 + extra)
                if d.motion == "camera"
                else ONE_PLANE[d.motion](draw, t, *size, d.flow_px)
            )
            motion = [Plane(layer) for layer in torch.from_numpy(matrices).float()]
        blur_px = np.hypot(BLUR_LEAST_PX, draw.uniform(d.blur_px[0], d.blur_px[1]))
        crops, places = zip(*[self._layer(draw, layer, blur_px) for layer in range(1 + extra)], strict=True)
        theta = _log_uniform(draw, *d.theta)
        thetas = theta * np.clip(1 + d.mismatch * draw.standard_normal((2, *shape)), 0.2, None)
        rate = _log_uniform(draw, *d.noise) * 8 if d.noise[1] > 0 else 0.0
        count = draw.poisson(rate * 2 * shape[0] * shape[1])
        noise = np.stack([draw.integers(0, high, count) for high in (self.intervals, 2, *shape)])
        distortion = draw.uniform(d.distortion[0], d.distortion[1])
        contrast = float(draw.uniform(d.contrast[0], d.contrast[1]))
        ratio = _log_uniform(draw, *d.on_over_off) ** 0.5
        thetas *= np.array([ratio, 1 / ratio])[:, None, None]
        return {
            "motion": motion,
            "crop": torch.stack(crops),
            "place": torch.from_numpy(np.stack(places)).float(),
            "distortion": distortion,
            "contrast": contrast,
            "theta": torch.from_numpy(thetas).float(),
            "noise": torch.from_numpy(noise),
        }

    def _layer(self, draw, layer, blur_px):
        """A piece of a texture with its cover [2, C, C], blurred, and where pixels at t = 0 lie on it, in
        grid_sample's units [3, 3]."""
        texture = self.textures[draw.integers(len(self.textures))]
        size = min(self.crop, *texture.shape)
        top, left = (int(draw.integers(0, extent - size + 1)) for extent in texture.shape)
        piece = torch.zeros(2, self.crop, self.crop)
        piece[1] = 1.0
        values = torch.from_numpy(np.ascontiguousarray(texture[top : top + size, left : left + size]))
        piece[0] = mirrored(values, self.crop)
        scale = draw.uniform(*self.draws.scale)
        angle = draw.uniform(0, 2 * np.pi)
        flip = draw.choice([-1.0, 1.0])
        if layer:
            piece[1] = cover(draw, self.crop, scale, min(self.height_px, self.width_px))
        piece = gaussian(
            piece * torch.stack([piece[1], torch.ones_like(piece[1])]), blur_px * scale
        )  # radiance weighted with cover
        turn = scale * np.array(
            [[np.cos(angle), -np.sin(angle) * flip], [np.sin(angle), np.cos(angle) * flip]]
        )
        place = np.eye(3)
        place[:2, :2] = turn * 2 / self.crop
        return piece, place

    def _pixels(self):
        y, x = torch.meshgrid(
            torch.arange(self.height_px) - (self.height_px - 1) / 2,
            torch.arange(self.width_px) - (self.width_px - 1) / 2,
            indexing="ij",
        )
        return torch.stack([x, y], -1)

    def _undistorted(self, distortions):
        """Where an ideal pinhole would see what each pixel sees, centred px [B, H, W, 2]: x (1 + k r^2), r =
        1 at the corner."""
        pixels = self._pixels()
        radius2 = pixels.square().sum(-1) / pixels.square().sum(-1).max()
        return pixels * (
            1 + torch.tensor(distortions, dtype=torch.float32)[:, None, None, None] * radius2[..., None]
        )

    def _distorted(self, ideal, distortions):
        """The inverse, by fixed point (contraction factor below 0.15 within twice the image)."""
        k = (
            torch.tensor(distortions, dtype=torch.float32)[:, None, None, None]
            / self._pixels().square().sum(-1).max()
        )
        found = ideal
        for _ in range(12):
            found = ideal / (1 + k * found.square().sum(-1, keepdim=True)).clamp_min(0.5)
        return found

    def _truth(self, sample, points):
        """Flow [2, H, W] of the topmost layer at the start."""
        pixels = self._pixels()
        flow = None
        for motion, crop, place in zip(sample["motion"], sample["crop"], sample["place"], strict=True):
            end = self._distorted(motion.end(points)[None], [sample["distortion"]])[0]
            moved = (end - pixels).movedim(-1, 0)
            if flow is None:
                flow = moved
            else:
                covered = lookup(crop[None, 1:], apply(place, points)[None])[0, 0]
                flow = torch.where(covered > 0.5, moved, flow)
        return flow


def log_level(frames, sample):
    """Log radiance [T, H, W] of a sample's frames, with its contrast."""
    return frames.clamp_min(1e-3).log_() * sample["contrast"]


def _log_uniform(draw, least, most):
    return float(np.exp(draw.uniform(np.log(least), np.log(most))))
