"""A number over all directions in which a camera on a robot may look."""

import math
from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from torch import Tensor

from codesign.errors import DomainError

COLOURS = ("#d62728", "#1f77b4", "#ff7f0e", "#e377c2", "#17becf", "#8c564b")


def mount_sphere(
    yaw_rad: Tensor,
    pitch_rad: Tensor,
    values: Tensor,
    label: str,
    marked: Mapping[str, tuple[float, float]] | None = None,
) -> Figure:
    """Figure of a sphere of directions in equal areas (Mollweide), as seen from the body: ahead is
    the middle, left is left, down is below.

    Args:
      yaw_rad: [columns], pitch_rad: [rows] middles of cells of equal angles, as of
        ``mount.sight_map``.
      values: [rows, columns] > 0, on a logarithmic scale.
      label: of them.
      marked: name -> yaw and pitch of directions to mark.
    Raises: DomainError for directions that are not those of a whole sphere, in whatever order.
    """
    values = _in_order(yaw_rad, pitch_rad, values.detach())
    rows, columns = values.shape
    figure = plt.figure(figsize=(8.6, 4.8), layout="constrained")
    axes: Any = figure.add_subplot(projection="mollweide")
    across = np.linspace(-math.pi, math.pi, columns + 1)
    upwards = np.linspace(-math.pi / 2, math.pi / 2, rows + 1)
    # yaw grows to the left and pitch downwards
    shown = values.numpy()[::-1, ::-1]
    mesh = axes.pcolormesh(
        across,
        upwards,
        shown,
        norm=LogNorm(shown.min(), shown.max()),
        cmap="viridis_r",
        shading="flat",
    )
    axes.grid(color="white", lw=0.5, alpha=0.4)
    # as the body looks: yaw to the left
    axes.set_xticks([math.radians(a) for a in (-90, 0, 90)], ["left", "ahead", "right"])
    axes.set_yticks([math.radians(a) for a in (-60, -30, 0, 30, 60)])
    bar = figure.colorbar(mesh, shrink=0.8, label=label)
    bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    for k, (name, (yaw, pitch)) in enumerate((marked or {}).items()):
        axes.plot(
            [-yaw],
            [-pitch],
            "o",
            mfc="white",
            mec=COLOURS[k % len(COLOURS)],
            mew=2,
            ms=8,
            label=name,
        )
    if marked:
        axes.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, -0.02),
            ncols=min(len(marked), 5),
            frameon=False,
        )
    return figure


def _in_order(yaw_rad, pitch_rad, values):
    """Values [rows, columns], from yaw -pi and pitch -pi / 2 on."""
    for at, whole, axis in ((yaw_rad, 2 * math.pi, 1), (pitch_rad, math.pi, 0)):
        count = values.shape[axis]
        at = (at.detach().double() + whole / 2) % whole
        middles = whole / count * (torch.arange(count, dtype=torch.float64) + 0.5)
        if at.shape != middles.shape or not torch.allclose(at.sort().values, middles, atol=1e-4):
            raise DomainError(
                "mount_sphere: directions are not the middles of equal cells over the whole sphere; give those of "
                "mount.sight_map."
            )
        values = values.index_select(axis, at.argsort())
    return values
