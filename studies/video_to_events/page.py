"""What a run of video_to_events shows: figures of the events, two videos, warnings, metrics, and the page."""

import dataclasses
import math

import torch

from codesign.events import write_video
from codesign.events.views.rate_curves import PREFIXES, rate_figure
from codesign.events.views.space_time import sample, space_time_figure
from studies.frame.timing import resident_mb
from studies.video_to_events import pictures as drawn
from studies.video_to_events import steps as steps_

SHARE_OF_DURATION = 0.2  # a sensor whose reactions take more of the input hides what happens in it
MOST_ON_PAGE_MB = 25.0  # larger videos lie beside the page


def show(view, state, steps, sensor, clock, written):
    """Record the metrics, draw everything, and write the page."""
    run = view.run
    frames = len(view.t_s)
    off = state.events - state.on
    pixels = view.log.height_px * view.log.width_px
    rate_hz = state.events / view.duration_s / pixels
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
        events_per_pixel_s=rate_hz,
        seconds=state.seconds,
        mpixel_per_s=frames * pixels / state.seconds / 1e6,
        simulating_s=state.simulating_s,
        simulating_mpixel_per_s=frames * pixels / state.simulating_s / 1e6,
        resident_mb=resident_mb(),
        large_step_share=steps.large_share,
        large_step_share_of_moving=steps.large_share_of_moving,
        frame_rate_factor_needed=steps.remedy,
        largest_value=state.largest,
    )
    run.card("Events", f"{state.events:,}", f"{state.on:,} ON, {off:,} OFF")
    run.card(
        "Rate",
        f"{short(state.events / view.duration_s)}events/s",
        f"{short(rate_hz)}events per pixel and second",
    )
    run.card("Frames", f"{frames}", f"{view.log.width_px} x {view.log.height_px}, {seconds(view.duration_s)}")
    run.card(
        "Speed",
        f"{frames * pixels / state.seconds / 1e6:.1f} Mpixel/s",
        f"{state.seconds:.1f} s, decoding included",
    )
    warn(view, state, steps, sensor)
    if state.events:
        pictures(view)
    run.section(
        "Input and sensor",
        f"Clock: {clock}. Events carry that time in microseconds, from {float(view.t_s[0]):.6f} s to "
        f"{float(view.t_s[-1]):.6f} s.",
    )
    run.text(_light(view))
    if view.config.upsample is not None:
        run.text(
            f"Upsampled: the sensor saw {state.simulated} frames, so that nothing moves by more than "
            f"{view.config.upsample:g} px from one to the next, along optical flow (see docs/upsampling.md)."
        )
    run.table(
        f"Sensor: {view.config.preset}",
        ("parameter", "value"),
        [(name, str(value)) for name, value in dataclasses.asdict(sensor).items()],
    )
    if written:
        run.table("Event files", ("file", "MB"), [(path.name, path.stat().st_size / 1e6) for path in written])
    lead = f"{state.events:,} events from {frames} frames of `{view.source.path.name}`, {seconds(view.duration_s)}."
    run.finish(
        "Video to events",
        lead + (" **The video is too slow for its motion, see below.**" if steps.too_large else ""),
    )


