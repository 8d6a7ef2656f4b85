"""Figures of the placement study."""

import math
from itertools import pairwise
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.colors import LogNorm
from matplotlib.ticker import FuncFormatter

from codesign.place.mount import yaw_pitch_roll_rad

COLOURS = ("#d62728", "#1f77b4", "#ff7f0e", "#e377c2", "#17becf", "#8c564b", "#2ca02c", "#bcbd22")
PLAIN = FuncFormatter(lambda value, _: f"{value:g}")


def map_of(grid, size, descents):
    """Task error over the directions the camera can look in, as seen from above, with the way of each search
    to its best mount."""
    figure = plt.figure(figsize=(8.2, 7.2))
    axes: Any = figure.add_subplot(projection="polar")
    axes.set_theta_zero_location("N")
    arcs = 12  # pieces per cell, so that its rim is round
    yaw_edges = np.linspace(-math.pi, math.pi, arcs * size.yaws + 1)
    tilt_edges = np.linspace(90, 0, size.pitches + 1)
    errors = grid.error.reshape(size.pitches, size.yaws).repeat_interleave(arcs, 1).numpy()
    shown = axes.pcolormesh(
        yaw_edges,
        tilt_edges,
        errors,
        norm=LogNorm(errors.min(), errors.max()),
        cmap="viridis_r",
        shading="flat",
    )
    axes.grid(False)
    for ring in (15, 30, 45, 60, 75, 90):
        axes.plot(np.linspace(0, 2 * math.pi, 200), np.full(200, ring), color="white", lw=0.5, alpha=0.5)
    far = 90.0
    for k, path in enumerate(descents):
        yaw, pitch, _ = yaw_pitch_roll_rad(path.T_body_cam[leading(path)]).unbind(1)
        tilt = 90 - torch.rad2deg(pitch)
        far = max(far, float(tilt.max()))
        colour = COLOURS[k % len(COLOURS)]
        direct = torch.polar(tilt, yaw)  # straight lines between mounts, drawn by short pieces
        line = (
            torch.cat([a + (b - a) * torch.linspace(0, 1, 20) for a, b in pairwise(direct)])
            if len(direct) > 1
            else direct
        )
        axes.plot(line.angle(), line.abs(), color="white", lw=3.6, solid_capstyle="round")
        axes.plot(
            line.angle(),
            line.abs(),
            color=colour,
            lw=2,
            label=f"start {k + 1}: {float(path.error[0]):.2f} → {float(path.error.min()):.2f}",
        )
        axes.plot(yaw[1:-1], tilt[1:-1], ".", color=colour, ms=5)
        axes.plot(yaw[0], tilt[0], "o", mfc="white", mec=colour, mew=2, ms=9)
        axes.plot(yaw[-1], tilt[-1], "*", color=colour, mec="white", mew=0.8, ms=16)
    yaw, pitch, _ = yaw_pitch_roll_rad(grid.T_body_cam[grid.best]).tolist()
    axes.plot(
        yaw,
        90 - math.degrees(pitch),
        "X",
        color="black",
        mec="white",
        ms=11,
        label=f"best of the grid: {float(grid.error.min()):.2f}",
        ls="none",
    )
    axes.set_ylim(0, far)
    axes.set_yticks(
        [15, 30, 45, 60, 75, 90], [f"{90 - t}°" for t in (15, 30, 45, 60, 75, 90)], color="white", fontsize=8
    )
    axes.set_rlabel_position(20)
    axes.set_xticks(
        [math.radians(a) for a in range(0, 360, 45)],
        ["forward", "45°", "left 90°", "135°", "backward", "−135°", "right −90°", "−45°"],
    )
    axes.tick_params(axis="x", pad=9)
    axes.set_title("Task error by where the camera looks\n(middle: straight down, rim: horizon)", pad=14)
    bar = figure.colorbar(shown, ax=axes, shrink=0.75, pad=0.12, label="task error (0.1 m/s, 0.1 rad/s = 1)")
    bar.ax.yaxis.set_major_formatter(PLAIN)
    bar.ax.yaxis.set_minor_formatter(PLAIN)
    figure.legend(loc="lower center", ncol=3, frameon=False, fontsize=9, bbox_to_anchor=(0.5, 0.02))
    return figure


def leading(path):
    """Indices of the mounts of a path that were the best so far."""
    best = math.inf
    kept = []
    for index, error in enumerate(path.error.tolist()):
        if error < best:
            best = error
            kept.append(index)
    return kept


def curves(grid, descents, randoms):
    figure, axes = plt.subplots(figsize=(7.6, 4.4))
    best = float(grid.error.min())
    axes.axhspan(best, 1.1 * best, color="0.85", label="within 10 % of the grid's best", zorder=0)
    axes.axhline(best, color="black", lw=1, label=f"best of {len(grid.error)} grid mounts")
    for kind, paths, style in (("gradient", descents, "-"), ("random search", randoms, ":")):
        for k, path in enumerate(paths):
            axes.step(
                path.renders,
                path.error.cummin(0).values,
                style,
                where="post",
                color=COLOURS[k % len(COLOURS)],
                lw=2 if style == "-" else 1.4,
                label=f"{kind} {k + 1}",
            )
    axes.set(yscale="log", xlabel="renders of all samples", ylabel="best task error so far")
    axes.yaxis.set_major_formatter(PLAIN)
    axes.yaxis.set_minor_formatter(
        FuncFormatter(lambda value, _: f"{value:g}" if f"{value:.0e}"[0] in "2357" else "")
    )
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=8, ncol=2, frameon=False)
    return figure


@torch.no_grad()
def scatter(held_out, path, best):
    """Estimated over true velocities of the samples not searched on, at the start and the end of a search."""
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.8), layout="constrained")
    truth = held_out.velocity.reshape(-1, 3)
    for label, mount, colour, marker in (
        ("start", path.T_body_cam[0], "0.6", "o"),
        ("end", best, "#d62728", "o"),
    ):
        estimate = held_out.begin(mount, "sensor")["estimate"]
        for k, axis in enumerate(axes):
            axis.plot(
                truth[:, k], estimate[:, k], marker, color=colour, ms=5, mec="white", mew=0.5, label=label
            )
    for k, (axis, name) in enumerate(
        zip(axes, ("forward, m/s", "lateral (left), m/s", "yaw rate (left), rad/s"), strict=True)
    ):
        low = float(truth[:, k].min())
        high = float(truth[:, k].max())
        axis.plot([low, high], [low, high], color="black", lw=0.8, zorder=0)
        axis.set(title=name, xlabel="true")
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("estimated")
    axes[0].legend(frameon=False)
    return figure
