"""The sensor as v2e times it: every pixel's i-th event of a frame gets the i-th of the frame's
equal time slots.

Kept beside the interpolated sensor so that results with v2e can be repeated event by event;
precisions and the order of operations are v2e's.
Source: Hu, Liu, Delbruck, "v2e: From Video Frames to Realistic DVS Events", CVPR-W 2021, and the
  published program.
"""

import math

import torch

from codesign.errors import DomainError
from codesign.events.intensity import light_share

# up to here single-precision seconds resolve a microsecond, and v2e's rounding is repeated; later
# slots are computed in double
EXACT_SINGLE_S = 8.0


def levels(frames, front_end):
    """Log levels as v2e has them: lin-log is computed in double precision, rounded to 8 decimals
    and kept in single."""
    if front_end.log_input:
        return frames
    return ((front_end.level(frames.double()) * 1e8).round() / 1e8).float()


def interval(frame, level, time_s, sensor, generator, state):
    """Events of the interval that ends with ``frame``; moves the state on.

    Args:
      frame: [H, W] intensity 0 to 255.
      level: [H, W] from ``levels``.
      time_s: its time.
    Returns: t_us, x, y, p: int64 [N] each, unsorted.
    """
    dt_s = time_s - state.time_s
    light = light_share(frame.double()) if sensor.cutoff_hz > 0 or sensor.has_shots else None
    seen = _photoreceptor(level, light, dt_s, sensor, generator, state)
    if sensor.leaks:
        rate_hz = state.leak_hz
        if sensor.leak_jitter > 0:
            rate_hz = rate_hz * (1 - sensor.leak_jitter * _randn(rate_hz, generator))
        state.reference = state.reference - dt_s * rate_hz * state.theta_on.to(rate_hz)
    difference = seen - state.reference
    rising = difference > 0
    theta = torch.where(rising, state.theta_on, state.theta_off)
    # single precision without, double with a low-pass
    fired = torch.div(difference.abs(), theta.to(difference), rounding_mode="floor")
    slots = max(1, int(fired.max()))
    times = _slots(state.time_s - state.start_s, time_s - state.start_s, dt_s, slots)
    if sensor.refractory_s > dt_s / slots:
        fired, place, nth = _with_dead_time(fired, times, sensor.refractory_s, state)
    else:
        place, nth = _each(fired)
        if state.last_event_s is not None:
            last_s = times.to(state.last_event_s.dtype)[(fired - 1).clamp(min=0).long()]
            state.last_event_s = torch.where(fired > 0, last_s, state.last_event_s)
    found = [(place, nth, 2 * rising.flatten()[place].long() - 1)]
    # a single-precision product at all times
    moved = fired.float() * theta.float()
    state.reference = state.reference.to(difference) + moved.copysign(difference)
    if sensor.has_shots:
        found += _shots(light, dt_s, slots, sensor, generator, state)
    state.time_s = time_s
    place, nth, p = (torch.cat(column) for column in zip(*found, strict=True))
    y = place // level.shape[1]
    start_us = round(state.start_s * 1e6)
    since_s = times.double() + (state.start_s - start_us / 1e6)
    return start_us + (since_s * 1e6).round().long()[nth], place - y * level.shape[1], y, p


def _photoreceptor(level, light, dt_s, sensor, generator, state):
    """Low-passed level, plus noise; moves both on."""
    omega = 2 * math.pi * sensor.cutoff_hz
    if sensor.cutoff_hz > 0:
        share = (light * (dt_s * omega)).clamp(max=1)
        state.level = (1 - share) * state.level + share * level
    else:
        state.level = level
    if not sensor.photoreceptor_noise:
        return state.level
    share = dt_s * omega
    if share >= 2:
        raise DomainError(
            f"frames {dt_s:g} s apart make v2e's noise filter of {sensor.cutoff_hz:g} Hz unstable; use "
            f"frames closer than {2 / omega:.3g} s, or timing 'interpolated'."
        )
    # the filter lets this part of white noise through
    strength = sensor.noise_level() / math.sqrt(share / (2 - share))
    state.noise = (1 - share) * state.noise + share * strength * _randn(state.noise, generator)
    return state.level + state.noise


def _slots(before_s, now_s, dt_s, count):
    """[count] times of the frame's slots since the first frame, seconds.

    In single precision they are torch.linspace as v2e's processor made it, from the nearer end and
    rounded once (a fused multiply-add); without AVX2 torch rounds twice, and a dead time that ends
    at a slot ends later.
    """
    if now_s >= EXACT_SINGLE_S:
        return torch.linspace(before_s + dt_s / count, now_s, count, dtype=torch.float64)
    first, last = torch.tensor([before_s + dt_s / count, now_s], dtype=torch.float32)
    step = ((last - first) / max(count - 1, 1)).double()
    nth = torch.arange(count, dtype=torch.float64)
    rising = first.double() + step * nth
    falling = last.double() - step * (count - 1 - nth)
    return torch.where(nth < max(count // 2, 1), rising, falling).float()


def _with_dead_time(fired, times, refractory_s, state):
    """Keep the events that come later than the dead time behind the last one kept; the others are
    not counted, so the next frames see them again. Returns their counts, and place and slot of
    each."""
    kept = torch.zeros_like(fired)
    found = []
    last = state.last_event_s.to(times.dtype, copy=True)  # the caller's stays if this fails
    for index, time in enumerate(times):
        ready = (fired > index) & (time - last > refractory_s)
        kept += ready
        last = last.where(~ready, time)
        place = _places(ready)
        found.append((place, torch.full_like(place, index)))
    state.last_event_s = last
    return kept, *(torch.cat(column) for column in zip(*found, strict=True))


def _shots(light, dt_s, slots, sensor, generator, state):
    """Noise events: at most one per pixel and frame, in the last slot; they set the memorised level
    to the level seen."""
    chance = sensor.shot_rate_hz / 2 * dt_s * (1 - 0.75 * light)
    draw = torch.rand(
        light.shape, generator=generator, dtype=torch.float64, device=generator.device
    )
    draw = draw.to(light.device)
    on = draw > 1 - chance * (sensor.theta_on / state.theta_on)
    off = draw < chance * (sensor.theta_off / state.theta_off)
    state.reference = torch.where(on | off, state.level, state.reference)
    places = ((_places(fired), p) for fired, p in ((on, 1), (off, -1)))
    return [(at, torch.full_like(at, slots - 1), torch.full_like(at, p)) for at, p in places]


def _randn(like, generator):
    return torch.randn(
        like.shape, generator=generator, dtype=like.dtype, device=generator.device
    ).to(like.device)


def _places(mask):
    """Where a mask holds, row by row; numpy finds it in a tenth of torch's time."""
    return torch.from_numpy(mask.cpu().numpy().ravel().nonzero()[0]).to(mask.device)


def _each(counts):
    """Place and running number (from 0) of every single event in a map of counts."""
    place = _places(counts > 0)
    many = counts.flatten()[place].long()
    before = (many.cumsum(0) - many).repeat_interleave(many)
    return place.repeat_interleave(many), torch.arange(len(before), device=place.device) - before
