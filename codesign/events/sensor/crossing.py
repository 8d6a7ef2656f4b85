"""The interpolated sensor as one drjit loop over time per pixel: low-pass, noise, leak, threshold crossings,
noise events, dead time.

Between frames the signal s (the low-passed log level plus noise) and the leak are linear in time, so D = s -
M, with M the memorised level, crosses a threshold at a time known in closed form, and all crossings of an
interval lie on one side. Noise events are a Poisson process in continuous time: a pixel carries the hazard
that must still pass until its next one, so nothing depends on the frame rate or on chunks, and nothing is
drawn in vain.
"""

import math

import torch

from codesign import backend
from codesign.events.intensity import light_share
from codesign.events.low_pass import coefficients, passed
from codesign.events.sensor.random_bits import exponential, hashed, normal_pair, uniform

# of a pixel in one interval: beyond it a unit is wrong, and single precision would soon stop counting
MOST_EVENTS = 1e6
CARRIED = (
    "reference",
    "reference_rest",
    "level",
    "input_level",
    "input",
    "noise",
    "last_event_s",
    "hazard",
    "shots",
)  # what changes from frame to frame


def run(frames, front_end, dt_s, interval_key, sensor, state, sink):
    """Run the sensor over a chunk.

    Args: frames: [T, ...] float32 or float64, not yet checked. front_end: FrontEnd. dt_s: [T] length of the
      interval that ends with each frame.
      interval_key: [T] int32, random. sensor: SensorModel. state: SensorState (read only).
      sink: ``EventKeys`` or ``DenseCounts``; takes every event.
    Returns: dict of the carried tensors after the chunk; what was wrong: 0 nothing, 1 a value that is not
      finite or negative, 2 a pixel with more than ``MOST_EVENTS`` events in an interval (then everything else
      is void).
    """
    import drjit as dr

    arr = backend.arrays(frames.device.type, frames.dtype)
    count = frames[0].numel()
    lane = dr.arange(arr.UInt32, count)
    pixels = dr.opaque(arr.UInt32, count)
    names = [name for name in CARRIED if getattr(state, name) is not None]
    carried = [_load(arr, getattr(state, name)) for name in names]
    step = _Step(dr, arr, front_end, dt_s, interval_key, sensor, state, sink, lane)
    values = _load(arr, frames)
    end = dr.opaque(arr.UInt32, len(frames))
    dr.eval(values, carried, step.held)

    def body(index, bad, busy, *carried):
        value = dr.gather(arr.Float, values, index * pixels + lane)
        fits = front_end.accepts(dr, value)
        after, too_many = step(
            index, dr.select(fits, value, 1), dict(zip(names, carried, strict=True))
        )  # an infinite level would fire without end
        return index + 1, bad | ~fits, busy | too_many, *(after[name] for name in names)

    with dr.suspend_grad():
        none = dr.zeros(arr.Bool, count)
        _, bad, busy, *carried = dr.while_loop(
            (dr.zeros(arr.UInt32, count), none, none, *carried),
            lambda index, *_: index < end,
            body,
            mode="symbolic",
        )
        wrong = dr.max(dr.select(bad, arr.UInt32(1), dr.select(busy, arr.UInt32(2), 0)))
        dr.eval(carried, wrong, sink.arrays())
    dr.sync_thread()
    return {
        name: _unload(arr, value, getattr(state, name)) for name, value in zip(names, carried, strict=True)
    }, int(wrong[0])


def _load(arr, tensor):
    if tensor.dtype == torch.int32:
        return arr.UInt32(backend.load(arr.Int32, tensor))
    return backend.load(arr.Float, tensor)


def _unload(arr, value, like):
    return (arr.Int32(value) if like.dtype == torch.int32 else value).torch().reshape(like.shape).clone()


def exact_sum(first, second):
    """The rounded sum of two floats, and what rounding took from it. Source: Knuth, TAOCP 2, 4.2.2,
    theorem B."""
    total = first + second
    part = total - first
    return total, (first - (total - part)) + (second - part)


