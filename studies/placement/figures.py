"""Pictures of a placement: the ways of the searches, and the robot before and after."""

import math
from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

from codesign import events
from codesign.mount.pose import NAMES
from codesign.render import Camera, frames
from codesign.report import robot_figures
from codesign.report.flow_colours import flow_colours
from scenes import bodies
from scenes.robots.pair import FRAMES, SENSOR_PX, WINDOW_PX, Drives, RobotPair
from studies.placement.problem import Problem, Samples
from studies.placement.searches import Trail

DRAWN_M = 0.6  # length of the drawn view
COLOURS = ("#d62728", "#7f7f7f", "#1f77b4", "#2ca02c", "#9467bd", "#8c564b")


def ways(
    problem: Problem,
    trails: dict[str, list[Trail]],
    errors: dict[str, Tensor],
    samples: int,
) -> Figure:
    """Errors on unseen samples, and the best that a search saw of its own, over drives rendered;
    and of all mounts looked at height, pitch and error, below the ways of the descents.

    errors: of the starts and of each search, [starts]. samples: drives that each rendered.
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    for (name, found), colour in zip(trails.items(), COLOURS, strict=False):
        along = torch.stack([errors["start"], errors[name]])
        left.plot((0, samples), along.numpy(), color=colour, linewidth=0.4, alpha=0.5)
        median = along.quantile(0.5, 1).numpy()
        left.plot((0, samples), median, "o-", color=colour, linewidth=1.8, markersize=4, label=name)
        if name != "gradient":
            best = [torch.cummin(trail.error, 0).values for trail in found]
            shortest = min(map(len, best))  # one that finds little that is allowed looks at less
            least = torch.stack([each[:shortest] for each in best]).quantile(0.5, 0).numpy()
            left.plot(
                problem.samples * np.arange(1, shortest + 1), least, "--", color=colour, linewidth=1
            )
    left.set(xlabel="drives rendered", ylabel="mean bounded error", ylim=(0, None))
    left.legend(fontsize="small")
    looked = [trail for name, found in trails.items() if name != "gradient" for trail in found]
    if looked:
        pitch, height = _pitch_and_height(problem, torch.cat([trail.share for trail in looked]))
        error = torch.cat([trail.error for trail in looked]).numpy()
        map_ = right.scatter(pitch, height, c=error, s=9, cmap="viridis_r")
        figure.colorbar(map_, ax=right, label="error and penalty")
    for trail in trails["gradient"]:
        pitch, height = _pitch_and_height(problem, trail.share)
        right.plot(pitch, height, color=COLOURS[0], linewidth=0.9, alpha=0.7)
        right.plot(pitch[0], height[0], "o", mfc="none", color=COLOURS[0])
        right.plot(pitch[-1], height[-1], "*", color=COLOURS[0])
    right.set(xlabel="pitch, degrees down", ylabel="height, m")
    return figure


def _pitch_and_height(problem: Problem, share: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Degrees down and metres of mounts [N, 6]."""
    numbers = problem.ranges.numbers(share).numpy()
    return np.degrees(numbers[:, NAMES.index("pitch_rad")]), numbers[:, NAMES.index("z_m")]


def before_and_after(problem: Problem, mount: Tensor) -> Figure:
    """Robot, frame, events and flow of an unseen drive, for the default mount and for one
    [4, 4]."""
    figure = plt.figure(figsize=(13, 6.4), layout="constrained")
    drives = problem.batch(fastest(problem))
    for row, pose in enumerate((problem.ranges.pose(problem.start), mount)):
        left = figure.add_subplot(2, 4, 4 * row + 1, projection="3d")
        draw_pair(left, problem.pair, problem.camera, pose)
        axes = [figure.add_subplot(2, 4, 4 * row + column) for column in (2, 3, 4)]
        with torch.no_grad():
            run = problem.system(pose, "sensor").begin(drives)
        draw_seen(axes, drives, problem.camera, pose, run, titled=row == 0)
    return figure


def draw_seen(
    axes: Sequence[Any], drives: Drives, camera: Camera, T_body_cam: Tensor, run: Any, titled: bool
) -> None:
    """Frame, single events and flow of a drive, into three axes. run: of the chain that saw it."""
    _draw_frame(axes[0], drives, camera, T_body_cam)
    counts, flow = run["volume"].counts.sum(2), run["field"].flow_px
    axes[1].imshow(tiled(events.picture(counts).numpy()))
    axes[2].imshow(flow_colours(tiled(flow.movedim(1, -1).numpy()).transpose(2, 0, 1)))
    for axis, title in zip(axes, ("frame", "events", "flow"), strict=True):
        axis.set(xticks=[], yticks=[], title=title if titled else "")


def fastest(problem: Problem, seed: int = 0) -> Samples:
    """Of six drives in the first world. seed: of film samples and noise."""
    numbers = (problem.numbers[0],)
    drives = problem.scenes(Samples(numbers, tuple(range(6)), seed))
    return Samples(numbers, (int(drives.twist[:, :3].norm(dim=1).argmax()),), seed)


def tiled(windows: np.ndarray) -> np.ndarray:
    """Windows [9, H, W, C] in rows of three."""
    side = math.isqrt(len(windows))
    rows = [np.concatenate(list(windows[side * k : side * (k + 1)]), 1) for k in range(side)]
    return np.concatenate(rows, 0)


def robot_and_frame(pair: RobotPair, drives: Drives, camera: Camera, pose: Tensor) -> Figure:
    """The robot with its camera's view, and beside it the middle frame of the first drive."""
    figure = plt.figure(figsize=(10, 4.4), layout="constrained")
    draw_pair(figure.add_subplot(1, 2, 1, projection="3d"), pair, camera, pose)
    right = figure.add_subplot(1, 2, 2)
    _draw_frame(right, drives, camera, pose)
    right.set(xticks=[], yticks=[])
    return figure


def draw_pair(axis: Any, pair: RobotPair, camera: Camera, T_body_cam: Tensor) -> None:
    triangles = [mesh.vertices_m[mesh.faces] for mesh in pair.bodies.values()]
    shade = [np.clip(0.8 * bodies.skylight(mesh), 0, 1) for mesh in pair.bodies.values()]
    lines = robot_figures.view_lines(camera, T_body_cam, DRAWN_M)
    robot_figures.draw_robot(axis, np.concatenate(triangles), np.concatenate(shade), lines)


@torch.no_grad()
def _draw_frame(axis: Any, drives: Drives, camera: Camera, T_body_cam: Tensor) -> None:
    """The middle frame [H, W] of the first drive on the whole sensor, with the camera's windows."""
    whole = Camera(camera.lens, *SENSOR_PX, camera.film.pixel_pitch_mm, 8)
    scene = drives.scene[0].during([FRAMES // 2])
    pose = (drives.T_world_body[0, :, FRAMES // 2] @ T_body_cam)[:, None]
    frame = frames(whole, scene, pose)[0, 0].numpy()
    axis.imshow(np.clip(frame / 255, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
    for corner in camera.film.windows_px or ():
        axis.add_patch(
            Rectangle(corner, WINDOW_PX, WINDOW_PX, fill=False, color="tab:red", linewidth=0.6)
        )
