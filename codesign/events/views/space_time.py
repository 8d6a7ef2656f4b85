"""Events in space and time: a 3-D figure with time along one axis and the sensor across it."""

from typing import Any

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from codesign.errors import DomainError, ShapeError
from codesign.events.views.rate_curves import OFF_COLOUR, ON_COLOUR


def space_time_figure(stream, *, points=20_000, generator=None, total=None, title="Events in space and time"):
    """3-D figure of a stream: time to the right, columns into depth, rows downwards; rows and columns have
    the same scale.

    Args:
      stream: EventStream with at least one event.
      points: at most so many events are shown, drawn evenly from all of them.
      generator: torch.Generator that chooses them; None: one with seed 0.
      total: number of events that the stream is itself a sample of; None: it holds all.
      title: first line of the heading; the second says how many of the events are shown.
    Returns: matplotlib Figure; milliseconds since the first event.
    Raises: ShapeError for a stream without events; DomainError for points that are not a whole number >= 1.
    """
    if not len(stream):
        raise ShapeError("the stream holds no event; a figure needs at least one.")
    if isinstance(points, bool) or not isinstance(points, int) or points < 1:
        raise DomainError(f"points is {points!r}; a whole number >= 1 is needed.")
    shown = sample(len(stream), points, torch.Generator().manual_seed(0) if generator is None else generator)
    t_ms = (stream.t_us[shown] - stream.t_us[0]).numpy() / 1e3
    x, y, p = (column[shown].numpy() for column in (stream.x, stream.y, stream.p))
    figure = Figure(figsize=(10, 5.6))
    with rc_context({"grid.color": "0.85"}):  # read when the axes are made
        axis: Any = figure.add_axes((0.0, 0.0, 1.0, 0.93), projection="3d")
    size = float(np.clip(5e4 / len(shown), 0.6, 12))
    # one scatter of both, so that nearer points hide farther ones whatever their polarity
    axis.scatter(
        t_ms,
        x,
        y,
        c=np.where(p > 0, ON_COLOUR, OFF_COLOUR),
        s=size,
        alpha=0.6,
        linewidths=0,
        depthshade=False,
    )
    for colour, name in ((ON_COLOUR, "ON (brighter)"), (OFF_COLOUR, "OFF (darker)")):
        axis.scatter([], [], [], c=colour, s=30, label=name)
    height = stream.height_px
    width = stream.width_px
    side = max(height, width)
    axis.set_box_aspect((1.9, width / side, height / side), zoom=1.2)
    axis.set(
        xlim=(0, max(float(stream.t_us[-1] - stream.t_us[0]) / 1e3, 1e-3)),
        ylim=(0, max(width - 1, 1)),
        zlim=(max(height - 1, 1), 0),
    )
    axis.set(xlabel="time (ms)", ylabel="column x (px)", zlabel="row y (px)")
    axis.view_init(elev=22, azim=-58)
    for one, pad, length in (
        (axis.xaxis, 14, 1.9),
        (axis.yaxis, 6, width / side),
        (axis.zaxis, 4, height / side),
    ):
        one.labelpad = pad
        one.set_major_locator(
            MaxNLocator(max(1, round(4 * length)), steps=(1, 2, 2.5, 5, 10), integer=one is not axis.xaxis)
        )
        one.set_pane_color((0.97, 0.97, 0.97, 1.0))
    total = len(stream) if total is None else total
    number = (
        f"all {total:,} events"
        if len(shown) == total
        else f"{len(shown):,} of {total:,} events, drawn at random"
    )
    figure.suptitle(f"{title}\n{number}", fontsize=12, y=0.985)
    axis.legend(frameon=False, loc="upper right", bbox_to_anchor=(0.9, 0.98))
    return figure


def sample(count, most, generator):
    """[min(count, most)] different indices below ``count`` in increasing order, every subset equally likely;
    in the memory of the indices alone."""
    if count <= most:
        return torch.arange(count)
    if count < 4 * most:
        return torch.randperm(count, generator=generator)[:most].sort().values
    drawn = np.empty(0, np.int64)
    while len(drawn) < most:  # numbers that came before are passed over, as in drawing without putting back
        drawn = np.concatenate((drawn, torch.randint(count, (most,), generator=generator).numpy()))
        drawn = drawn[np.sort(np.unique(drawn, return_index=True)[1])]
    return torch.from_numpy(np.sort(drawn[:most]))
