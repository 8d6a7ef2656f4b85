"""The interpolated sensor as one drjit loop over time per pixel: low-pass, noise, leak, threshold
crossings, noise events, dead time.

Between frames the signal s (the low-passed log level plus noise) and the leak are linear in time,
so D = s - M, with M the memorised level, crosses a threshold at a time known in closed form, and
all crossings of an interval lie on one side. Noise events are a Poisson process in continuous time:
a pixel carries the hazard that must still pass until its next one, so nothing depends on the frame
rate or on chunks, and nothing is drawn in vain.

A sink is where events go, sortable 64-bit keys or dense counts per frame interval, of a ``Lanes``.
It gives ``tally`` (what it carries through the events of one interval of a pixel), ``take``
(one event), ``close`` (the end of the interval) and ``arrays`` (what to evaluate). Random numbers
are hashes of a key per pixel and a counter, without a state, so that chunks and threads change
nothing.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch

from codesign import backend
from codesign.backend import load
from codesign.errors import DomainError
from codesign.events.entry import check_frames
from codesign.events.intensity import light_share
from codesign.events.kernels import Lanes
from codesign.events.low_pass import coefficients, passed
from codesign.events.sensor.model import draw_keys
from codesign.events.stream import sorted_keys

# of a pixel in one interval: beyond it a unit is wrong, and single precision would soon stop
# counting
MOST_EVENTS = 1e6
UNEVEN = 4  # times the mean of all groups, beyond which room for each as for the fullest is waste
APART = 16  # counts of groups stand apart by a line of the processor's memory
# what changes from frame to frame
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
)


def hashed(bits):
    """32 well-mixed bits of 32 bits; one to one. Source: C. Wellons, "Prospecting for Hash
    Functions" (triple32, bias 0.02 of ideal)."""
    bits = (bits ^ (bits >> 17)) * 0xED5AD4BB
    bits = (bits ^ (bits >> 11)) * 0xAC4C1B51
    bits = (bits ^ (bits >> 15)) * 0x31848BAB
    return bits ^ (bits >> 14)


def uniform(arr, bits):
    """Number in (0, 1) of 32 bits, on a grid of 2^-23 (exact in single precision), never 0 or 1."""
    return (arr.Float(bits >> 9) + 0.5) * 2.0**-23


def exponential(dr, arr, bits):
    """Exponentially distributed number with mean 1, > 0."""
    return -dr.log(uniform(arr, bits))


def normal_pair(dr, arr, bits):
    """Two independent standard normal numbers of 32 bits (Box and Muller, 1958)."""
    radius = dr.sqrt(2 * exponential(dr, arr, hashed(bits)))
    sine, cosine = dr.sincos((2 * math.pi) * uniform(arr, hashed(bits + 0x9E3779B9)))
    return radius * cosine, radius * sine


