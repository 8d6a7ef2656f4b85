"""Hard events: single timestamped events of a sensor that looks at frames."""

from contextlib import contextmanager
from dataclasses import replace

import torch
from torch import Generator, Tensor

from codesign.checks import FLOATS, check
from codesign.errors import DomainError
from codesign.events.entry import (
    Times,
    check_chunk,
    check_frames,
    check_later,
    check_per_pixel,
    check_times,
    warn_of_scale,
)
from codesign.events.intensity import FrontEnd, kernel_levels, log_levels
from codesign.events.kernels import Lanes
from codesign.events.sensor import v2e
from codesign.events.sensor.crossing import Crossings, DenseCounts, KeyLayout
from codesign.events.sensor.model import SensorModel, check_generator, check_sensor
from codesign.events.sensor.state import SensorState, begin, change, check_state, leak_before
from codesign.events.sensor.v2e import Comparators
from codesign.events.stream import concatenate, ordered
from codesign.exclusive import exclusive
from codesign.types import EventStream

EVENTS_PER_PIXEL = 1.0  # room made at first; on a processor, what no event writes to is no memory
KEY_BITS = 63


@torch.no_grad()
def simulate(
    frames: Tensor,
    t_s: Times,
    sensor: SensorModel,
    generator: Generator | None = None,
    state: SensorState | None = None,
    *,
    log_input: bool = False,
) -> EventStream:
    """Events of a sensor that sees the frames one after the other; log level runs linearly between
    them.

    Per interval a pixel fires each time its level crosses its memorised level by one more
    threshold, as many times as it does so. Low-pass, mismatch, leak, noise, dead time and hot
    pixels come with the fields of the sensor. Without them the counts are those of ``memory``.

    Args:
      frames: [T, H, W] linear intensity on the 0-255 scale (lin-log is applied here; brighter
        values are taken as they are), finite, >= 0.
      t_s: [T] frame times, seconds, strictly increasing; microseconds stay exact at epoch times
        (float64).
      sensor: SensorModel.
      generator: torch.Generator for all that is random. None: the one in ``state``, which starts at
        seed 0.
      state: SensorState carried over chunks, changed in place; empty for the first. Later chunks
        start with the frame after the last one seen, and may hold a single frame. Any chunking
        gives the events of the whole. A later chunk may have another sensor (biases that change in
        a recording): its pixels keep the numbers drawn for them, and those that stand beyond their
        new thresholds fire at once. What the first sensor had not, and needs draws or a memory, is
        refused.
      log_input: frames are natural-log levels, such as ln(I + eps) of linear frames of high dynamic
        range (ESIM: eps 1e-3 with frames 0 to 1; of the 0-255 scale where the sensor's speed or
        noise depends on intensity).
    Returns: EventStream sorted by (t, y, x, p), int64 microseconds. The first frame gives no event.
      float32 frames time events to the microsecond where the log level moves by 1 per second or
      more; slower ones to about 6e-8 |level| over its speed (float64 frames to the microsecond).
    Gradient: none (see ``sensor_counts`` for one).
    Raises: ShapeError for too few frames or a size that changed; DomainError for NaN, infinite or
      negative frames, or times that do not increase. The state is then as before.
    Source: Rebecq et al., ESIM, CoRL 2018 (linear interpolation of log intensity); v2e (Hu, Liu,
      Delbruck, CVPR-W 2021), docs/events.md.

    Example:
    >>> from codesign import events
    >>> frames = torch.tensor([50.0, 100.0]).reshape(2, 1, 1)  # a pixel brightens over 10 ms
    >>> stream = events.simulate(frames, [0.0, 0.01], events.SensorModel(theta_on=0.2))
    >>> stream.t_us.tolist(), stream.p.tolist()  # 0.2, 0.4 and 0.6 of ln 2
    ([2885, 5771, 8656], [1, 1, 1])
    """
    check_sensor(sensor)
    check(frames, "T H W", "frames", FLOATS)
    front_end = FrontEnd(log_input)
    state = SensorState() if state is None else state
    with _drawn_in_vain(generator, state):
        moved, frames, times_s, generator, at_once = _open(
            frames, t_s, sensor, generator, state, front_end
        )
        start_us = round(moved.time_s * 1e6)
        layout = KeyLayout(start_us, *frames.shape[1:])
        _check_range(layout, times_s[-1])
        stream = _events(frames, times_s, sensor, generator, moved, front_end, layout)
        if at_once is not None:
            # behind the interval before, as all others
            stream = concatenate([_fired(at_once, start_us + 1), stream])
    state.__dict__.update(moved.__dict__)
    return stream


@exclusive
@torch.no_grad()
def dense_counts(
    frames: Tensor,
    t_s: Times,
    sensor: SensorModel,
    generator: Generator | None = None,
    state: SensorState | None = None,
    *,
    log_input: bool = False,
) -> Tensor:
    """The events of ``simulate`` as counts per interval, without the list between; any pixel shape.

    Args: as for ``simulate``, but frames: [T, ...]; timing "interpolated" only.
    Returns: [T-1, 2, ...] ([T, 2, ...] for a later chunk), ON first.
    """
    if check_sensor(sensor).timing != "interpolated":
        raise DomainError(
            f"dense counts come from timing 'interpolated', the sensor has {sensor.timing!r}; use simulate "
            "and to_counts."
        )
    front_end = FrontEnd(log_input)
    state = SensorState() if state is None else state
    with _drawn_in_vain(generator, state):
        moved, frames, times_s, generator, at_once = _open(
            frames, t_s, sensor, generator, state, front_end
        )
        crossings = Crossings(frames, front_end, times_s, sensor, generator, moved)
        sink = DenseCounts(crossings.lanes, len(frames))
        crossings.advance(moved, sink)
    state.__dict__.update(moved.__dict__)
    counts = sink.tensor((len(frames), 2, *frames.shape[1:]))
    if at_once is not None:
        counts[0] += at_once
    return counts


