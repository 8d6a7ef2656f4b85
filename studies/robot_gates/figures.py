"""Pictures of a pair: the robot with its camera and the frame; the landscape; how surely samples rank designs."""

from typing import Any

import matplotlib.pyplot as plt
import torch
from matplotlib.figure import Figure

from scenes.robot_pair import Drives, RobotPair
from studies.frame.robot_pictures import draw_frame, draw_pair
from studies.robot_gates.measures import APART, DRAWN, PLANES, Ranking, level

LABELS = {
    "efl_mm": "focal length, mm",
    "focus_per_m": "focus, 1/m",
    "z_m": "height, m",
    "pitch_rad": "pitch, rad",
}


def robot_and_frames(pair: RobotPair, shown: dict[str, Drives]) -> Figure:
    """The robot with its default camera and view, and beside it the middle frame of the first drive of batches by
    their captions, windows outlined."""
    figure = plt.figure(figsize=(5 + 4 * len(shown), 4.2), layout="constrained")
    axis: Any = figure.add_subplot(1, 1 + len(shown), 1, projection="3d")
    camera, mount = pair.design.camera(), pair.design.mount()
    draw_pair(axis, pair, camera, mount)
    for place, (caption, batch) in enumerate(shown.items(), 2):
        right = figure.add_subplot(1, 1 + len(shown), place)
        draw_frame(right, batch, camera, mount)
        right.set(xticks=[], yticks=[], title=caption)
    return figure


def landscape(pair: RobotPair, reach: float, errors: dict[tuple[str, str], torch.Tensor]) -> Figure:
    """Maps of the typical error [levels, levels] over two variables each; a cross marks the default."""
    figure, axes = plt.subplots(2, 3, figsize=(10, 6), layout="constrained")
    low = min(float(each.min()) for each in errors.values())
    high = max(float(each.max()) for each in errors.values())
    for axis, names in zip(axes.flat, PLANES, strict=True):
        ends = (-reach, reach, -reach, reach)
        image = axis.imshow(
            errors[names].T.numpy(), origin="lower", extent=ends, vmin=low, vmax=high, cmap="viridis_r"
        )
        axis.plot(0, 0, "x", color="tab:red")
        at = (-reach, 0.0, reach)
        for axis_name, name in zip("xy", names, strict=True):
            labels = [f"{level(pair, name, share):.3g}" for share in at]
            getattr(axis, f"set_{axis_name}ticks")(at, labels)
            getattr(axis, f"set_{axis_name}label")(LABELS[name])
    figure.colorbar(image, ax=axes, label="typical error")
    return figure


def rankings(found: list[Ranking]) -> Figure:
    """Share of draws that rank two designs rightly, over the ratio of their errors."""
    figure, axis = plt.subplots(figsize=(5, 3.2), layout="constrained")
    axis.plot([each.ratio for each in found], [each.right for each in found], "o", color="#1b6ca8")
    axis.axvline(1 + APART, color="#888888", linewidth=0.8)
    axis.axhline(0.95, color="#888888", linewidth=0.8)
    axis.set(xlabel="ratio of errors", ylabel=f"right in draws of {DRAWN}", xscale="log")
    return figure
