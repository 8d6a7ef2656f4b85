"""Families of windows that estimators of flow fail on: approach, roll, bodies before still ground, stripes, motion
that turns back, packets of few events, and noise alone."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from scenes.flow_layers import Plane, gaussian
from scenes.flow_packets import PacketWindows
from scenes.flow_sets import EVERYDAY, MOVED
from scenes.flow_windows import BLUR_LEAST_PX, Draws, RenderedWindows

SIDE_PX = 128
DARKEST = 1.0  # radiance on the 0..255 scale


@dataclass(frozen=True)
class Discs:
    """Ranges (least, most) of textured discs before a ground.

    count: discs. radius_px, speed_px: of a disc. ground_px: shift of the ground, px per window. dim: factor on the
      ground's log radiance about its mean.
    """

    count: tuple[int, int]
    radius_px: tuple[float, float]
    speed_px: tuple[float, float]
    ground_px: tuple[float, float]
    dim: float


class DiscWindows(RenderedWindows):
    """Source of FlowWindows of discs that each shift by themselves. Args: as RenderedWindows; discs: Discs."""

    def __init__(self, draws: Draws, discs: Discs, **sizes: Any) -> None:
        super().__init__(draws, **sizes)
        self.discs = discs

    def _draw(self, index, t):
        sample = super()._draw(index, t)
        d = self.discs
        draw = np.random.default_rng((self.seed, int(index), 2))
        size = np.array([self.width_px, self.height_px])
        count = int(draw.integers(d.count[0], d.count[1] + 1))
        ground = sample["crop"][0]
        radiance, cover = ground
        mean = radiance.clamp_min(DARKEST).log().mean()
        crops = [torch.stack([(mean + d.dim * (radiance.clamp_min(DARKEST).log() - mean)).exp(), cover])]
        places = [sample["place"][0]]
        motion = [self._shift(draw, t, d.ground_px)]
        for _ in range(count):
            crop, place = self._layer(draw, 0, BLUR_LEAST_PX)
            radius = draw.uniform(*d.radius_px)
            centre = draw.uniform(-0.5, 0.5, 2) * (size - 2 * radius)
            scale = float(np.hypot(*place[:2, 0])) * self.crop / 2
            y, x = np.mgrid[: self.crop, : self.crop] - (self.crop - 1) / 2
            round_cover = torch.from_numpy((np.hypot(x, y) < radius * scale).astype(np.float32))
            round_cover = gaussian(round_cover[None], BLUR_LEAST_PX * scale)[0]
            crops.append(torch.stack([crop[0] * round_cover, round_cover]))
            to_middle = np.eye(3)
            to_middle[:2, 2] = -centre
            places.append(torch.from_numpy(place @ to_middle).float())
            motion.append(self._shift(draw, t, d.speed_px))
        return {**sample, "crop": torch.stack(crops), "place": torch.stack(places), "motion": motion}

    def _shift(self, draw, t, length_px):
        angle = draw.uniform(0, 2 * np.pi)
        matrices = np.tile(np.eye(3), (len(t), 1, 1))
        matrices[:, :2, 2] = np.outer(t, draw.uniform(*length_px) * np.array([np.cos(angle), np.sin(angle)]))
        return Plane(torch.from_numpy(matrices).float())


def _one(motion, size, textures="everyday", **changed):
    draws = replace(MOVED, textures=textures, motion=motion, flow_px=size, layers=(0, 0), **changed)

    def make(seed: int, bins: int) -> RenderedWindows:
        return RenderedWindows(draws, seed=seed, height_px=SIDE_PX, width_px=SIDE_PX, bins=bins)

    return make


def _discs(discs):
    draws = replace(MOVED, textures="everyday", motion="similarity", layers=(0, 0), flow_px=(0.0, 0.0))

    def make(seed: int, bins: int) -> DiscWindows:
        return DiscWindows(draws, discs, seed=seed, height_px=SIDE_PX, width_px=SIDE_PX, bins=bins)

    return make


def _packets(events, height_px, width_px):
    draws = replace(EVERYDAY, motion="camera", layers=(0, 2), theta=(0.12, 0.35), contrast=(0.5, 1.2))

    def make(seed: int, bins: int) -> PacketWindows:
        density = events / (height_px * width_px)
        return PacketWindows(draws, density, seed=seed, height_px=height_px, width_px=width_px, bins=bins)

    return make


HARSH: dict[str, Callable[[int, int], Any]] = {
    "zoom": _one("zoom", (0.1, 0.3), contrast=(0.2, 1.0)),
    "zoom_fine": _one("zoom", (0.1, 0.3), "fine", contrast=(0.1, 0.6)),
    "roll": _one("roll", (0.08, 0.3), contrast=(0.2, 1.0)),
    "roll_fine": _one("roll", (0.08, 0.3), "fine", contrast=(0.1, 0.6)),
    "discs_40": _discs(Discs((1, 1), (18.0, 22.0), (2.0, 6.0), (2.0, 6.0), 1.0)),
    "small_discs": _discs(Discs((1, 6), (5.0, 14.0), (2.0, 8.0), (0.0, 0.0), 0.2)),
    "stripes": _one("similarity", (0.5, 6.0), "stripes"),
    "out_and_back": _one("out_and_back", (2.0, 10.0)),
    "vibration_hard": _one("vibration", (2.0, 8.0)),
    "packets_5k": _packets(5000, 180, 240),
    "noise": _one("similarity", (0.5, 6.0), contrast=(0.0, 0.0), noise=(0.003, 0.06)),
}
"""Name -> function (seed, bins) -> source of FlowWindows."""
