"""Pictures of a placement: the ways of the searches, and the robot before and after."""

import math
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

from codesign import events, render
from codesign.place.ranges import NAMES
from codesign.report import robot_figures
from codesign.report.flow_colours import flow_colours
from scenes import bodies
from scenes.robot_pair import FRAMES, SENSOR_PX, WINDOW_PX
from studies.placement.problem import Problem, Samples
from studies.placement.searches import Trail

DRAWN_M = 0.6  # length of the drawn view
COLOURS = ("#d62728", "#7f7f7f", "#1f77b4", "#2ca02c", "#9467bd", "#8c564b")


def ways(problem: Problem, trails: dict[str, list[Trail]]) -> Figure:
    """Best error so far over mounts looked at; and of all these mounts height, pitch and error, below the ways of the
    descents."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    for (name, found), colour in zip(trails.items(), COLOURS, strict=False):
        for number, trail in enumerate(found):
            if name == "gradient":  # above 1 is the penalty of what is not allowed
                error = trail.error.masked_fill(trail.error > 1, math.nan)
            else:
                error = torch.cummin(trail.error, 0).values
            left.plot(error.numpy(), color=colour, linewidth=0.9, label=name if number == 0 else None)
    left.set(xlabel="mounts looked at", ylabel="own objective", ylim=(0, 1))
    left.legend()
    looked = [trail for name, found in trails.items() if name != "gradient" for trail in found]
    if looked:
        pitch, height = _pitch_and_height(problem, torch.cat([trail.share for trail in looked]))
        error = torch.cat([trail.error for trail in looked])
        allowed = (error < 1).numpy()  # errors are bounded by 1: beyond lies what is not allowed
        map_ = right.scatter(pitch[allowed], height[allowed], c=error[allowed], s=9, cmap="viridis_r")
        figure.colorbar(map_, ax=right, label="error")
    for trail in trails["gradient"]:
        pitch, height = _pitch_and_height(problem, trail.share)
        right.plot(pitch, height, color=COLOURS[0], linewidth=0.9)
        right.plot(pitch[0], height[0], "o", mfc="none", color=COLOURS[0])
        right.plot(pitch[-1], height[-1], "*", color=COLOURS[0])
    right.set(xlabel="pitch, degrees down", ylabel="height, m")
    return figure


def _pitch_and_height(problem: Problem, share: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Degrees down and metres of mounts [N, 6]."""
    numbers = problem.ranges.numbers(share).numpy()
    return np.degrees(numbers[:, NAMES.index("pitch_rad")]), numbers[:, NAMES.index("z_m")]


def before_and_after(problem: Problem, mount: Tensor) -> Figure:
    """Robot, frame, events and flow of an unseen drive, for the default mount and for one [4, 4]."""
    figure = plt.figure(figsize=(13, 6.4), layout="constrained")
    for row, pose in enumerate((problem.ranges.pose(problem.start), mount)):
        _robot(figure.add_subplot(2, 4, 4 * row + 1, projection="3d"), problem, pose)
        shown = _seen(problem, pose)
        for column, (title, image) in enumerate(shown.items(), 2):
            axis = figure.add_subplot(2, 4, 4 * row + column)
            axis.imshow(image, cmap="gray", vmin=0, vmax=1)
            if column == 2:
                for corner in problem.camera.film.windows_px or ():
                    axis.add_patch(
                        Rectangle(corner, WINDOW_PX, WINDOW_PX, fill=False, color="tab:red", linewidth=0.6)
                    )
            axis.set(xticks=[], yticks=[], title=title if row == 0 else "")
    return figure


def _robot(axis: Any, problem: Problem, pose: Tensor) -> None:
    pair = problem.pair
    triangles = [mesh.vertices_m[mesh.faces] for mesh in pair.bodies.values()]
    shade = [np.clip(0.8 * bodies.skylight(mesh), 0, 1) for mesh in pair.bodies.values()]
    lines = robot_figures.view_lines(problem.camera, pose, DRAWN_M)
    robot_figures.draw_robot(axis, np.concatenate(triangles), np.concatenate(shade), lines)


@torch.no_grad()
def _seen(problem: Problem, pose: Tensor) -> dict[str, np.ndarray]:
    """Title -> picture of the fastest of a few drives in the first world."""
    drives = problem.batch(Samples((problem.numbers[0],), tuple(range(6)), 0))
    which = int(drives.twist[:, :3].norm(dim=1).argmax())
    samples = Samples((problem.numbers[0],), (which,), 0)
    drives = problem.batch(samples)
    camera = render.Camera(problem.camera.lens, *SENSOR_PX, problem.camera.film.pixel_pitch_mm, 8)
    scene = drives.scene[0].during([FRAMES // 2])
    whole = render.frames(camera, scene, (drives.T_world_body[0, :, FRAMES // 2] @ pose)[:, None])[0, 0]
    run = problem.system(pose, "sensor").begin(drives)
    counts = run["volume"].counts.sum(2)
    flow = run["field"].flow_px
    return {
        "frame": np.clip(whole.numpy() / 255, 0, 1) ** (1 / 2.2),
        "events": _tiled(events.picture(counts).numpy()),
        "flow": _tiled(flow_colours(_tiled(flow.movedim(1, -1).numpy()).transpose(2, 0, 1))[None]),
    }


def _tiled(windows: np.ndarray) -> np.ndarray:
    """Windows [9, H, W, C] in rows of three; one is left as it is."""
    side = math.isqrt(len(windows))
    rows = [np.concatenate(list(windows[side * k : side * (k + 1)]), 1) for k in range(side)]
    return np.concatenate(rows, 0)