class EventKeys:
    """Events as integers that sort by (t, y, x, p): microseconds since an origin, row, column,
    polarity, from high to low bits. Groups of intervals have room and an origin of their own, so
    that they sort apart, in 32 bits where those hold an interval, and threads seldom meet."""

    def __init__(self, lanes, start_s, end_s, layout, density, total=None):
        """Args: start_s, end_s: lists, ends of every interval, seconds. layout: KeyLayout. density:
        events per pixel and interval that every group has room for. total: of events, for which one
        group has room instead."""
        dr, arr = lanes.dr, lanes.arr
        start_s, end_s = np.array(start_s), np.array(end_s)
        start_us, end_us = (
            np.array([round(time_s * 1e6) for time_s in times]) for times in (start_s, end_s)
        )
        lasts_us, bits = end_us - start_us, layout.pixel_bits
        # as many intervals, as a power of 2, as have keys of 32 bits from their middle on; all in 64
        # bits where not one has, and where events of two groups might come at one time
        apart = total is None and lasts_us.min() > 0
        fit = int(2 ** (32 - bits) - 1) // int(lasts_us.max()) if apart else 0
        shift = fit.bit_length() - 1 if fit else 31
        origins_us = start_us[:: 1 << shift] + (2 ** (31 - bits) if fit else 0)
        self._origins = ((origins_us - layout.origin_us) << bits).tolist()
        self._pixels = lanes.width * min(1 << shift, len(start_s))
        self._room = total or 4096 + int(density * self._pixels)
        # of single precision a chunk with a long interval would round otherwise than the whole
        self._Time = dr.float64_array_t(arr.Float)
        self._Key = (dr.int32_array_t if fit else dr.int64_array_t)(arr.Float)
        self._lanes = lanes
        self._bits = bits
        # of every interval: its length and the fraction of a microsecond that it starts with; whole
        # ones from its group's origin and to its end
        spans = (end_s - start_s) * 1e6, start_s * 1e6 - start_us
        self._spans = [self._Time(span) for span in spans]
        since_us = start_us - origins_us[np.arange(len(start_us)) >> shift]
        self._whole = [self._Key(since_us << bits), self._Key(lasts_us)]
        self._pixel = self._Key(layout.pixels())
        self._keys = dr.empty(self._Key, len(origins_us) * self._room)
        self._counts = dr.zeros(arr.UInt32, len(origins_us) * APART)
        self._opaque = lanes.opaque(shift), lanes.opaque(self._room)
        dr.eval(self._spans, self._whole, self._pixel, self._keys, self._counts)

    def tally(self):
        return self._lanes.arr.UInt32(0)

    def take(self, index, when, on, kept, tally):
        dr = self._lanes.dr
        length, fraction = (dr.gather(self._Time, table, index) for table in self._spans)
        span = dr.gather(self._Key, self._whole[1], index)
        # after the start, so that rounding moves no event to the interval before; whole numbers are
        # clipped in less time than floats
        since_us = dr.clip(
            self._Key(dr.round(self._Time(when) * length + fraction)), dr.minimum(span, 1), span
        )
        self.put(index, since_us, on, kept)
        return tally

    def put(self, index, since_us, on, kept):
        """An event so many microseconds behind the start of its interval."""
        dr, (shift, room) = self._lanes.dr, self._opaque
        start = dr.gather(self._Key, self._whole[0], index)
        key = (start + (self._Key(since_us) << self._bits)) | self._pixel
        slot = dr.scatter_inc(self._counts, (index >> shift) * APART, active=kept)
        key = key | dr.select(on, self._Key(1), 0)
        place = (index >> shift) * room + slot
        dr.scatter(self._keys, key, place, active=kept & (slot < room))

    def close(self, index, tally):
        pass

    def arrays(self):
        return self._keys, self._counts

    def counted(self):
        """Whether all events had room; how many came per pixel and interval in the fullest group,
        and None. Where that has most of all: in the mean, and the total."""
        self._found = self._counts.numpy()[::APART].tolist()
        fullest, total, groups = max(self._found), sum(self._found), len(self._found)
        uneven = groups * fullest > UNEVEN * total
        density = total / groups if uneven else fullest
        return fullest <= self._room, density / self._pixels, total if uneven else None

    def sorted(self):
        """List of an origin and the [N] keys from it in order, for every group."""
        groups = self._keys.torch().split(self._room)
        return [
            (origin, sorted_keys(keys[:found]))
            for origin, keys, found in zip(self._origins, groups, self._found, strict=True)
        ]


@dataclass(frozen=True)
class KeyLayout:
    """Which bits of a key hold what. origin_us: time of key 0."""

    origin_us: int
    height_px: int
    width_px: int

    @property
    def x_bits(self):
        return max(1, (self.width_px - 1).bit_length())

    @property
    def pixel_bits(self):
        return self.x_bits + max(1, (self.height_px - 1).bit_length()) + 1

    def pixels(self):
        """[H W] low bits of every pixel, OFF."""
        rows = np.arange(self.height_px)[:, None] << (self.x_bits + 1)
        return (rows | (np.arange(self.width_px) << 1)).ravel()

    def columns(self, lanes, parts):
        """t_us, x, y, p of parts of keys, an origin and those from it: int64 [N] each, where the
        frames are."""
        sizes = [len(keys) for _, keys in parts]
        if not any(sizes):
            return torch.zeros((4, 0), dtype=torch.int64, device=lanes.device).unbind()
        dr = lanes.dr
        Int = dr.int64_array_t(lanes.arr.Float)
        keys = dr.empty(Int, sum(sizes))
        dr.eval(keys)
        for place, (origin, part) in zip(keys.torch().split(sizes), parts, strict=True):
            place.copy_(part).add_(origin)

        def low(shift, bits):
            return (keys >> shift) & ((1 << bits) - 1)

        y_bits = self.pixel_bits - self.x_bits - 1
        columns = (
            (keys >> self.pixel_bits) + dr.opaque(Int, self.origin_us),
            low(1, self.x_bits),
            low(self.x_bits + 1, y_bits),
            2 * low(0, 1) - 1,
        )
        dr.eval(columns)
        dr.sync_thread()
        return tuple(column.torch() for column in columns)


