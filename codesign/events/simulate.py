"""Hard events: single timestamped events of a sensor that looks at frames."""

from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError
from codesign.events.entry import check_times
from codesign.events.intensity import log_levels
from codesign.events.memory import compare
from codesign.events.sensor import draw_shot_counts, draw_thresholds
from codesign.events.stream import ordered


@dataclass
class SensorState:
    """What a sensor remembers between chunks of frames. Make an empty one; ``simulate`` fills it and moves it on.

    reference, level: [H, W] memorised and last log level. theta_on, theta_off: [H, W] drawn thresholds. time_s: time of the last frame.
    generator: used when none is passed; starts at seed 0.
    """

    reference: Tensor | None = None
    level: Tensor | None = None
    theta_on: Tensor | None = None
    theta_off: Tensor | None = None
    time_s: float | None = None
    generator: torch.Generator | None = None


@torch.no_grad()
def simulate(frames, t_s, sensor, generator=None, state=None):
    """Events of a sensor that sees the frames one after the other; log intensity runs linearly between them.

    Per interval a pixel fires each time its log level crosses its memorised level by one more threshold, as many times as it does so. The counts are
    those of ``memory`` with the same thresholds. Shot noise comes on top, evenly spread over each interval, and does not move the memorised level.

    Args:
      frames: [T, H, W] linear intensity on the 0-255 scale (lin-log is applied here), finite, >= 0.
      t_s: [T] frame times, seconds, strictly increasing; microseconds stay exact at epoch times (float64).
      sensor: SensorModel.
      generator: torch.Generator for mismatch and shot noise. None: the one in ``state``, which starts at seed 0.
      state: SensorState carried over chunks, changed in place; empty for the first. Later chunks start with the frame after the last one seen, and may
        hold a single frame. Chunks together give the events of the whole.
    Returns: EventStream sorted by (t, y, x, p), int64 microseconds. The first frame gives no event.
    Gradient: none.
    Raises: ShapeError for too few frames or a size that changed; DomainError for NaN, infinite or negative frames, or times that do not increase.
    Source: Rebecq et al., ESIM, CoRL 2018 (linear interpolation of log intensity); v2e (Hu et al., CVPR-W 2021) for mismatch.
    """
    state = SensorState() if state is None else state
    level = log_levels(frames, log_input=False, minimum=2 if state.level is None else 1)
    if level.ndim != 3:
        raise ShapeError(f"frames have shape {list(frames.shape)}; [T, H, W] is needed.")
    times_s = check_times(t_s, len(level)).tolist()
    if state.generator is None:
        state.generator = torch.Generator().manual_seed(0)
    generator = state.generator if generator is None else generator
    place = {"dtype": level.dtype, "device": level.device}
    if state.level is None:
        state.theta_on, state.theta_off = draw_thresholds(sensor, level.shape[1:], generator, **place)
        state.reference, state.level, state.time_s = level[0].clone(), level[0], times_s[0]
        level, times_s = level[1:], times_s[1:]
    elif state.level.shape != level.shape[1:] or state.level.dtype != level.dtype:
        now, before = (f"{frame.dtype} frames of {list(frame.shape)} pixels" for frame in (level[0], state.level))
        raise ShapeError(f"{now} follow {before}; a sensor keeps its size and type.")
    elif state.time_s is not None and times_s[0] <= state.time_s:
        raise DomainError(f"the chunk starts at {times_s[0]!r} s, the last frame seen was at {state.time_s!r} s; times must go on increasing.")
    parts = []
    for now, time_s in zip(level, times_s, strict=True):
        parts += _interval(now, time_s, sensor, generator, state)
    t_us, x, y, p = (torch.cat(column) for column in zip(*parts, strict=True))
    return ordered(t_us, x, y, p, *level.shape[1:])


def _interval(now, time_s, sensor, generator, state):
    """Events (t_us, x, y, p) of the interval up to ``time_s``, signal and noise; moves the state on."""
    counts = now.new_empty((2, *now.shape))
    before = state.reference.clone()
    compare(now - state.reference, state.theta_on, state.theta_off, state.reference, counts)
    found = []
    for polarity, fired, theta in ((1, counts[0], state.theta_on), (-1, counts[1], state.theta_off)):
        y, x, nth = _each(fired)
        crossed = before[y, x].double() + polarity * theta[y, x].double() * (nth + 1)
        start, end = state.level[y, x].double(), now[y, x].double()
        # rounding can leave a crossing a hair outside the interval, or the last threshold of a huge step for a frame that no longer moves
        share = torch.where(end == start, 1.0, (crossed - start) / (end - start)).clamp(0, 1)
        found.append((_microseconds(state.time_s, time_s, share), x, y, torch.full_like(x, polarity)))
    noise = draw_shot_counts(sensor, now.shape, [time_s - state.time_s], generator, device=now.device)[0] if sensor.shot_rate_hz else ()
    for polarity, fired in zip((1, -1), noise, strict=bool(len(noise))):
        y, x, _ = _each(fired)
        share = torch.rand(len(x), generator=generator, dtype=torch.float64, device=generator.device).to(x.device)
        found.append((_microseconds(state.time_s, time_s, share), x, y, torch.full_like(x, polarity)))
    state.level, state.time_s = now, time_s
    return found


def _each(counts):
    """Row, column and running number (from 0) of every single event in a map of counts."""
    y, x = counts.nonzero(as_tuple=True)
    many = counts[y, x].long()
    nth = torch.arange(int(many.sum()), device=counts.device) - (many.cumsum(0) - many).repeat_interleave(many)
    return y.repeat_interleave(many), x.repeat_interleave(many), nth


def _microseconds(start_s, end_s, share):
    """Time at a share of an interval to the nearest microsecond after its start, so that rounding moves no event to the interval before.

    Counted from the start as a whole number: epoch times lose nothing.
    """
    start_us, end_us = round(start_s * 1e6), round(end_s * 1e6)
    since_us = share * ((end_s - start_s) * 1e6) + (start_s * 1e6 - start_us)
    return start_us + since_us.round().long().clamp(min=min(1, end_us - start_us), max=end_us - start_us)
