"""The sensor as v2e times it: every pixel's i-th event of a frame gets the i-th of the frame's
equal time slots.

Kept beside the interpolated sensor so that results with v2e can be repeated event by event;
precisions and the order of operations are v2e's. A frame has as many slots as its busiest pixel has
events, which a run without events finds; with a dead time, which ends at slots, runs go on until
they find the slots that they began with.
Source: Hu, Liu, Delbruck, "v2e: From Video Frames to Realistic DVS Events", CVPR-W 2021, and the
  published program.
"""

import math
from dataclasses import replace

import numpy as np
import torch

from codesign.errors import DomainError
from codesign.events.entry import check_frames
from codesign.events.intensity import DARK_SLOPE, JOINT, FrontEnd, light_share
from codesign.events.kernels import Lanes
from codesign.events.sensor.crossing import MOST_EVENTS, EventKeys, loaded, run

# up to here single-precision seconds resolve a microsecond, and v2e's rounding is repeated; later
# slots are computed in double
EXACT_SINGLE_S = 8.0
NEAR = 1 << 17  # pixels whose levels in double precision stay near the processor
CHUNK = 1 << 22  # pixels of all frames of a chunk
WAITING = 1 << 19  # the same with a dead time, which takes several runs
LEAST_FRAMES, MOST_FRAMES = 4, 64  # of a chunk: with a dead time each run settles one or more