class DenseCounts:
    """Counts [T, 2, ...] per interval, ON first."""

    def __init__(self, lanes, intervals):
        self._lanes = lanes
        self._counts = lanes.dr.empty(lanes.arr.Float, 2 * intervals * lanes.width)

    def tally(self):
        return [self._lanes.arr.Float(0)] * 2

    def take(self, index, when, on, kept, tally):
        one, select = self._lanes.arr.Float(1), self._lanes.dr.select
        return [
            total + select(kept & way, one, 0) for total, way in zip(tally, (on, ~on), strict=True)
        ]

    def close(self, index, tally):
        for k, total in enumerate(tally):
            self._lanes.put(self._counts, total, 2 * index + k)

    def arrays(self):
        return (self._counts,)

    def tensor(self, shape):
        """The counts as a tensor; call once, it takes the memory over."""
        return self._counts.torch().reshape(shape)


class Crossings:
    """Events of the frames of a chunk, which threshold crossings time. What ``fire`` needs to run
    once more is drawn here."""

    @staticmethod
    def frames_per_kernel(pixels, sensor):
        """How many frames of so many pixels are a chunk."""
        return backend.frames_per_kernel(pixels)

    def __init__(self, frames, front_end, times_s, sensor, generator, state):
        """Args: frames: [T, ...]. times_s: list, their times. state: before the first of them."""
        self.lanes = Lanes(frames, frames[0].numel())
        self.frames, self.front_end, self.times_s, self.sensor = frames, front_end, times_s, sensor
        numbers = torch.zeros(len(frames), dtype=torch.int32)
        if sensor.photoreceptor_noise or sensor.leak_jitters:
            # one at a time, so that chunks draw what the whole draws
            numbers = torch.stack([draw_keys((), generator) for _ in frames])
        self.numbers = numbers.to(state.level.device)

    def fire(self, state, layout, *room):
        """Keys of all events; moves a state on."""
        sink = EventKeys(
            self.lanes, [state.time_s, *self.times_s[:-1]], self.times_s, layout, *room
        )
        self.advance(state, sink)
        return sink

    def advance(self, state, sink):
        """Run the kernel and move a state on; on bad frames raise before anything has changed."""
        dt_s = torch.tensor([state.time_s, *self.times_s], dtype=torch.float64).diff()
        step = Step(self.lanes, self.front_end, dt_s, self.numbers, self.sensor, state, sink)
        carried = {name: getattr(state, name) for name in CARRIED}
        after = run(self.lanes, self.frames, self.front_end, step, carried, sink.arrays())
        state.__dict__.update(after, time_s=self.times_s[-1])


