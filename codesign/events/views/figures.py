"""Figures of events: their rate over time, one line per polarity, and a space-time plot, with time
along one axis and the sensor across it.
"""

from typing import Any

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from codesign.checks import check_whole
from codesign.errors import ShapeError

# vermilion and blue of Okabe and Ito, told apart by every kind of colour vision
ON_COLOUR, OFF_COLOUR = (
    "#d55e00",
    "#0072b2",
)
PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"))


def rate_figure(middle_s, rate_hz):
    """Figure of event rates.

    Args:
      middle_s: [K] middle of each interval, seconds. rate_hz: [K, 2] events per second, ON first
        (both as ``rates`` gives them).
    Returns: matplotlib Figure; time in milliseconds below ten seconds of recording, else in
      seconds.
    Raises: ShapeError when the two do not fit.
    """
    if middle_s.ndim != 1 or rate_hz.shape != (len(middle_s), 2) or not len(middle_s):
        raise ShapeError(
            f"middle_s has shape {list(middle_s.shape)}, rate_hz {list(rate_hz.shape)}; [K] and [K, 2] are "
            "needed, K >= 1."
        )
    scale, unit = (1e3, "ms") if float(middle_s[-1] - middle_s[0]) < 10 else (1.0, "s")
    factor, prefix = next(
        ((size, name) for size, name in PREFIXES if float(rate_hz.max()) >= size), (1.0, "")
    )
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    axis = figure.subplots()
    start_s, shift = (
        (float(middle_s[0]), f" since {float(middle_s[0]):.6f} s")
        if abs(float(middle_s[0])) > 1e6
        else (0.0, "")
    )
    for column, colour, name, style in (
        (0, ON_COLOUR, "ON (brighter)", "-"),
        (1, OFF_COLOUR, "OFF (darker)", "--"),
    ):
        axis.plot(
            (middle_s.numpy() - start_s) * scale,
            rate_hz[:, column].numpy() / factor,
            style,
            color=colour,
            lw=1.4,
            label=name,
        )
    axis.set(xlabel=f"time ({unit}){shift}", ylabel=f"{prefix}events per second")
    axis.set_title("Event rate", loc="left", fontsize=11)
    axis.set_ylim(bottom=0)
    axis.margins(x=0)
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(
        frameon=False,
        fontsize=9,
        ncols=2,
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        borderaxespad=0.2,
    )
    return figure


def space_time_figure(stream, *, points=20_000, total=None):
    """3-D figure of a stream: time to the right, columns into depth, rows downwards; rows and
    columns have the same scale.

    Args:
      stream: EventStream with at least one event.
      points: at most so many events are shown, drawn evenly from all of them.
      total: number of events that the stream is itself a sample of; None: it holds all.
    Returns: matplotlib Figure; milliseconds since the first event.
    Raises: ShapeError for a stream without events; DomainError for points that are not a whole
      number >= 1.
    """
    if not len(stream):
        raise ShapeError("the stream holds no event; a figure needs at least one.")
    points = check_whole(points, "points", 1)
    shown = sample(len(stream), points, torch.Generator().manual_seed(0))
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
            MaxNLocator(
                max(1, round(4 * length)), steps=(1, 2, 2.5, 5, 10), integer=one is not axis.xaxis
            )
        )
        one.set_pane_color((0.97, 0.97, 0.97, 1.0))
    total = len(stream) if total is None else total
    number = (
        f"all {total:,} events"
        if len(shown) == total
        else f"{len(shown):,} of {total:,} events, drawn at random"
    )
    figure.suptitle(f"Events in space and time\n{number}", fontsize=12, y=0.985)
    axis.legend(frameon=False, loc="upper right", bbox_to_anchor=(0.9, 0.98))
    return figure


def sample(count, most, generator):
    """[min(count, most)] different indices below ``count`` in increasing order, every subset
    equally likely; in the memory of the indices alone."""
    if count <= most:
        return torch.arange(count)
    if count < 4 * most:
        return torch.randperm(count, generator=generator)[:most].sort().values
    drawn = np.empty(0, np.int64)
    # numbers that came before are passed over, as in drawing without putting back
    while len(drawn) < most:
        drawn = np.concatenate((drawn, torch.randint(count, (most,), generator=generator).numpy()))
        drawn = drawn[np.sort(np.unique(drawn, return_index=True)[1])]
    return torch.from_numpy(np.sort(drawn[:most]))
