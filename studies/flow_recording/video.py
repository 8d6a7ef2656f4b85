"""The video of a recording: the events of every window, and arrows of its flow."""

import statistics
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch.nn.functional import avg_pool2d

from codesign.events import picture, write_video

ACROSS = 24  # arrows along the longer side
WIDTH_PX = 960  # of the pictures, about
FULL = 0.98  # quantile of the speeds whose arrow is as long as the distance between arrows
EVENTS_FULL = 3.0  # events of a pixel in full colour
SURE = 0.25  # confidence below which no arrow is drawn
FAINT = 0.15  # opacity of the arrows there


@dataclass(frozen=True)
class Film:
    """path: of the video. metrics: its figures. sentence, caption: for the page."""

    path: Path
    metrics: dict[str, float]
    sentence: str
    caption: str


@dataclass(frozen=True)
class Arrows:
    """Flow on cells of a window with so many events. x_px, y_px: [N] middles. u, v: [N] px per
    second. sure: [N] confidence."""

    t0_us: int
    t1_us: int
    events: int
    x_px: np.ndarray
    y_px: np.ndarray
    u: np.ndarray
    v: np.ndarray
    sure: np.ndarray


def write(run, held, tracker, name, start_s):
    """Film of a recording: flow first, for one scale of all arrows, then the pictures."""
    start_us = int(held.t_us[0]) + round(start_s * 1e6)
    cell = max(held.height_px, held.width_px) // ACROSS or 1
    found = []
    spent_ms = []
    with run.progress(run.config.video_windows, "windows") as progress:
        for window in islice(
            tracker.track(held.chunks(start_us=start_us)), run.config.video_windows
        ):
            found.append(arrows(held, window, cell))
            spent_ms.append(1e3 * window.processor_s)
            progress.advance()
    speeds = np.concatenate([np.hypot(one.u, one.v)[one.sure > SURE] for one in found])
    full = max(np.quantile(speeds, FULL), 1e-6) if len(speeds) else 1.0
    path = run.path("flow.mp4")
    made = pictures(held, found, cell, full, tracker.real_time_factor, name)
    write_video(path, made, run.config.video_fps)
    metrics = {
        "video_windows": len(found),
        "video_events": tracker.events,
        "video_event_s": tracker.event_s,
        "video_processor_s": tracker.processor_s,
        "video_processor_median_ms": statistics.median(spent_ms),
        "video_real_time_factor": tracker.real_time_factor,
        "video_windows_without_events": tracker.left_out["windows_without_events"],
    }
    sentence = (
        f"{len(found)} windows one after the other through `flow.Tracker`: {tracker.processor_s:.2f} s of "
        f"processor time (median {statistics.median(spent_ms):.0f} ms a window; the first compiles) for "
        f"{tracker.event_s:.3f} s of events, a real-time factor of {tracker.real_time_factor:.2f} (below 1 "
        "one core keeps up)."
    )
    caption = (
        f"Events of every window, red brighter, blue darker, and the flow of {name}: an arrow as long as "
        f"the distance between arrows is {full:.0f} px/s; fainter where the confidence is less, none below "
        f"{SURE:g} or without events."
    )
    return Film(path, metrics, sentence, caption)


def arrows(held, window, cell):
    """Arrows of a TrackedWindow: means over cells, of the pixels with events."""
    stream = held.window(window.t0_us, window.t1_us - 1)  # its end belongs to the next
    seen = torch.zeros(1, 1, held.height_px, held.width_px)
    seen[0, 0, stream.y, stream.x] = 1
    field = window.field
    sure = torch.ones_like(field.flow_px[:, 0]) if field.confidence is None else field.confidence
    weight = seen * sure[:, None]
    share, weighed = (avg_pool2d(each, cell) for each in (seen, weight))
    flow = avg_pool2d(field.flow_px * weight, cell) / weighed.clamp_min(1e-9)
    y, x = np.nonzero((share[0, 0] > 0).numpy())
    seconds = (window.t1_us - window.t0_us) * 1e-6
    u, v = flow[0, :, y, x].numpy() / seconds
    confidence = (weighed / share.clamp_min(1e-9))[0, 0, y, x].numpy()
    middle = (cell - 1) / 2
    places = x * cell + middle, y * cell + middle
    return Arrows(window.t0_us, window.t1_us, window.events, *places, u, v, confidence)


def pictures(held, found, cell, full, factor, name):
    """Pictures [H, W, 3] uint8, one per window."""
    scale = max(1, round(WIDTH_PX / held.width_px))
    height = held.height_px * scale
    width = held.width_px * scale
    figure = Figure(figsize=(width / 100, height / 100 + 0.3), dpi=100)
    canvas = FigureCanvasAgg(figure)
    top = height / (height + 30)
    for one in found:
        figure.clear()
        axis = figure.add_axes((0, 0, 1, top))
        axis.set_axis_off()
        stream = held.window(one.t0_us, one.t1_us - 1)
        counts = torch.zeros(2, held.height_px, held.width_px)
        counts.index_put_(
            ((stream.p < 0).long(), stream.y, stream.x), torch.ones(len(stream)), accumulate=True
        )
        axis.imshow(picture(counts, EVENTS_FULL).numpy(), interpolation="nearest")
        clear = one.sure > SURE
        colours = np.zeros((int(clear.sum()), 4))
        colours[:, 3] = FAINT + (1 - FAINT) * (one.sure[clear] - SURE) / (1 - SURE)
        length = np.stack([one.u, one.v])[:, clear] * (cell / full)
        how = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.0025}
        axis.quiver(one.x_px[clear], one.y_px[clear], *length, color=colours, **how)
        axis.set_xlim(-0.5, held.width_px - 0.5)
        axis.set_ylim(held.height_px - 0.5, -0.5)
        title = (
            f"{(one.t0_us - int(held.t_us[0])) * 1e-3:.1f} ms, window {1e-3 * (one.t1_us - one.t0_us):.2f} "
            f"ms, {one.events} events, {name}, real-time factor {factor:.2f}"
        )
        figure.text(0.01, (1 + top) / 2, title, va="center", fontsize=10)
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()