def run(lanes, frames, front_end, step, carried, written):
    """Run a sensor over a chunk.

    Args:
      lanes: of a frame's pixels.
      frames: [T, ...] float32 or float64, not yet checked.
      front_end: FrontEnd.
      step: (index, value, carried) -> (carried, too many events), of one frame; a ``Step``.
      carried: dict of tensors before the chunk, None for what the sensor has not.
      written: arrays that steps write to.
    Returns: dict of the carried tensors after the chunk.
    Raises: DomainError for a value that is not finite or negative, and a pixel with more than
      ``MOST_EVENTS`` events in an interval.
    """
    dr, arr = lanes.dr, lanes.arr
    before = {name: tensor for name, tensor in carried.items() if tensor is not None}
    carried = [loaded(lanes, tensor) for tensor in before.values()]
    values = lanes.load(frames)

    def body(index, bad, busy, *carried):
        value = lanes.at(values, index)
        fits = front_end.accepts(dr, value)
        # an infinite level would fire without end
        after, too_many = step(
            index, dr.select(fits, value, 1), dict(zip(before, carried, strict=True))
        )
        return bad | ~fits, busy | too_many, *(after[name] for name in before)

    with dr.suspend_grad():
        none = dr.zeros(arr.Bool, lanes.width)
        bad, busy, *carried = lanes.loop(0, lanes.opaque(len(frames)), body, none, none, *carried)
        wrong = dr.select(bad, arr.UInt32(1), dr.select(busy, arr.UInt32(2), 0))
        dr.eval(carried, wrong, written)  # together: a maximum alone runs the loop once more
        wrong = dr.max(wrong)
    dr.sync_thread()
    if int(wrong[0]) == 1:
        check_frames(frames, 1, non_negative=not front_end.log_input)
    if int(wrong[0]):
        raise DomainError(
            f"a pixel would fire more than {MOST_EVENTS:.0f} events between two frames; check the unit of "
            "the frames (log levels are natural logarithms), the thresholds, the noise rates and the times."
        )
    after = {}
    for (name, like), value in zip(before.items(), carried, strict=True):
        after[name] = lanes.tensor(
            arr.Int32(value) if like.dtype == torch.int32 else value, like.shape
        )
    return after


def loaded(lanes, tensor):
    """An array of the type of a tensor, of unsigned numbers where it has whole ones."""
    dr, arr = lanes.dr, lanes.arr
    if tensor.dtype == torch.float64:
        return load(dr.float64_array_t(arr.Float), tensor)
    if tensor.dtype != torch.int32:
        return load(dr.float32_array_t(arr.Float), tensor)
    bits = arr.UInt32(load(arr.Int32, tensor))
    dr.eval(bits)
    return bits


def exact_sum(first, second):
    """The rounded sum of two floats, and what rounding took from it. Source: Knuth, TAOCP 2, 4.2.2,
    theorem B."""
    total = first + second
    part = total - first
    return total, (first - (total - part)) + (second - part)