@contextmanager
def _drawn_in_vain(generator, state):
    """Within it, what fails leaves the generator as it was."""
    own = state.generator if generator is None else generator
    before = own.get_state() if isinstance(own, torch.Generator) else None
    try:
        yield
    except BaseException:
        if before is not None:
            own.set_state(before)
        raise


def _open(frames, t_s, sensor, generator, state, front_end):
    """Check what can be checked without reading every frame, and begin a copy of an empty state
    with the first. Returns the copy, the frames and times still to be seen, the generator, and what
    a changed sensor fires at once (``change``)."""
    check_state(state, sensor)
    state = replace(state)
    fresh = state.level is None
    check(frames, "T>=2 ..." if fresh else "T ...", "frames", FLOATS)
    times_s = check_times(t_s, len(frames))
    if state.generator is None:
        state.generator = torch.Generator().manual_seed(0)
    generator = state.generator if generator is None else generator
    check_generator(generator)
    frames = frames.detach()
    if fresh:
        warn_of_scale(frames, front_end.log_input)
        check_frames(frames[:1], 1, non_negative=not front_end.log_input)
        if sensor.timing == "v2e":
            level = v2e.levels(frames[:1], front_end)
        else:
            level, _ = kernel_levels(frames[:1], front_end)  # as those of all later frames
        intensity = frames[0].exp() if front_end.log_input else frames[0]
        begin(state, sensor, intensity, level[0], float(times_s[0]), generator)
        if sensor.timing == "interpolated":  # v2e's leaks begin together
            leak_before(state, sensor, generator)
        return state, frames[1:], times_s[1:].tolist(), generator, None
    # v2e keeps single precision whatever the frames have
    dtype = frames.dtype if sensor.timing == "v2e" else state.level.dtype
    check_chunk(frames, state.level.shape, dtype)
    check_later(times_s, state.time_s)
    return state, frames, times_s.tolist(), generator, change(state, sensor)


def _fired(counts, t_us):
    """Stream of whole counts [2, H, W] at one time."""
    polarity, y, x = counts.nonzero(as_tuple=True)
    many = counts[polarity, y, x].long()
    x, y, p = (column.repeat_interleave(many) for column in (x, y, 1 - 2 * polarity))
    return ordered(torch.full_like(x, t_us), x, y, p, *counts.shape[1:])


@exclusive
def _events(frames, times_s, sensor, generator, state, front_end, layout):
    """Stream of the events between frames; keys are views of drjit's memory, which nobody else may
    use meanwhile. A chunk busier than the room made for it is run again with the room it needs."""
    timing = Comparators if sensor.timing == "v2e" else Crossings
    size = timing.frames_per_kernel(frames[0].numel(), sensor)
    parts, density = [], EVENTS_PER_PIXEL
    for first in range(0, len(frames), size):
        chunk, ends_s = frames[first : first + size], times_s[first : first + size]
        source = timing(chunk, front_end, ends_s, sensor, generator, state)
        had_room, total = False, None
        while not had_room:
            trial = replace(state)
            keys = source.fire(trial, layout, density, total)
            had_room, found, total = keys.counted()
            density = max(density, 1.25 * found)
        state.__dict__.update(trial.__dict__)
        parts += keys.sorted()
    columns = layout.columns(Lanes(frames, frames[0].numel()), parts)
    # slots of several frames of v2e may have one microsecond
    ends = torch.tensor([len(keys) for _, keys in parts]).cumsum(0)
    ends = ends[(ends > 0) & (ends < ends[-1])].to(frames.device)
    if bool((columns[0][ends] <= columns[0][ends - 1]).any()):
        return ordered(*columns, *frames.shape[1:])
    return EventStream(*columns, *frames.shape[1:])


def _check_range(layout, end_s):
    if end_s * 1e6 - layout.origin_us >= 2 ** (KEY_BITS - layout.pixel_bits):
        size = f"{layout.height_px} x {layout.width_px} pixels"
        raise DomainError(
            f"frames from {layout.origin_us} us to {end_s!r} s with {size} exceed 64-bit event keys; pass "
            "them in shorter chunks with a state."
        )


@torch.no_grad()
def naive(
    frames: Tensor,
    t_s: Times,
    theta: Tensor | float,
    *,
    log_input: bool = False,
) -> EventStream:
    """At most one event per pixel and frame: ON when dL >= theta, OFF when dL <= -theta between
    consecutive frames.

    What stays below the threshold is forgotten, what exceeds it several times counts once: slow
    motion goes unseen and fast edges lose events.

    Args:
      frames: [T, H, W] linear intensity on the 0-255 scale (lin-log is applied here); log intensity
        with ``log_input``.
      t_s: [T] frame times, seconds, strictly increasing. An event gets the time of the later frame,
        to the nearest microsecond.
      theta: contrast threshold > 0, natural log units, scalar or broadcasting over one frame.
    Returns: EventStream sorted by (t, y, x, p).
    Gradient: none.
    Raises: ShapeError for fewer than two frames or other shapes; DomainError for theta <= 0, NaN,
      negative input or times that do not increase.
    """
    level = log_levels(frames, log_input, minimum=2)
    check(level, "T H W", "frames")
    theta = check_per_pixel(theta, "theta", level)
    times_us = (check_times(t_s, len(level)) * 1e6).round().long().to(level.device)
    step = level.diff(dim=0)
    polarity = (step >= theta).long() - (step <= -theta).long()
    frame, y, x = polarity.nonzero(as_tuple=True)
    return ordered(times_us[frame + 1], x, y, polarity[frame, y, x], *level.shape[1:])
