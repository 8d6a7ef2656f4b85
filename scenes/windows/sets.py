"""The sets of windows that event flow is learnt on and judged on.

Packets of real recordings hold 0.05 to 1 event per pixel, since most of a room is smooth, contrasts
are weak and thresholds high. So a packet of a fixed number of events is cut from a scene of
photographs and of few shapes; the lower its number, the weaker the contrast, so that flows are some
pixels long in all sets.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from scenes.windows.rendered import (
    Discs,
    DiscWindows,
    Draws,
    PacketWindows,
    RenderedWindows,
    Windows,
    planes,
)
from scenes.windows.sensors import Sensors, SensorWindows
from scenes.windows.worlds import WorldWindows

UNSEEN = 1_000_000  # added to the seed of what networks are judged on
SIDE_PX = 96
LARGE_PX = 128
NOISE_SHARE = (0.01, 0.15)  # noise events over those of the scene
WEAK = (0.12, 0.35)  # thresholds
STRONG = (0.05, 0.15)
# events of the scene per pixel -> thresholds, factors on log radiance of single planes and of
# layers
CONTRASTS = {
    0.05: (WEAK, (0.2, 0.6), (0.1, 0.3)),
    0.1: (WEAK, (0.3, 0.8), (0.12, 0.4)),
    0.3: (WEAK, (0.6, 1.2), (0.25, 0.7)),
    1.0: (STRONG, (0.8, 1.6), (0.3, 0.6)),
    3.0: (STRONG, (1.8, 3.5), (0.6, 1.2)),
}
EVERYDAY = Draws(
    "everyday", flow_px=(2.0, 12.0), mismatch=0.05, scale=(1.0, 2.0), on_over_off=(0.8, 1.25)
)
MOVED = replace(EVERYDAY, theta=(0.1, 0.25), contrast=(0.8, 1.6), noise=(0.0005, 0.01))

Make = Callable[[int, int], Windows]


def packets(events_per_px: float, layers: tuple[int, int]) -> Make:
    """Packets of so many events of the scene per pixel, and noise on top. layers: planes before the
    background."""
    # two polarities, eight eighths
    noise = tuple(share * events_per_px / 16 for share in NOISE_SHARE)
    theta, *contrast = CONTRASTS[events_per_px]
    return _packets(
        events_per_px,
        (SIDE_PX, SIDE_PX),
        layers,
        theta=theta,
        contrast=contrast[layers[1] > 0],
        noise=noise,
    )


def _packets(events_per_px, size_px, layers, **changed) -> Make:
    draws = replace(EVERYDAY, motion="camera", layers=layers, **changed)
    height_px, width_px = size_px
    return lambda seed, bins: PacketWindows(
        draws, events_per_px, seed=seed, height_px=height_px, width_px=width_px, bins=bins
    )


def moved(motion, flow_px, layers=(0, 0), textures="mixed", **changed) -> Make:
    """Windows of a motion, at usual densities."""
    draws = replace(
        MOVED, textures=textures, motion=motion, flow_px=flow_px, layers=layers, **changed
    )
    return lambda seed, bins: RenderedWindows(
        draws, seed=seed, height_px=LARGE_PX, width_px=LARGE_PX, bins=bins
    )


def discs(*limits) -> Make:
    """Windows of discs that each move by themselves. limits: of Discs."""
    draws = replace(MOVED, motion="similarity", layers=(0, 0), flow_px=(0.0, 0.0))
    return lambda seed, bins: DiscWindows(
        draws, Discs(*limits), seed=seed, height_px=LARGE_PX, width_px=LARGE_PX, bins=bins
    )


SETS: dict[str, Make] = (
    {f"planes_{density:g}": packets(density, (0, 0)) for density in CONTRASTS}
    | {f"layers_{density:g}": packets(density, (1, 4)) for density in CONTRASTS}
    | {
        "warped": moved("warps", (0.5, 6.0)),
        "many_depths_x1": moved("warps", (0.5, 4.0), (3, 6)),
        "many_depths_x3": moved("warps", (1.5, 12.0), (3, 6)),
        "vibration": moved("vibration", (0.5, 5.0)),
        "rotation": moved("rotation", (0.5, 8.0)),
    }
)
"""Name -> function (seed, bins) -> source of FlowWindows. packets by events per pixel;
"many_depths": several layers, each of which bends, as Middlebury's flows do, and the same flows
three times as long."""

HARSH: dict[str, Make] = {
    "zoom": moved("zoom", (0.1, 0.3), textures="everyday", contrast=(0.2, 1.0)),
    "zoom_fine": moved("zoom", (0.1, 0.3), textures="fine", contrast=(0.1, 0.6)),
    "roll": moved("roll", (0.08, 0.3), textures="everyday", contrast=(0.2, 1.0)),
    "roll_fine": moved("roll", (0.08, 0.3), textures="fine", contrast=(0.1, 0.6)),
    "discs_40": discs((1, 1), (18.0, 22.0), (2.0, 6.0), (2.0, 6.0), 1.0),
    "small_discs": discs((1, 6), (5.0, 14.0), (2.0, 8.0), (0.0, 0.0), 0.2),
    "stripes": moved("similarity", (0.5, 6.0), textures="stripes"),
    "out_and_back": moved("out_and_back", (2.0, 10.0), textures="everyday"),
    "vibration_hard": moved("vibration", (2.0, 8.0), textures="everyday"),
    "packets_5k": _packets(
        5000 / (180 * 240), (180, 240), (0, 2), theta=(0.12, 0.35), contrast=(0.5, 1.2)
    ),
    "noise": moved(
        "similarity", (0.5, 6.0), textures="everyday", contrast=(0.0, 0.0), noise=(0.003, 0.06)
    ),
}
"""Families that estimators of flow fail on: approach, roll, bodies before still ground, stripes,
motion that turns back, packets of few events, and noise alone. Name -> function (seed, bins) ->
source."""


def judging(
    seed: int, bins: int, windows: int, world_windows: int, real_windows: int, more=SETS
) -> dict[str, tuple[Windows, int]]:
    """Name -> source and number of windows of what estimators are judged on: VALIDATION at 64 x 64
    pixels, the 3-D worlds, and further sets."""
    shape = Shape(64, 64, bins)
    found = {name: (make(shape, seed), windows) for name, make in VALIDATION.items()}
    found["worlds"] = (WorldWindows(seed=UNSEEN + seed, bins=bins), world_windows)
    return found | {name: (make(UNSEEN + seed, bins), real_windows) for name, make in more.items()}


@dataclass(frozen=True)
class Shape:
    """Size of a window."""

    height_px: int
    width_px: int
    bins: int

    def __call__(self, draws, seed, side_px=None):
        """Rendered windows of this size, or square ones of another."""
        return RenderedWindows(draws, seed=seed, **self._sizes(side_px))

    def seen_by(self, sensors, draws, seed, side_px=None):
        """The same seen by sensors that all differ."""
        return SensorWindows(draws, sensors, seed=seed, **self._sizes(side_px))

    def _sizes(self, side_px):
        return {
            "height_px": side_px or self.height_px,
            "width_px": side_px or self.width_px,
            "bins": self.bins,
        }


DENSE = Draws(flow_px=(0.5, 7.0), contrast=(0.8, 1.8), theta=(0.08, 0.25))
FLAT = Draws(
    motion="similarity", layers=(0, 0), flow_px=(0.0, 7.0), contrast=(0.7, 1.6), theta=(0.08, 0.25)
)
WIDE = Draws(layers=(1, 4), flow_px=(1.0, 9.0), contrast=(0.8, 1.8), theta=(0.08, 0.25))

LENSES: dict[str, Any] = {"blur_px": (0.0, 1.2), "distortion": (-0.06, 0.06)}
SHORT = Draws(motion="similarity", layers=(0, 0), flow_px=(0.0, 2.5), **LENSES)
PLANES = Draws(motion="similarity", layers=(0, 0), flow_px=(1.0, 7.0), **LENSES)
DEPTHS = Draws(layers=(0, 3), flow_px=(0.5, 8.0), **LENSES)
SHORT_DEPTHS = Draws(layers=(1, 4), flow_px=(0.2, 3.0), **LENSES)
FAST_DEPTHS = Draws(layers=(0, 3), flow_px=(1.0, 10.0), **LENSES)
STIFF = Sensors()
BENDING = Sensors(bend=0.4)


def real(shape, seed):
    """Windows as real sensors give them: planes, layers that bend, short and long flows; and a
    third as ideal ones do."""
    return [
        (0.12, shape.seen_by(STIFF, SHORT, seed)),
        (0.08, shape.seen_by(STIFF, PLANES, seed + 1)),
        (0.22, shape.seen_by(BENDING, DEPTHS, seed + 2)),
        (0.08, shape.seen_by(BENDING, SHORT_DEPTHS, seed + 3)),
        (0.15, shape.seen_by(BENDING, FAST_DEPTHS, seed + 4, SIDE_PX)),
        (0.2, shape(DENSE, seed + 5)),
        (0.1, shape(FLAT, seed + 6)),
        (0.05, shape(WIDE, seed + 7, SIDE_PX)),
    ]


TRAINING: dict[str, Callable[[Shape, int], list]] = {
    "delivered": lambda shape, seed: [
        (0.55, shape(DENSE, seed)),
        (0.25, shape(FLAT, seed + 1)),
        (0.2, shape(WIDE, seed + 2, SIDE_PX)),
    ],
    "real": real,
    "layers": lambda shape, seed: [(1.0, shape(Draws(), seed))],
    "planes": lambda shape, seed: [(1.0, shape(Draws(layers=(0, 0)), seed))],
}
"""Name -> function (shape, seed) -> list of (share of the batches, source)."""

VALIDATION: dict[str, Callable[[Shape, int], Any]] = {
    "fine_theta_0.1": lambda shape, seed: shape(planes("fine", 0.1), seed + UNSEEN),
    "fine_theta_0.2": lambda shape, seed: shape(planes("fine", 0.2), seed + UNSEEN),
    "mixed_theta_0.1": lambda shape, seed: shape(planes("mixed", 0.1), seed + UNSEEN),
    "mixed_theta_0.2": lambda shape, seed: shape(planes("mixed", 0.2), seed + UNSEEN),
    "layers": lambda shape, seed: shape(
        replace(DENSE, textures="mixed", layers=(1, 3)), seed + UNSEEN
    ),
}
"""Name -> function (shape, seed) -> source; textures and seeds that no training mix uses."""