def warn(view, state, steps, sensor):
    """What the reader must know before the events are used."""
    run = view.run
    least = steps_.LARGE
    run.section("Is the video fast enough?")
    found = (
        f"Of the pixels that make events, {steps.large_share_of_moving:.1%} step by {least} thresholds or "
        f"more from one frame to the next ({steps.large_share:.2%} of all pixels). "
        "What happens inside such a step is not in the video: its events lie on a straight line of log "
        "intensity between two frames."
    )
    if steps.too_large:
        found = f"**Too slow for its motion.** {found} Record at about {math.ceil(steps.remedy)} times the frame rate, or put frames between with --upsample 0.5."
        run.say(
            f"warning: the video is too slow: {steps.large_share_of_moving:.0%} of the moving pixels step "
            f"by {least} thresholds or more per frame; see the report."
        )
    run.text(found)
    figure = drawn.steps_figure(steps)
    run.figure(
        figure,
        "steps",
        "Steps of log intensity from frame to frame, of the pixels that move by at least one threshold; up "
        f"to {least} thresholds are well timed.",
    )
    if not state.events:
        run.text(
            "**No events.** Nothing changed by a threshold: is the input still, or much darker than full "
            "scale (see --white-level)?"
        )
    low_pass_s = 1 / (2 * math.pi * sensor.cutoff_hz) if sensor.cutoff_hz > 0 else 0.0
    if max(low_pass_s, sensor.refractory_s) > SHARE_OF_DURATION * view.duration_s:
        run.text(
            f"**Slow sensor.** The input lasts {seconds(view.duration_s)}; the sensor smooths over "
            f"{seconds(low_pass_s)} (low-pass at full light) and rests {seconds(sensor.refractory_s)} "
            "after an event, so much of what happens gives no event. `--preset clean` does neither."
        )
    if view.source.complaint:
        run.text(
            f"**The decoder complained** about the file: {view.source.complaint}. Some frames may be damaged."
        )
    white = view.config.white_level or view.source.white
    if state.largest < white / 4:
        run.text(
            f"**Dark input.** The largest digital value is {state.largest:g}, full light is {white:g}: the "
            "sensor works in its dark, linear part. For 12 bits stored in 16 give --white-level 4095."
        )
    if state.largest > white:
        run.text(
            f"The largest digital value is {state.largest:g}, above full light ({white:g}); such values are "
            "taken as they are, brighter than 255."
        )
    width = view.log.width_px
    height = view.log.height_px
    if abs(width * view.source.height_px / (height * view.source.width_px) - 1) > 0.01:
        run.text(
            f"The frames of {view.source.width_px} x {view.source.height_px} pixels were stretched to "
            f"{width} x {height}, other proportions."
        )


def pictures(view):
    """First pictures, rates, space-time figure, and the videos."""
    run = view.run
    config = view.config
    run.section("Events")
    window_s = max(view.exposure_s, float(view.t_s.diff().median()))
    caption = f"Frames, and the events of {seconds(window_s)} around them: red brighter, blue darker; full colour at {config.preview_full_scale:g} events."
    run.figure(drawn.first_pictures(view, window_s), "pictures", caption)
    middle_s, rate_hz = drawn.rates_over_time(view)
    run.figure(
        rate_figure(middle_s, rate_hz),
        "rates",
        f"Events per second of the whole picture, in {len(middle_s)} equal parts of the time.",
    )
    few = view.log.pick(sample(view.log.count, config.points, torch.Generator().manual_seed(config.seed)))
    figure = space_time_figure(few, points=config.points, total=view.log.count)
    run.figure(
        figure,
        "space_time",
        f"Events in space and time: {len(few):,} of {view.log.count:,}, drawn at random. Orange brighter, "
        "blue darker.",
    )
    if config.preview:
        fading = f"Fading traces, to 1/e in {seconds(view.tau_s)} of the scene"
        for name, make, caption in (
            ("events", drawn.event_pictures, "Events"),
            ("decay", drawn.trace_pictures, fading),
        ):
            path = run.path(f"{name}.mp4")
            write_video(path, make(view), config.preview_fps)
            caption = f"{caption}; {view.slowdown:.4g} times slower than the scene, each picture covers {seconds(view.exposure_s)}. Red brighter, blue darker."
            size_mb = path.stat().st_size / 1e6
            if size_mb <= MOST_ON_PAGE_MB:
                run.video(path.name, caption)
            else:
                run.text(f"{caption} `{path.name}`, {size_mb:.0f} MB, lies beside this page.")
            run.say(f"Written: {path}")


def short(value):
    """A number with three digits and a prefix, to stand before a unit: 306 M, 2.07 k."""
    size, prefix = next(((size, prefix) for size, prefix in PREFIXES if value >= size), (1.0, ""))
    return f"{value / size:.3g} {prefix}"


def seconds(duration_s):
    """A duration in the unit that suits it."""
    return f"{duration_s:.4g} s" if duration_s >= 1 else f"{duration_s * 1e3:.4g} ms"


def _light(view):
    config = view.config
    white = view.config.white_level or view.source.white
    as_stored = (
        "digital values are taken as intensities, gamma and all, as v2e does (--linear undoes the sRGB gamma)"
    )
    gamma = "the sRGB gamma is undone, so intensities are linear in light" if config.linear else as_stored
    return f"Light: digital value {white:g} is 255 for the sensor; {gamma}. Colour is weighted 0.2126 red, 0.7152 green, 0.0722 blue."
