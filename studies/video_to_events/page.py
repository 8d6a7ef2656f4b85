"""What a run of video_to_events shows: warnings, figures of the events on disk drawn piece by
piece, two videos, metrics, and the page."""

import dataclasses
import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from codesign.events import decay_from_stream, picture, to_counts, write_video
from codesign.events.views.figures import PREFIXES, rate_figure, sample, space_time_figure
from studies.frame import show
from studies.frame.run import Run
from studies.video_to_events.input import Light
from studies.video_to_events.state import LARGE, WORRYING, EventLog

SHARE_OF_DURATION = 0.2  # a sensor whose reactions take more of the input hides what happens in it
MOST_ON_PAGE_MB = 0.4  # larger videos lie beside the page, which stays below 2 MB
PREVIEW_FPS = 30.0  # pictures per second of the videos
FULL_SCALE = 2.0  # events per pixel and picture that give full colour
POINTS = 20_000  # events drawn in space and time
SHORTEST_S = 10.0  # of the videos, unless their slow-down is given
# at most; between two frames events are interpolated, and more pictures would only be paler
PICTURES_PER_FRAME = 4.0
# traces fade to 1/e in so many pictures of the video, and at least in so many frames of the input
TAU_PICTURES = 3.0
TAU_FRAMES = 1.5
RATE_BINS = 200
SHOWN = 4


