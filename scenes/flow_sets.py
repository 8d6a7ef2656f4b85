"""The sets event flow is judged on beside plain planes: densities as real recordings have them, scenes that
bend, cameras that shake or turn.

Packets of real recordings hold 0.05 to 1 event per pixel, since most of a room is smooth, contrasts are weak
and thresholds high. Here a packet of a fixed number of events is cut from a scene of photographs and of few
shapes; the lower its number, the weaker the contrast, so that flows are some pixels long in all sets.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from scenes.flow_packets import PacketWindows
from scenes.flow_windows import Draws, RenderedWindows

SIDE_PX = 96
WARP_SIDE_PX = 128
WEAK = (0.12, 0.35)  # thresholds
STRONG = (0.05, 0.15)
CONTRASTS = {
    0.05: (WEAK, (0.2, 0.6), (0.1, 0.3)),
    0.1: (WEAK, (0.3, 0.8), (0.12, 0.4)),
    0.3: (WEAK, (0.6, 1.2), (0.25, 0.7)),
    1.0: (STRONG, (0.8, 1.6), (0.3, 0.6)),
    3.0: (STRONG, (1.8, 3.5), (0.6, 1.2)),
}  # events of the scene per pixel -> thresholds, factors on log radiance of single planes and of layers
EVERYDAY = Draws(
    "everyday",
    flow_px=(2.0, 12.0),
    mismatch=0.05,
    scale=(1.0, 2.0),
    on_over_off=(0.8, 1.25),
)
NOISE_SHARE = (0.01, 0.15)  # noise events over those of the scene
MOVED = replace(EVERYDAY, theta=(0.1, 0.25), contrast=(0.8, 1.6), noise=(0.0005, 0.01))


def packets(events_per_px, layers):
    """Function (seed, bins) -> source of packets of so many events of the scene per pixel, and noise on top.

    layers: (least, most) planes before the background.
    """
    noise = tuple(share * events_per_px / 16 for share in NOISE_SHARE)  # two polarities, eight eighths
    theta, *contrast = CONTRASTS[events_per_px]
    draws = replace(
        EVERYDAY, motion="camera", layers=layers, theta=theta, contrast=contrast[layers[1] > 0], noise=noise
    )

    def make(seed, bins):
        return PacketWindows(draws, events_per_px, seed=seed, height_px=SIDE_PX, width_px=SIDE_PX, bins=bins)

    return make


def moved(motion, flow_px, layers=(0, 0), textures="mixed"):
    """Function (seed, bins) -> source of windows of a motion, at usual densities."""
    draws = replace(MOVED, textures=textures, motion=motion, flow_px=flow_px, layers=layers)

    def make(seed, bins):
        return RenderedWindows(draws, seed=seed, height_px=WARP_SIDE_PX, width_px=WARP_SIDE_PX, bins=bins)

    return make


SETS: dict[str, Callable[[int, int], Any]] = (
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
"""Name -> function (seed, bins) -> source of FlowWindows. packets by events per pixel; "many_depths": several
layers, each of which bends, as Middlebury's flows do, and the same flows three times as long."""