def reaches(dr, distance, theta, count):
    """Whether ``count`` thresholds fit in a distance >= 0, exactly for the floats as they are: a rounded
    quotient may be a whole number too early."""
    return dr.fma(-count, theta, distance) >= 0


class _Step:
    """One frame of one pixel, as drjit operations. Built once per chunk; every number that changes between
    chunks is opaque or in memory."""

    def __init__(self, dr, arr, front_end, dt_s, interval_key, sensor, state, sink, lane):
        self.dr = dr
        self.arr = arr
        self.front_end = front_end
        self.sensor = sensor
        self.sink = sink
        self.lane = lane

        def opaque(value):
            return dr.opaque(arr.Float, value)

        drawn = (
            _load(arr, theta.expand(state.reference.shape)) for theta in (state.theta_on, state.theta_off)
        )
        self.theta_on, self.theta_off = (
            drawn if sensor.theta_sigma > 0 else (opaque(sensor.theta_on), opaque(sensor.theta_off))
        )
        self.dt_s = _load(arr, dt_s.to(state.reference))
        self.interval_key = _load(arr, interval_key)
        self.leak_hz = None if state.leak_hz is None else _load(arr, state.leak_hz)
        self.key = None if state.key is None else _load(arr, state.key)
        self.omega = opaque(2 * math.pi * sensor.cutoff_hz)
        self.jitter = opaque(sensor.leak_jitter)
        self.refractory_s = opaque(sensor.refractory_s)
        self.noise_level = opaque(sensor.noise_level())
        self.half_rate_hz = opaque(sensor.shot_rate_hz / 2)
        self.nominal = opaque(sensor.theta_on), opaque(sensor.theta_off)
        self.jitters = sensor.leaks and sensor.leak_jitter > 0
        self.held = [
            self.theta_on,
            self.theta_off,
            self.dt_s,
            self.interval_key,
            *(x for x in (self.leak_hz, self.key) if x is not None),
        ]

    def __call__(self, index, value, now):
        dr = self.dr
        sensor = self.sensor
        dt_s = dr.gather(self.arr.Float, self.dt_s, index)
        level, _ = self.front_end.traced(dr, value)
        if "input" in now:
            intensity = dr.exp(value) if self.front_end.log_input else value
            light = light_share(0.5 * (now["input"] + intensity))  # of the middle of the interval
            now["input"], before = intensity, now["level"]
        else:
            light = None
            before = now["level"]
        if sensor.cutoff_hz > 0:
            fade, mean = coefficients(light * self.omega * dt_s, dr.exp, dr.select)
            now["level"] = passed(now["level"], now["input_level"], level, fade, mean)
        else:
            now["level"] = level
        if "input_level" in now:
            now["input_level"] = level
        gauss = (
            normal_pair(dr, self.arr, self.key ^ dr.gather(self.arr.UInt32, self.interval_key, index))
            if self.jitters or sensor.photoreceptor_noise
            else (0.0, 0.0)
        )
        signal = now["level"]
        if sensor.photoreceptor_noise:
            keep = dr.exp(-self.omega * dt_s)
            before = before + now["noise"]
            now["noise"] = keep * now["noise"] + dr.sqrt(1 - keep * keep) * self.noise_level * gauss[0]
            signal = signal + now["noise"]
        base = now["reference"]
        rest = now["reference_rest"]
        start = (before - base) - rest
        if self.leak_hz is not None:  # per frame it may be less than the last digit of the memorised level
            rise = self.leak_hz * dt_s
            leak = (rise * (1 - self.jitter * gauss[1]) if self.jitters else rise) * self.theta_on
            base, now["reference_rest"] = exact_sum(base, rest - leak)
        return now, self._fire(index, dt_s, light, start, signal, base, now)

    def _fire(self, index, dt_s, light, start, signal, base, now):
        """All events of the interval in order of time; moves the reference, the dead time and the hazard on.
        Returns where there were too many.

        Whether the level fires is decided by the rounded reference, as in v2e and ``memory``; when, by the
        reference with what its rounding took, which adds up over the events of a ramp.
        """
        dr = self.dr
        arr = self.arr
        sensor = self.sensor
        dead = "last_event_s" in now
        shots = sensor.has_shots
        last_s = now.get("last_event_s", arr.Float(0))
        pace = dr.zeros(arr.Float, 1)
        if shots:
            share = 1 - 0.75 * dr.minimum(light, 1)
            on_pace, off_pace = (
                share * self.half_rate_hz * dt_s * nominal / theta
                for nominal, theta in zip(self.nominal, (self.theta_on, self.theta_off), strict=True)
            )
            pace = on_pace + off_pace
        end = signal - base
        too_many = (dr.abs(end) > MOST_EVENTS * dr.minimum(self.theta_on, self.theta_off)) | (
            pace > MOST_EVENTS
        )
        end = dr.select(too_many, 0, end)
        pace = dr.select(too_many, 0, pace)
        rest = now["reference_rest"]
        slope = (end - rest) - start
        rising = end > 0
        hazard = now.get("hazard", arr.Float(0))
        drawn = now.get("shots", arr.UInt32(0))

        def going(nth, start, base, end, rising, last_s, tally, hazard, drawn):
            more = reaches(dr, dr.abs(end), dr.select(rising, self.theta_on, self.theta_off), nth + 1)
            return more | (hazard < pace) if shots else more

        def event(nth, start, base, end, rising, last_s, tally, hazard, drawn):
            crossed = (nth + 1) * dr.select(rising, self.theta_on, -self.theta_off)
            when = dr.select(slope == 0, 1, dr.clip((crossed - start) / slope, 0, 1))
            is_shot = arr.Bool(False)
            on = rising
            kept = arr.Bool(True)
            if shots:
                more = reaches(dr, dr.abs(end), dr.select(rising, self.theta_on, self.theta_off), nth + 1)
                is_shot = (hazard < pace) & (~more | (hazard < when * pace))
                when = dr.select(is_shot, hazard / pace, when)
                bits = hashed(dr, self.key + hashed(dr, drawn + 1))
                on = dr.select(is_shot, uniform(arr, bits) * pace < on_pace, rising)
            if dead:
                at_s = when * dt_s
                kept = is_shot | (at_s - last_s >= self.refractory_s)
                last_s = dr.select(kept & ~is_shot, at_s, last_s)
            tally = self.sink.take(dr, arr, index, when, on, kept, tally)
            nth = nth + 1
            if shots:  # a noise event sets the memorised level to the level seen: D is 0 there
                nth = dr.select(is_shot, 0, nth)
                start = dr.select(is_shot, -slope * when, start)
                end = dr.select(is_shot, slope * (1 - when), end)
                base = dr.select(is_shot, signal - end, base)
                rising = dr.select(is_shot, slope > 0, rising)
                hazard = dr.select(
                    is_shot, hazard + exponential(dr, arr, hashed(dr, bits + 0x9E3779B9)), hazard
                )
                drawn = drawn + dr.select(is_shot, arr.UInt32(1), 0)
            return nth, start, base, end, rising, last_s, tally, hazard, drawn

        begun = (
            dr.zeros(arr.Float, dr.width(self.lane)),
            start,
            base,
            end,
            rising,
            last_s,
            self.sink.tally(dr, arr),
            hazard,
            drawn,
        )
        nth, _, base, _, rising, last_s, tally, hazard, drawn = dr.while_loop(
            begun, going, event, mode="symbolic"
        )
        self.sink.close(dr, arr, index, self.lane, tally)
        now["reference"], lost = exact_sum(base, nth * dr.select(rising, self.theta_on, -self.theta_off))
        now["reference_rest"] = lost + (dr.select(drawn == now["shots"], rest, 0) if shots else rest)
        if dead:
            now["last_event_s"] = dr.maximum(last_s - dt_s, -1e6)
        if shots:
            now["hazard"], now["shots"] = hazard - pace, drawn
        return too_many