@dataclass(frozen=True)
class View:
    """What there is to show: the run and its options, frames and how to see them, events, t_s of
    the frames used, and the number of the first of them."""

    run: Run[Any]
    config: Any
    source: Any
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
        most = PICTURES_PER_FRAME * len(self.t_s) / (PREVIEW_FPS * self.duration_s)
        return self.config.preview_slowdown or max(1.0, min(SHORTEST_S / self.duration_s, most))

    @property
    def exposure_s(self):
        """Time of the scene that one picture of the videos covers."""
        return 1 / (PREVIEW_FPS * self.slowdown)

    @property
    def tau_s(self):
        """Fading time of the traces, seconds of the scene."""
        return max(TAU_PICTURES * self.exposure_s, TAU_FRAMES * float(self.t_s.diff().median()))

    def slices(self, count):
        """Equal parts of the time: first and last event of each, and its start and end in whole
        microseconds."""
        start_us = round(float(self.t_s[0]) * 1e6)
        length_us = round(self.duration_s * 1e6)
        edges = sorted({start_us + length_us * k // count for k in range(count + 1)})
        ends = [0, *self.log.positions(edges[1:])]
        return zip(pairwise(ends), pairwise(edges), strict=True)

    def streams(self):
        """For every picture of the videos: the stream of its events, and its start and end,
        microseconds."""
        for (a, b), (start_us, end_us) in self.slices(
            max(1, round(self.duration_s / self.exposure_s))
        ):
            yield self.log.read(a, b), start_us, end_us


def write_page(view, state, sensor, clock, written):
    run = view.run
    frames = len(view.t_s)
    off = state.events - state.on
    pixels = view.log.height_px * view.log.width_px
    rate_hz = state.events / view.duration_s
    speed = frames * pixels / state.seconds / 1e6
    run.record(
        frames=frames,
        simulated_frames=state.simulated,
        width_px=view.log.width_px,
        height_px=view.log.height_px,
        duration_s=view.duration_s,
        events=state.events,
        events_on=state.on,
        events_off=off,
        rate_on_hz=state.on / view.duration_s,
        rate_off_hz=off / view.duration_s,
        seconds=state.seconds,
        mpixel_per_s=speed,
        large_step_share_of_moving=state.large_share,
        frame_rate_factor_needed=state.remedy,
        largest_value=state.largest,
    )
    run.card("Events", f"{state.events:,}", f"{state.on:,} ON, {off:,} OFF")
    run.card(
        "Rate", f"{short(rate_hz)}events/s", f"{short(rate_hz / pixels)}events per pixel and second"
    )
    run.card(
        "Frames",
        f"{frames}",
        f"{view.log.width_px} x {view.log.height_px}, {seconds(view.duration_s)}",
    )
    run.card("Speed", f"{speed:.3g} Mpixel/s", f"{state.seconds:.1f} s, decoding included")
    slow = state.large_share > WORRYING
    run.section("Is the video fast enough?")
    for sentence in warnings(view, state, sensor, slow):
        run.text(sentence)
    if slow:
        run.say(
            f"warning: the video is too slow: {state.large_share:.0%} of the moving pixels step by {LARGE} "
            "thresholds or more per frame; see the report."
        )
    if state.events:
        pictures(view)
    run.section(
        "Input and sensor",
        f"Clock: {clock}. Events carry that time in microseconds, from {view.t_s[0]:.6f} s to "
        f"{view.t_s[-1]:.6f} s.",
    )
    run.text(light(view))
    if view.config.upsample is not None:
        run.text(
            f"Upsampled: the sensor saw {state.simulated} frames, so that nothing moves by more than "
            f"{view.config.upsample:g} px from one to the next, along optical flow (see docs/upsampling.md)."
        )
    values = [(name, str(value)) for name, value in dataclasses.asdict(sensor).items()]
    run.table(f"Sensor: {view.config.preset}", ("parameter", "value"), values)
    if written:
        run.table(
            "Event files",
            ("file", "MB"),
            [(path.name, path.stat().st_size / 1e6) for path in written],
        )
    lead = (
        f"{state.events:,} events from {frames} frames of `{view.source.path.name}`, "
        f"{seconds(view.duration_s)}."
    )
    verdict = "**The video is too slow for its motion, see below.**"
    if not slow:
        fast = "The video is fast enough for its motion."
        if view.config.upsample:
            fast = "The frames that were put between are fast enough; whether the video is was not judged."
        verdict = fast if state.events else "Nothing moved."
    run.finish("Video to events", f"{verdict} {lead}")


def warnings(view, state, sensor, slow):
    """What the reader must know before the events are used, in sentences."""
    share = (
        f"Of the pixels that make events, {state.large_share:.1%} step by {LARGE} thresholds or more from "
        "one frame to the next. What happens inside such a step is not in the video: its events lie on a "
        "straight line of log intensity between two frames."
    )
    finer = (
        "smaller steps of --upsample"
        if view.config.upsample
        else "frames between with --upsample 0.5"
    )
    remedy = f"Record at about {math.ceil(state.remedy)} times the frame rate, or take {finer}."
    if view.config.upsample:
        share += " Judged with the frames put between, whose motion is a guess along optical flow."
    yield f"**Too slow for its motion.** {share} {remedy}" if slow else share
    if not state.events:
        yield (
            "**No events.** Nothing changed by a threshold: is the input still, or much darker than full "
            "scale (see --white-level)?"
        )
    low_pass_s = 1 / (2 * math.pi * sensor.cutoff_hz) if sensor.cutoff_hz > 0 else 0.0
    if max(low_pass_s, sensor.refractory_s) > SHARE_OF_DURATION * view.duration_s:
        yield (
            f"**Slow sensor.** The input lasts {seconds(view.duration_s)}; the sensor smooths over "
            f"{seconds(low_pass_s)} (low-pass at full light) and rests {seconds(sensor.refractory_s)} "
            "after an event, so much of what happens gives no event. `--preset clean` does neither."
        )
    if view.source.complaint:
        yield (
            f"**The decoder complained** about the file: {view.source.complaint}. Some frames may be damaged."
        )
    if state.largest < view.light.white / 4:
        yield (
            f"**Dark input.** The largest digital value is {state.largest:g}, full light is "
            f"{view.light.white:g}: the sensor works in its dark, linear part. For 12 bits stored in 16 "
            "give --white-level 4095."
        )
    if state.largest > view.light.white:
        yield (
            f"The largest digital value is {state.largest:g}, above full light ({view.light.white:g}); "
            "such values are taken as they are, brighter than 255."
        )
    width, height = view.log.width_px, view.log.height_px
    if abs(width * view.source.height_px / (height * view.source.width_px) - 1) > 0.01:
        yield (
            f"The frames of {view.source.width_px} x {view.source.height_px} pixels were stretched to "
            f"{width} x {height}, other proportions."
        )


def light(view):
    gamma = (
        "the sRGB gamma is undone, so intensities are linear in light"
        if view.config.linear
        else "digital values are taken as intensities, gamma and all, as v2e does (--linear undoes the sRGB "
        "gamma)"
    )
    return (
        f"Light: digital value {view.light.white:g} is 255 for the sensor; {gamma}. Colour is weighted "
        "0.2126 red, 0.7152 green, 0.0722 blue."
    )


def pictures(view):
    run = view.run
    config = view.config
    run.section("Events")
    window_s = max(view.exposure_s, float(view.t_s.diff().median()))
    caption = (
        f"Frames, and the events of {seconds(window_s)} around them: red brighter, blue darker; full "
        f"colour at {FULL_SCALE:g} events."
    )
    run.figure(first_pictures(view, window_s), "pictures", caption)
    middle_s, rate_hz = rates_over_time(view)
    caption = f"Events per second of the whole picture, in {len(middle_s)} equal parts of the time."
    run.figure(rate_figure(middle_s, rate_hz), "rates", caption)
    few = view.log.pick(sample(view.log.count, POINTS, torch.Generator().manual_seed(config.seed)))
    figure = space_time_figure(few, points=POINTS, total=view.log.count)
    caption = (
        f"Events in space and time: {len(few):,} of {view.log.count:,}, drawn at random. Orange brighter, "
        "blue darker."
    )
    run.figure(figure, "space_time", caption, dpi=90)
    if config.preview:
        covers = (
            f"{view.slowdown:.4g} times slower than the scene, each picture covers "
            f"{seconds(view.exposure_s)}. Red brighter, blue darker."
        )
        video(view, "events", event_pictures(view), f"Events; {covers}")
        fading = f"Fading traces, to 1/e in {seconds(view.tau_s)} of the scene"
        video(view, "decay", trace_pictures(view), f"{fading}; {covers}")


def video(view, name, made, caption):
    path = view.run.path(f"{name}.mp4")
    write_video(path, made, PREVIEW_FPS)
    size_mb = path.stat().st_size / 1e6
    if size_mb <= MOST_ON_PAGE_MB:
        view.run.video(path.name, caption)
    else:
        view.run.text(f"{caption} `{path.name}`, {size_mb:.1f} MB, lies beside this page.")
    view.run.say(f"Written: {path}")


def event_pictures(view):
    for stream, start_us, end_us in view.streams():
        yield picture(to_counts(stream, [start_us / 1e6, end_us / 1e6])[0], FULL_SCALE)


def trace_pictures(view):
    start = None
    for stream, _, end_us in view.streams():
        trace = decay_from_stream(stream, [end_us], view.tau_s, start=start, dtype=torch.float64)[0]
        start = (trace, end_us)
        yield picture(trace, FULL_SCALE)


def rates_over_time(view):
    """Middle of equal parts of the time, seconds [K], and events per second in them, [K, 2], ON
    first."""
    rows = []
    middle_s = []
    for (a, b), (start_us, end_us) in view.slices(min(RATE_BINS, len(view.t_s) - 1)):
        on = sum(int((view.log.read(k, min(k + 2**20, b)).p > 0).sum()) for k in range(a, b, 2**20))
        rows.append((on * 1e6 / (end_us - start_us), (b - a - on) * 1e6 / (end_us - start_us)))
        middle_s.append((start_us + end_us) / 2e6)
    return torch.tensor(middle_s, dtype=torch.float64), torch.tensor(rows, dtype=torch.float64)


def first_pictures(view, window_s):
    """Figure: frames at a few times above, the events around them below."""
    count = len(view.t_s)
    rows = {"frame": {}, "events": {}}
    for index in sorted({round((k + 0.5) / SHOWN * (count - 1)) for k in range(SHOWN)}):
        time_s = float(view.t_s[index])
        title = f"frame {view.first + index}, {1e3 * (time_s - float(view.t_s[0])):.4g} ms"
        frame = next(view.source.read(view.first + index))
        light = view.light([frame], view.first + index)[0].cpu().numpy()
        # what is not made linear has a display's gamma already, and is shown in colours as it is
        shown = np.repeat((light / 255).clip(0, 1)[..., None], 3, 2)
        rows["frame"][title] = light if view.config.linear else shown
        start_us = round((time_s - window_s / 2) * 1e6)
        end_us = max(round((time_s + window_s / 2) * 1e6), start_us + 1)
        stream = view.log.read(*view.log.positions([start_us, end_us]))
        counts = to_counts(stream, [start_us / 1e6, end_us / 1e6])[0]
        rows["events"][title] = picture(counts, FULL_SCALE).numpy()
    return show.pictures(rows, side=3)


def short(value):
    """A number with three digits and a prefix, to stand before a unit: 306 M, 2.07 k."""
    size, prefix = next(((size, prefix) for size, prefix in PREFIXES if value >= size), (1.0, ""))
    return f"{value / size:.3g} {prefix}"


def seconds(duration_s):
    return f"{duration_s:.4g} s" if duration_s >= 1 else f"{duration_s * 1e3:.4g} ms"
