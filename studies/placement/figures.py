"""Pictures of a placement: the ways of the searches, and the robot before and after."""

import math

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from codesign import events
from codesign.mount.ranges import NAMES
from codesign.report.flow_colours import flow_colours
from scenes.robot_pair import Drives
from studies.frame.robot_pictures import draw_frame, draw_pair
from studies.placement.problem import Problem, Samples
from studies.placement.searches import Trail

COLOURS = ("#d62728", "#7f7f7f", "#1f77b4", "#2ca02c", "#9467bd", "#8c564b")


def ways(
    problem: Problem,
    trails: dict[str, list[Trail]],
    along: dict[str, Tensor],
    samples: int,
    grid: float | None,
) -> Figure:
    """Errors on unseen samples, and the best that a search saw of its own, over drives rendered; and of all mounts looked
    at height, pitch and error, below the ways of the descents.

    along: search -> errors [starts, parts + 1] after equal parts of ``samples``. grid: error of its best mount.
    """
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    for (name, errors), colour in zip(along.items(), COLOURS, strict=False):
        rendered = np.linspace(0, samples, errors.shape[1])
        left.plot(rendered, errors.T.numpy(), color=colour, linewidth=0.4, alpha=0.5)
        median = errors.quantile(0.5, 0).numpy()
        left.plot(rendered, median, "o-", color=colour, linewidth=1.8, markersize=4, label=name)
        if name != "gradient":
            best = [torch.cummin(trail.error, 0).values for trail in trails[name]]
            shortest = min(map(len, best))  # one that finds little that is allowed looks at less
            least = torch.stack([each[:shortest] for each in best]).quantile(0.5, 0).numpy()
            drives = problem.samples * np.arange(1, shortest + 1)
            left.plot(drives, least, "--", color=colour, linewidth=1)
    if grid is not None:
        left.axhline(grid, color="black", linewidth=1, linestyle=":", label="best of the grid")
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
    """Robot, frame, events and flow of an unseen drive, for the default mount and for one [4, 4]."""
    figure = plt.figure(figsize=(13, 6.4), layout="constrained")
    drives = fastest(problem)
    for row, pose in enumerate((problem.ranges.pose(problem.start), mount)):
        draw_pair(figure.add_subplot(2, 4, 4 * row + 1, projection="3d"), problem.pair, problem.camera, pose)
        axes = [figure.add_subplot(2, 4, 4 * row + column) for column in (2, 3, 4)]
        draw_frame(axes[0], drives, problem.camera, pose)
        with torch.no_grad():
            run = problem.system(pose, "sensor").begin(drives)
        counts, flow = run["volume"].counts.sum(2), run["field"].flow_px
        axes[1].imshow(_tiled(events.picture(counts).numpy()))
        axes[2].imshow(flow_colours(_tiled(flow.movedim(1, -1).numpy()).transpose(2, 0, 1)))
        for axis, title in zip(axes, ("frame", "events", "flow"), strict=True):
            axis.set(xticks=[], yticks=[], title=title if row == 0 else "")
    return figure


def fastest(problem: Problem) -> Drives:
    """Of six drives in the first world."""
    drives = problem.batch(Samples((problem.numbers[0],), tuple(range(6)), 0))
    which = int(drives.twist[:, :3].norm(dim=1).argmax())
    return problem.batch(Samples((problem.numbers[0],), (which,), 0))


def _tiled(windows: np.ndarray) -> np.ndarray:
    """Windows [9, H, W, C] in rows of three."""
    side = math.isqrt(len(windows))
    rows = [np.concatenate(list(windows[side * k : side * (k + 1)]), 1) for k in range(side)]
    return np.concatenate(rows, 0)