class Step:
    """One frame of one pixel, as drjit operations. Built once per chunk; every number that changes
    between chunks is opaque or in memory."""

    def __init__(self, lanes, front_end, dt_s, interval_key, sensor, state, sink):
        self.lanes = lanes
        self.dr = lanes.dr
        self.arr = lanes.arr
        self.front_end = front_end
        self.sensor = sensor
        self.sink = sink

        def opaque(value):
            return lanes.dr.opaque(lanes.arr.Float, value)

        self.nominal = opaque(sensor.theta_on), opaque(sensor.theta_off)
        self.thetas = self.nominal
        if sensor.theta_sigma > 0:
            self.thetas = [loaded(lanes, theta) for theta in (state.theta_on, state.theta_off)]
        self.dt_s = loaded(lanes, dt_s.to(state.reference))
        self.interval_key = loaded(lanes, interval_key)
        self.leak_hz = None if state.leak_hz is None else loaded(lanes, state.leak_hz)
        self.key = None if state.key is None else loaded(lanes, state.key)
        self.omega = opaque(2 * math.pi * sensor.cutoff_hz)
        self.jitter = opaque(sensor.leak_jitter)
        self.refractory_s = opaque(sensor.refractory_s)
        self.noise_level = opaque(sensor.noise_level())
        self.half_rate_hz = opaque(sensor.shot_rate_hz / 2)

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
            normal_pair(
                dr, self.arr, self.key ^ dr.gather(self.arr.UInt32, self.interval_key, index)
            )
            if sensor.leak_jitters or sensor.photoreceptor_noise
            else (0.0, 0.0)
        )
        signal = now["level"]
        if sensor.photoreceptor_noise:
            keep = dr.exp(-self.omega * dt_s)
            before = before + now["noise"]
            now["noise"] = (
                keep * now["noise"] + dr.sqrt(1 - keep * keep) * self.noise_level * gauss[0]
            )
            signal = signal + now["noise"]
        base = now["reference"]
        rest = now["reference_rest"]
        start = (before - base) - rest
        # per frame it may be less than the last digit of the memorised level
        if self.leak_hz is not None:
            rise = self.leak_hz * dt_s
            leak = (
                rise * (1 - self.jitter * gauss[1]) if sensor.leak_jitters else rise
            ) * self.thetas[0]
            base, now["reference_rest"] = exact_sum(base, rest - leak)
        return now, self._fire(index, dt_s, light, start, signal, base, now)

    def _fire(self, index, dt_s, light, start, signal, base, now):
        """All events of the interval in order of time; moves the reference, the dead time and the
        hazard on. Returns where there were too many.

        Whether the level fires is decided by the rounded reference, as in v2e and ``memory``; when,
        by the reference with what its rounding took, which adds up over the events of a ramp.
        """
        dr = self.dr
        arr = self.arr
        sensor = self.sensor
        theta_on, theta_off = self.thetas
        dead = "last_event_s" in now
        shots = sensor.has_shots
        last_s = now.get("last_event_s", arr.Float(0))
        pace = dr.zeros(arr.Float, 1)
        if shots:
            share = 1 - 0.75 * dr.minimum(light, 1)
            on_pace, off_pace = (
                share * self.half_rate_hz * dt_s * nominal / theta
                for nominal, theta in zip(self.nominal, self.thetas, strict=True)
            )
            pace = on_pace + off_pace
        end = signal - base
        too_many = (dr.abs(end) > MOST_EVENTS * dr.minimum(*self.thetas)) | (pace > MOST_EVENTS)
        end = dr.select(too_many, 0, end)
        pace = dr.select(too_many, 0, pace)
        rest = now["reference_rest"]
        slope = (end - rest) - start
        rising = end > 0
        hazard = now.get("hazard", arr.Float(0))
        drawn = now.get("shots", arr.UInt32(0))

        def due(nth, end, rising):
            # exactly for the floats as they are: a rounded quotient may be a whole number too early
            return dr.fma(-(nth + 1), dr.select(rising, theta_on, theta_off), dr.abs(end)) >= 0

        def going(nth, start, base, end, rising, last_s, tally, hazard, drawn):
            more = due(nth, end, rising)
            return more | (hazard < pace) if shots else more

        def event(nth, start, base, end, rising, last_s, tally, hazard, drawn):
            crossed = (nth + 1) * dr.select(rising, theta_on, -theta_off)
            when = dr.select(slope == 0, 1, dr.clip((crossed - start) / slope, 0, 1))
            is_shot = arr.Bool(False)
            on = rising
            kept = arr.Bool(True)
            if shots:
                is_shot = (hazard < pace) & (~due(nth, end, rising) | (hazard < when * pace))
                when = dr.select(is_shot, hazard / pace, when)
                bits = hashed(self.key + hashed(drawn + 1))
                on = dr.select(is_shot, uniform(arr, bits) * pace < on_pace, rising)
            if dead:
                at_s = when * dt_s
                kept = is_shot | (at_s - last_s >= self.refractory_s)
                last_s = dr.select(kept & ~is_shot, at_s, last_s)
            tally = self.sink.take(index, when, on, kept, tally)
            nth = nth + 1
            if shots:  # a noise event sets the memorised level to the level seen: D is 0 there
                nth = dr.select(is_shot, 0, nth)
                start = dr.select(is_shot, -slope * when, start)
                end = dr.select(is_shot, slope * (1 - when), end)
                base = dr.select(is_shot, signal - end, base)
                rising = dr.select(is_shot, slope > 0, rising)
                hazard = dr.select(
                    is_shot, hazard + exponential(dr, arr, hashed(bits + 0x9E3779B9)), hazard
                )
                drawn = drawn + dr.select(is_shot, arr.UInt32(1), 0)
            return nth, start, base, end, rising, last_s, tally, hazard, drawn

        begun = (
            dr.zeros(arr.Float, self.lanes.width),
            start,
            base,
            end,
            rising,
            last_s,
            self.sink.tally(),
            hazard,
            drawn,
        )
        nth, _, base, _, rising, last_s, tally, hazard, drawn = dr.while_loop(
            begun, going, event, mode="symbolic"
        )
        self.sink.close(index, tally)
        now["reference"], lost = exact_sum(base, nth * dr.select(rising, theta_on, -theta_off))
        now["reference_rest"] = lost + (
            dr.select(drawn == now["shots"], rest, 0) if shots else rest
        )
        if dead:
            now["last_event_s"] = dr.maximum(last_s - dt_s, -1e6)
        if shots:
            now["hazard"], now["shots"] = hazard - pace, drawn
        return too_many