def levels(frames, front_end):
    """Log levels as v2e has them: lin-log is computed in double precision, rounded to 8 decimals
    and kept in single."""
    if front_end.log_input:
        return frames
    found = torch.empty_like(frames, dtype=torch.float32)
    size = max(1, NEAR // frames[0].numel())
    for place, part in zip(found.split(size), frames.split(size), strict=True):
        linear = part.double()
        level = linear.clamp(min=JOINT).log_()  # below the line from the joint on
        torch.minimum(level, linear * DARK_SLOPE, out=level)
        place.copy_(level.mul_(1e8).round_().div_(1e8))
    return found


def signals(frames, front_end, times_s, sensor, generator, state):
    """What comparators get, frame by frame; moves all of the state on but what events change.

    Args: frames: [T, H, W]. times_s: list, their times.
    Returns: level seen, leak of the memorised level, noise events (1: ON, 2: OFF, 3: both), [T, H,
      W] each, or None.
    """
    found = []
    own = levels(frames, front_end)
    for frame, level, time_s in zip(frames, own, times_s, strict=True):
        dt_s, state.time_s = time_s - state.time_s, time_s
        light = leak = shots = None
        if sensor.cutoff_hz > 0 or sensor.has_shots:
            light = light_share((frame.exp() if front_end.log_input else frame).double())
        seen = _photoreceptor(level, light, dt_s, sensor, generator, state)
        if sensor.leaks:
            rate_hz = state.leak_hz
            if sensor.leak_jitter > 0:
                rate_hz = rate_hz * (
                    1 - sensor.leak_jitter * _drawn(torch.randn, rate_hz, generator)
                )
            leak = dt_s * rate_hz * state.theta_on.to(rate_hz)
        if sensor.has_shots:
            chance = sensor.shot_rate_hz / 2 * dt_s * (1 - 0.75 * light)
            draw = _drawn(torch.rand, light, generator)
            on = draw > 1 - chance * (sensor.theta_on / state.theta_on)
            off = draw < chance * (sensor.theta_off / state.theta_off)
            shots = on + 2.0 * off
        found.append((seen, leak, shots))
    state.level = state.level.clone()  # not a view of all
    seen, leak, shots = zip(*found, strict=True)
    seen = torch.stack(seen) if sensor.cutoff_hz > 0 else own
    return seen, *(None if row[0] is None else torch.stack(row) for row in (leak, shots))


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
    draw = _drawn(torch.randn, state.noise, generator)
    state.noise = (1 - share) * state.noise + share * strength * draw
    return state.level + state.noise


def _drawn(draw, like, generator):
    place = {"dtype": like.dtype, "device": generator.device}
    return draw(like.shape, generator=generator, **place).to(like.device)


def _slots(before_s, now_s, dt_s, count):
    """[count] times of the frame's slots since the first frame, seconds.

    In single precision they are torch.linspace as v2e's processor made it, from the nearer end and
    rounded once (a fused multiply-add); without AVX2 torch rounds twice, and a dead time that ends
    at a slot ends later.
    """
    if now_s >= EXACT_SINGLE_S:
        return torch.linspace(before_s + dt_s / count, now_s, count, dtype=torch.float64).numpy()
    first, last = np.float32(before_s + dt_s / count), np.float32(now_s)
    step = float((last - first) / np.float32(max(count - 1, 1)))
    nth = np.arange(count)
    rising, falling = float(first) + step * nth, float(last) - step * (count - 1 - nth)
    return np.where(nth < max(count // 2, 1), rising, falling).astype(np.float32)


class Comparators:
    """Events of the frames of a chunk, as drjit operations, and the slots of the frames."""

    @staticmethod
    def frames_per_kernel(pixels, sensor):
        """How many frames of so many pixels are a chunk."""
        chunk = WAITING if sensor.refractory_s > 0 else CHUNK
        return min(MOST_FRAMES, max(LEAST_FRAMES, chunk // pixels))

    def __init__(self, frames, front_end, times_s, sensor, generator, state):
        """Moves all of the state on but what events change. Args: as for ``signals``."""
        # levels do not tell intensities below 0
        check_frames(frames, 1, non_negative=not front_end.log_input)
        self.ends_s = np.array([state.time_s, *times_s])
        seen, leak, shots = signals(frames, front_end, times_s, sensor, generator, state)
        if leak is not None:  # the first one in the precision in which a recording begins
            state.reference = state.reference - leak[0]
            leak[0] = 0
        kind = torch.promote_types(state.reference.dtype, seen.dtype)
        self.seen, self.sensor, self.state = seen.to(kind), sensor, state
        self.lanes = lanes = Lanes(self.seen, seen[0].numel())
        thetas = state.theta_on, state.theta_off
        if sensor.theta_sigma == 0:
            thetas = [theta.flatten()[:1] for theta in thetas]
        self.thetas = [loaded(lanes, theta.to(kind)) for theta in thetas]
        self.single_thetas = [loaded(lanes, theta.float()) for theta in thetas]
        self.leak, self.shots = (
            None if rows is None else loaded(lanes, rows) for rows in (leak, shots)
        )
        self.carried = {"reference": state.reference.to(kind), "last_event_s": None}
        if state.last_event_s is not None:
            self.carried["last_event_s"] = state.last_event_s.double()
        self.keys, counts, found = None, None, [1] * len(seen)
        while counts != found:
            counts = found
            self._set_slots(counts)
            self.fired = lanes.fresh(len(seen), lanes.arr.UInt32)
            self._run([self.fired])
            fired = self.fired.torch().view(torch.int32).reshape(len(seen), -1)
            found = fired.amax(1).clamp(min=1).tolist()
            if sensor.refractory_s == 0:
                break
        self._set_slots(found)

    def _set_slots(self, counts):
        """So many slots of each frame: places of the first ones, times, dead times, below 0 where
        shorter than a slot; whether the last event's time is then kept in single precision."""
        lanes, state, refractory_s = self.lanes, self.state, self.sensor.refractory_s
        Double = lanes.dr.float64_array_t(lanes.arr.Float)
        now_s, dt_s = self.ends_s - state.start_s, np.diff(self.ends_s)
        frames = zip(now_s[:-1], now_s[1:], dt_s, counts, strict=True)
        times_s = np.concatenate([_slots(*frame) for frame in frames]).astype(np.float64)
        start_us = round(state.start_s * 1e6)
        since_s = times_s + (state.start_s - start_us / 1e6)
        self.counts, self.times_us = counts, start_us + np.rint(since_s * 1e6).astype(np.int64)
        dead, early = refractory_s > dt_s / counts, now_s[1:] < EXACT_SINGLE_S
        wait_s = np.where(early, float(np.float32(refractory_s)), refractory_s)
        before = getattr(state.last_event_s, "dtype", None) == torch.float32
        last_dead = np.maximum.accumulate(np.where(dead, np.arange(1, len(dead) + 1), 0))
        self.single = lanes.arr.UInt32(np.array([before, *early])[last_dead])
        self.wait_s = Double(np.where(dead, wait_s, -math.inf))
        self.times_s, self.first = Double(times_s), lanes.arr.UInt32(np.cumsum([0, *counts]))

    def fire(self, state, layout, *room):
        """Keys of all events, whose intervals end with the last slots of the frames; moves what
        events change of a state on."""
        since_us = self.times_us - layout.origin_us
        ends_us = np.maximum.accumulate(since_us)[np.cumsum(self.counts) - 1]
        starts_us = np.append(since_us[0] - 1, ends_us[:-1])
        since_us = since_us - starts_us.repeat(self.counts)
        self.since_us = self.lanes.dr.int64_array_t(self.lanes.arr.Float)(since_us)
        layout = replace(layout, origin_us=0)
        self.keys = EventKeys(self.lanes, starts_us / 1e6, ends_us / 1e6, layout, *room)
        state.__dict__.update(self._run(self.keys.arrays()))
        return self.keys

    def _run(self, written):
        # levels may be below 0
        after = run(self.lanes, self.seen, FrontEnd(True), self._step, self.carried, written)
        if "last_event_s" in after and bool(self.single[len(self.counts) - 1]):
            after["last_event_s"] = after["last_event_s"].float()
        return after

    def _step(self, index, seen, now):
        dr, lanes = self.lanes.dr, self.lanes
        Kind, Single = lanes.arr.Float, dr.float32_array_t(lanes.arr.Float)
        base = now["reference"]
        if self.leak is not None:
            base = base - Kind(lanes.at(self.leak, index))
        rising = seen > base
        theta, beyond = dr.select(rising, *self.thetas), dr.abs(seen - base)
        too_many = ~(beyond <= MOST_EVENTS * theta)
        beyond = dr.select(too_many, 0, beyond)
        fires = dr.floor(beyond / theta)  # a rounded quotient may be a whole number too large
        fires = fires - dr.select(dr.fma(-fires, theta, beyond) < 0, Kind(1), 0)
        fires = lanes.arr.UInt32(fires)
        shots = []
        if self.shots is not None:
            shot = lanes.at(self.shots, index)
            shots = [(shot == 1) | (shot == 3), shot >= 2]
        if self.keys is None:
            lanes.put(self.fired, fires, index)
        if self.keys is not None or "last_event_s" in now:
            fires = self._fire(index, fires, rising, shots, now)
        moved = Single(fires) * dr.select(rising, *self.single_thetas)
        base = base + Kind(dr.select(rising, moved, -moved))
        # a noise event sets the memorised level to the level seen
        now["reference"] = dr.select(shots[0] | shots[1], seen, base) if shots else base
        return now, too_many

    def _fire(self, index, fires, rising, shots, now):
        """Events of a frame, then noise events, in its last slot. Those within the dead time behind
        the last one kept are not counted, so the next frames see them again. Moves the dead time
        on. Returns how many are counted."""
        dr, arr = self.lanes.dr, self.lanes.arr
        Double = type(self.times_s)
        first, end = (dr.gather(arr.UInt32, self.first, index + k) for k in (0, 1))
        wait_s = dr.gather(Double, self.wait_s, index)
        single = dr.gather(arr.UInt32, self.single, index) != 0
        waits = "last_event_s" in now
        many = fires
        for shot in shots:
            many = many + dr.select(shot, arr.UInt32(1), 0)

        def kept(time_s):
            return dr.select(single, Double(dr.float32_array_t(arr.Float)(time_s)), time_s)

        def event(nth, counted, last_s):
            own = ready = nth < fires
            # a run with too few slots tells that they are too few, not when
            place = dr.select(own, dr.minimum(first + nth, end - 1), end - 1)
            on = dr.select(own, rising, shots[0] & (nth == fires)) if shots else rising
            if waits:
                time_s = dr.gather(Double, self.times_s, place)
                ready = own & (kept(time_s - last_s) > wait_s)
                last_s = dr.select(ready, kept(time_s), last_s)
            if self.keys is not None:
                since_us = dr.gather(type(self.since_us), self.since_us, place)
                self.keys.put(index, since_us, on, ready | ~own)
            return nth + 1, counted + dr.select(ready, arr.UInt32(1), 0), last_s

        none = dr.zeros(arr.UInt32, self.lanes.width)
        last_s = kept(now["last_event_s"]) if waits else arr.Float(0)
        _, counted, last_s = dr.while_loop(
            (none, none, last_s), lambda nth, *_: nth < many, event, mode="symbolic"
        )
        if waits:
            now["last_event_s"] = last_s
        return counted
