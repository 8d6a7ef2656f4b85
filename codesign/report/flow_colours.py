"""Flow as colour: hue says where to, saturation how far."""

from collections.abc import Sequence
from typing import Any

import numpy as np


def flow_colours(flow_px: np.ndarray, full_px: float | None = None) -> np.ndarray:
    """RGB picture [H, W, 3] of a flow [2, H, W]: hue the direction (red right, then yellow, green
    down), saturation the length, full at ``full_px``."""
    from matplotlib.colors import hsv_to_rgb

    length = np.hypot(*flow_px)
    full = full_px or max(float(length.max()), 1e-9)
    return hsv_to_rgb(
        np.stack(
            [
                np.mod(np.arctan2(flow_px[1], flow_px[0]) / (2 * np.pi), 1),
                np.clip(length / full, 0, 1),
                np.ones_like(length),
            ],
            -1,
        )
    )


def draw_wheel(axis: Any, place: Sequence[float]) -> None:
    """Draw the wheel of these colours beside an axis or into it: left, bottom, width and height as
    shares of the axis."""
    across = np.linspace(-1, 1, 61)
    wheel = np.stack(np.meshgrid(across, across))
    inside = np.hypot(*wheel) <= 1
    small = axis.inset_axes(place)
    small.imshow(np.concatenate([flow_colours(wheel, 1.0), inside[..., None]], -1))
    small.set_axis_off()
