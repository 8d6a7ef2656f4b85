"""The pictures of a run of video_to_events, drawn from the events on disk piece by piece."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from matplotlib.figure import Figure

from codesign.events import picture, to_counts
from codesign.events.sources.frames import FrameSource
from codesign.events.volumes.traces import decay_from_stream
from studies.frame.run import Run
from studies.video_to_events.light import Light
from studies.video_to_events.log import EventLog
from studies.video_to_events.steps import LARGE

SHORTEST_S = 10.0  # of the videos, unless their slow-down is given
PICTURES_PER_FRAME = (
    4.0  # at most; between two frames events are interpolated, and more pictures would only be paler
)
TAU_PICTURES = 3.0
TAU_FRAMES = 1.5
RATE_BINS = 200
SHOWN = 4


@dataclass(frozen=True)
class View:
    """What there is to show: the run and its options, frames and how to see them, events, t_s of the frames
    used, and the number of the first of them."""

    run: Run[Any]
    config: Any
    source: FrameSource
    light: Light
    log: EventLog
    t_s: torch.Tensor
    first: int

    @property
    def duration_s(self):
        return float(self.t_s[-1] - self.t_s[0])

    @property
    def slowdown(self):
        """How many times slower than the scene the videos play."""
        most = PICTURES_PER_FRAME * len(self.t_s) / (self.config.preview_fps * self.duration_s)
        return self.config.preview_slowdown or max(1.0, min(SHORTEST_S / self.duration_s, most))

    @property
    def exposure_s(self):
        """Time of the scene that one picture of the videos covers."""
        return 1 / (self.config.preview_fps * self.slowdown)

    @property
    def tau_s(self):
        """Fading time of the traces, seconds of the scene."""
        return self.config.decay_tau_s or max(
            TAU_PICTURES * self.exposure_s, TAU_FRAMES * float(self.t_s.diff().median())
        )

    def edges_us(self, count):
        """[count + 1] whole microseconds from the first frame to the last, evenly spaced where that is
        possible."""
        start_us = round(float(self.t_s[0]) * 1e6)
        length_us = round(self.duration_s * 1e6)
        return sorted({start_us + length_us * k // count for k in range(count + 1)})


def rates_over_time(view):
    """Middle of equal parts of the time, seconds [K], and events per second in them, [K, 2], ON first."""
    edges = view.edges_us(min(RATE_BINS, max(1, len(view.t_s) - 1)))
    ends = view.log.positions(edges)
    ends[0] = 0
    rows = []
    for (a, b), (start_us, end_us) in zip(pairwise(ends), pairwise(edges), strict=True):
        on = sum(int((view.log.read(k, min(k + 2**20, b)).p > 0).sum()) for k in range(a, b, 2**20))
        rows.append((on * 1e6 / (end_us - start_us), (b - a - on) * 1e6 / (end_us - start_us)))
    middle_s = [(a + b) / 2e6 for a, b in pairwise(edges)]
    return torch.tensor(middle_s, dtype=torch.float64), torch.tensor(rows, dtype=torch.float64)


def event_pictures(view):
    """Pictures of the video of events, one by one."""
    for stream, start_us, end_us in _slices(view):
        yield picture(to_counts(stream, [start_us / 1e6, end_us / 1e6])[0], view.config.preview_full_scale)


def trace_pictures(view):
    """Pictures of the video of fading traces, one by one."""
    start = None
    for stream, _, end_us in _slices(view):
        trace = decay_from_stream(stream, [end_us], view.tau_s, start=start, dtype=torch.float64)[0]
        start = (trace, end_us)
        yield picture(trace, view.config.preview_full_scale)


def first_pictures(view, window_s):
    """Figure: frames at a few times above, the events around them below."""
    count = len(view.t_s)
    shown = sorted({round((k + 0.5) / SHOWN * (count - 1)) for k in range(SHOWN)})
    rows, columns = (2 * len(shown), 1) if view.log.width_px > 4 * view.log.height_px else (2, len(shown))
    ratio = view.log.height_px / view.log.width_px
    figure = Figure(
        figsize=(9, 9 * ratio * rows + 0.35 * rows)
        if columns == 1
        else (3 * columns, 2 * (3 * ratio + 0.35)),
        layout="constrained",
    )
    axes = figure.subplots(rows, columns, squeeze=False)
    for column, index in enumerate(shown):
        upper, lower = (
            (axes[2 * column][0], axes[2 * column + 1][0])
            if columns == 1
            else (axes[0][column], axes[1][column])
        )
        with_frame = next(view.source.read(view.first + index))
        upper.imshow(view.light([with_frame], view.first + index)[0].cpu().numpy(), cmap="gray", vmin=0)
        time_s = float(view.t_s[index])
        start_us = round((time_s - window_s / 2) * 1e6)
        end_us = round((time_s + window_s / 2) * 1e6)
        a, b = view.log.positions([start_us, end_us])
        counts = to_counts(view.log.read(a, b), [start_us / 1e6, max(end_us, start_us + 1) / 1e6])[0]
        lower.imshow(picture(counts, view.config.preview_full_scale).numpy())
        upper.set_title(
            f"frame {view.first + index}, {1e3 * (time_s - float(view.t_s[0])):.4g} ms", fontsize=8
        )
        lower.set_title(f"{b - a:,} events", fontsize=8)
        for axis in (upper, lower):
            axis.set_xticks([])
            axis.set_yticks([])
    return figure


def steps_figure(steps):
    """Figure: how far pixels step from frame to frame."""
    moving = steps.histogram[1:].double()
    share = (100 * moving / moving.sum().clamp(min=1)).tolist()
    figure = Figure(figsize=(8, 2.6), layout="constrained")
    axis = figure.subplots()
    colours = ["#0072b2" if n < LARGE else "#d55e00" for n in range(1, len(share) + 1)]
    axis.bar(
        range(1, len(share) + 1), share, width=1.0, align="edge", color=colours, edgecolor="white", lw=0.5
    )
    last = max((n for n, value in enumerate(share, start=1) if value > 0), default=LARGE)
    beyond = f" (the last holds all above {len(share)})" if last == len(share) else ""
    axis.set(
        xlabel=f"step, in thresholds{beyond}", ylabel="moving pixels (%)", xlim=(1, max(last + 1, LARGE + 2))
    )
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def _slices(view):
    """For every picture of the videos: the stream of its events, and its start and end in whole
    microseconds."""
    edges = view.edges_us(max(1, round(view.duration_s / view.exposure_s)))
    ends = view.log.positions(edges)
    ends[0] = 0
    for (a, b), (start_us, end_us) in zip(pairwise(ends), pairwise(edges), strict=True):
        yield view.log.read(a, b), start_us, end_us
