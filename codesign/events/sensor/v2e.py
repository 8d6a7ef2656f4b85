"""The sensor as v2e times it: every pixel's i-th event of a frame gets the i-th of the frame's
equal time slots.

Kept beside the interpolated sensor so that results with v2e can be repeated event by event;
precisions and the order of operations are v2e's. A frame has as many slots as its busiest pixel has
events, which a run of the kernel without events finds; with a dead time, which ends at a slot, runs
go on until they find the slots that they began with.
Source: Hu, Liu, Delbruck, "v2e: From Video Frames to Realistic DVS Events", CVPR-W 2021, and the
  published program.
"""

import math

import torch

from codesign.errors import DomainError
from codesign.events.intensity import DARK_SLOPE, JOINT, light_share
from codesign.events.sensor.crossing import MOST_EVENTS, EventKeys, loaded, over_frames

# up to here single-precision seconds resolve a microsecond, and v2e's rounding is repeated; later
# slots are computed in double
EXACT_SINGLE_S = 8.0
MOST_PIXELS = 1 << 22  # of the frames of a chunk
MOST_TRIALS = 64  # frames of a chunk with a dead time: none takes more runs than it has frames
CARRIED = ("reference", "level", "noise", "last_event_s")


def levels(frames, front_end):
    """Log levels as v2e has them: lin-log is computed in double precision, rounded to 8 decimals
    and kept in single."""
    if front_end.log_input:
        return frames
    return ((front_end.level(frames.double()) * 1e8).round() / 1e8).float()


def chunk_size(frames, front_end, sensor, state):
    """How many of the frames a kernel may run over."""
    if state.reference.dtype != _kind(frames, front_end, sensor, state):
        return 1  # the first leak is subtracted in single precision
    most = MOST_TRIALS if sensor.refractory_s > 0 else len(frames)
    return min(most, max(1, MOST_PIXELS // frames[0].numel()))


def _kind(frames, front_end, sensor, state):
    """Type of the memorised level once a frame has been seen."""
    level = frames.dtype if front_end.log_input else torch.float32
    fine = sensor.cutoff_hz > 0 or torch.float64 in (level, state.reference.dtype)
    return torch.float64 if fine else torch.float32


class Slots:
    """Times of the slots of frames, so many each.

    first: [T+1] place of each frame's first slot in the lists. times: [N] seconds since the first
      frame, double. since_us, start_us, end_us: [N] microseconds since [T] starts of frames; their
      ends. wait_s: [T] dead time, below 0 where it is shorter than a slot. narrow: [T] whether the
      time of the last event is kept in single precision, and last_type after all.
    """

    def __init__(self, counts, times_s, sensor, state):
        ends_s = torch.tensor([state.time_s, *times_s], dtype=torch.float64)
        counts = torch.tensor(counts)
        now_s, before_s = ends_s[1:] - state.start_s, ends_s[:-1] - state.start_s
        slot_s = ends_s.diff() / counts
        self.counts = counts.tolist()
        self.first = torch.cat((counts[:1] * 0, counts.cumsum(0)))
        self.times = _slot_times(before_s + slot_s, now_s, counts, self.first)
        start_us = round(state.start_s * 1e6)
        since_s = self.times + (state.start_s - start_us / 1e6)
        times_us = start_us + (since_s * 1e6).round().long()
        self.end_us = times_us.cummax(0).values[self.first[1:] - 1]
        self.start_us = torch.cat((times_us[:1] - 1, self.end_us[:-1]))
        self.since_us = times_us - self.start_us.repeat_interleave(counts)
        dead = sensor.refractory_s > slot_s
        single = now_s < EXACT_SINGLE_S
        wait_s = torch.full_like(now_s, sensor.refractory_s)
        self.wait_s = wait_s.float().double().where(single, wait_s).where(dead, -math.inf)
        self.narrow, self.last_type = [], None
        if state.last_event_s is not None:
            narrow = state.last_event_s.dtype == torch.float32
            for waits, exact in zip(dead.tolist(), single.tolist(), strict=True):
                narrow = exact if waits else narrow
                self.narrow.append(narrow)
            self.last_type = torch.float32 if narrow else torch.float64


def _slot_times(first_s, last_s, counts, places):
    """Times of the slots of all frames, the first and the last of each given.

    In single precision they are torch.linspace as v2e's processor made it, from the nearer end and
    rounded once (a fused multiply-add); without AVX2 torch rounds twice, and a dead time that ends
    at a slot ends later.
    """
    first, last = first_s.float(), last_s.float()
    step = (last - first) / (counts - 1).clamp(min=1)
    first, last, step, count = (
        values.repeat_interleave(counts)
        for values in (first.double(), last.double(), step.double(), counts)
    )
    nth = torch.arange(len(count)) - places[:-1].repeat_interleave(counts)
    rising, falling = first + step * nth, last - step * (count - 1 - nth)
    times = torch.where(nth < (count // 2).clamp(min=1), rising, falling).float().double()
    for k in (last_s >= EXACT_SINGLE_S).nonzero().flatten().tolist():
        place = {"steps": int(counts[k]), "dtype": torch.float64}
        times[places[k] : places[k + 1]] = torch.linspace(
            float(first_s[k]), float(last_s[k]), **place
        )
    return times


class SlotKeys(EventKeys):
    """Events at places in the lists of slots."""

    def __init__(self, lanes, slots, layout, *room):
        super().__init__(lanes, slots.start_us.numpy(), slots.end_us.numpy(), layout, *room)
        self._since = self._Key(slots.since_us.numpy())
        lanes.dr.eval(self._since)

    def _since_us(self, index, place):
        return self._lanes.dr.gather(self._Key, self._since, place)


class Peaks:
    """A sink that keeps how often every pixel fires in every frame, dead times apart."""

    def __init__(self, lanes, frames):
        self._lanes = lanes
        self._fired = lanes.fresh(frames, lanes.arr.UInt32)

    def take(self, index, place, on, kept, tally):
        pass

    def close(self, index, fired):
        self._lanes.put(self._fired, fired, index)

    def arrays(self):
        return (self._fired,)

    def counts(self):
        """Events of the busiest pixel of each frame, at least 1."""
        fired = self._fired.torch().view(torch.int32).reshape(-1, self._lanes.width)
        return fired.amax(1).clamp(min=1).tolist()


class Chunk:
    """Frames for a kernel, with all that is drawn for them."""

    def __init__(self, lanes, frames, times_s, front_end, sensor, generator, state):
        self.lanes, self.frames, self.front_end = lanes, frames, front_end
        self.times_s, self.sensor, self.state = times_s, sensor, state
        kind = _kind(frames, front_end, sensor, state)
        # the first leak is subtracted in single precision
        self.narrow = state.reference.dtype != kind
        self.carried = {name: getattr(state, name) for name in CARRIED}
        self.carried["reference"] = state.reference.to(kind)
        level = kind if sensor.cutoff_hz > 0 else levels(frames[:0], front_end).dtype
        self.carried["level"] = state.level.to(level)
        if state.last_event_s is not None:
            self.carried["last_event_s"] = state.last_event_s.double()
        self.dt_s = torch.tensor([state.time_s, *times_s], dtype=torch.float64).diff()
        self.noise = self._noise_filter() if sensor.photoreceptor_noise else None
        self.drawn = self._draw(generator)
        # torch's exponential and logarithm: drjit's round otherwise
        self.light = self.logarithm = None
        if sensor.cutoff_hz > 0 or sensor.has_shots:
            intensity = frames.exp() if front_end.log_input else frames
            self.light = light_share(intensity.double())
        if not front_end.log_input:
            self.logarithm = frames.double().clamp(min=JOINT).log_()
        thetas = state.theta_on, state.theta_off
        if sensor.theta_sigma == 0:
            thetas = [theta.flatten()[:1] for theta in thetas]
        self.thetas = [theta.to(kind) for theta in thetas]
        self.single_thetas = [theta.float() for theta in thetas]
        nominal = sensor.theta_on, sensor.theta_off
        self.shares = [(one / theta).double() for one, theta in zip(nominal, thetas, strict=True)]

    def _noise_filter(self):
        """What a frame leaves of the photoreceptor noise, and how much it adds."""
        omega = 2 * math.pi * self.sensor.cutoff_hz
        share = self.dt_s * omega
        if bool((share >= 2).any()):
            dt_s = float(self.dt_s[share >= 2][0])
            raise DomainError(
                f"frames {dt_s:g} s apart make v2e's noise filter of {self.sensor.cutoff_hz:g} Hz unstable; use "
                f"frames closer than {2 / omega:.3g} s, or timing 'interpolated'."
            )
        # the filter lets this part of white noise through
        strength = self.sensor.noise_level() / (share / (2 - share)).sqrt()
        return [table.to(self.state.noise.dtype) for table in (1 - share, share * strength)]

    def _draw(self, generator):
        """Random numbers of every pixel, frame by frame: of the photoreceptor, the leak, and noise
        events."""
        sensor = self.sensor
        kinds = {}
        if sensor.photoreceptor_noise:
            kinds["noise"] = torch.randn, self.state.noise.dtype
        if sensor.leak_jitters:
            kinds["leak"] = torch.randn, torch.float32
        if sensor.has_shots:
            kinds["shots"] = torch.rand, torch.float64
        place = {"device": generator.device}
        drawn = {
            name: torch.empty(self.frames.shape, dtype=dtype, **place)
            for name, (_, dtype) in kinds.items()
        }
        for k in range(len(self.frames)):
            for name, (draw, _) in kinds.items():
                draw(self.frames.shape[1:], generator=generator, out=drawn[name][k])
        return {name: numbers.to(self.frames.device) for name, numbers in drawn.items()}

    def slots(self):
        """Slots of the frames, and what is wrong (as in ``crossing.run``)."""
        counts, found = [], [1] * len(self.frames)
        waits = self.sensor.refractory_s > 0
        while counts != found:
            counts = found
            sink = Peaks(self.lanes, len(self.frames))
            _, wrong = self.run(Slots(counts, self.times_s, self.sensor, self.state), sink)
            found = counts if wrong else sink.counts()
            if not waits:
                break
        return Slots(found, self.times_s, self.sensor, self.state), wrong

    def run(self, slots, sink):
        """The carried tensors after the frames, and what is wrong; the sink takes every event. The
        state stays as it is."""
        step = _Step(self, slots, sink)
        after, wrong = over_frames(
            self.lanes, self.frames, self.front_end, step, self.carried, sink
        )
        if "last_event_s" in after:
            after["last_event_s"] = after["last_event_s"].to(slots.last_type)
        return after, wrong


class _Step:
    """One frame of one pixel, as drjit operations."""

    def __init__(self, chunk, slots, sink):
        lanes, sensor = chunk.lanes, chunk.sensor
        self.lanes, self.sensor, self.sink = lanes, sensor, sink
        self.narrow = chunk.narrow

        def load(tensor):
            return loaded(lanes, tensor.to(lanes.device))

        def opaque(value, dtype=torch.float64):
            return load(torch.tensor([value], dtype=dtype))

        self.logarithm, self.light, self.leak_hz = (
            None if tensor is None else load(tensor)
            for tensor in (chunk.logarithm, chunk.light, chunk.state.leak_hz)
        )
        self.drawn = {name: load(numbers) for name, numbers in chunk.drawn.items()}
        self.thetas, self.single_thetas, self.shares = (
            [load(theta) for theta in thetas]
            for thetas in (chunk.thetas, chunk.single_thetas, chunk.shares)
        )
        self.noise = chunk.noise and [load(table) for table in chunk.noise]
        self.dt_s = load(chunk.dt_s.float())
        self.pace = load(chunk.dt_s * (2 * math.pi * sensor.cutoff_hz))
        self.chance = load(sensor.shot_rate_hz / 2 * chunk.dt_s)
        self.jitter = opaque(sensor.leak_jitter, torch.float32)
        self.decimals = opaque(1e8)  # drjit multiplies by the inverse of what is known
        self.first = load(slots.first.int())
        self.times = load(slots.times)
        self.wait_s = load(slots.wait_s)
        self.kept_single = load(torch.tensor(slots.narrow, dtype=torch.int32))

    def __call__(self, index, value, now):
        dr, lanes, sensor = self.lanes.dr, self.lanes, self.sensor
        Single, Double = (
            kind(lanes.arr.Float) for kind in (dr.float32_array_t, dr.float64_array_t)
        )
        Kind = type(now["reference"])

        def of_frame(table):
            return dr.gather(type(table), table, index)

        level = value
        if self.logarithm is not None:
            fine = dr.select(
                value <= JOINT, Double(value) * DARK_SLOPE, lanes.at(self.logarithm, index)
            )
            level = Single(dr.round(fine * 1e8) / self.decimals)
        light = None if self.light is None else lanes.at(self.light, index)
        if sensor.cutoff_hz > 0:
            share = dr.minimum(light * of_frame(self.pace), 1)
            level = (1 - share) * now["level"] + share * Double(level)
        now["level"] = level
        seen = Kind(level)
        if sensor.photoreceptor_noise:
            keep, add = map(of_frame, self.noise)
            now["noise"] = keep * now["noise"] + add * lanes.at(self.drawn["noise"], index)
            seen = seen + Kind(now["noise"])
        base = now["reference"]
        if self.leak_hz is not None:
            rate_hz = self.leak_hz
            if sensor.leak_jitters:
                rate_hz = rate_hz * (1 - self.jitter * lanes.at(self.drawn["leak"], index))
            leak = of_frame(self.dt_s) * rate_hz * self.single_thetas[0]
            base = Kind(Single(base) - leak) if self.narrow else base - Kind(leak)
        rising = seen > base
        theta = dr.select(rising, *self.thetas)
        beyond = dr.abs(seen - base)
        too_many = ~(beyond <= MOST_EVENTS * theta)
        beyond = dr.select(too_many, 0, beyond)
        fired = dr.floor(beyond / theta)  # a rounded quotient may be a whole number too large
        fired = fired - dr.select(dr.fma(-fired, theta, beyond) < 0, Kind(1), 0)
        fired = lanes.arr.UInt32(fired)
        shots = self._shots(index, light) if sensor.has_shots else ()
        kept = self._fire(index, fired, rising, shots, now)
        moved = Single(kept) * dr.select(rising, *self.single_thetas)
        now["reference"] = base + Kind(dr.select(rising, moved, -moved))
        if shots:  # they set the memorised level to the level seen
            now["reference"] = dr.select(shots[0] | shots[1], Kind(level), now["reference"])
        self.sink.close(index, fired)
        return now, too_many

    def _shots(self, index, light):
        """Where noise events of either polarity are, at most one of each per pixel and frame."""
        dr = self.lanes.dr
        draw = self.lanes.at(self.drawn["shots"], index)
        chance = dr.gather(type(self.chance), self.chance, index) * (1 - 0.75 * light)
        on, off = (chance * share for share in self.shares)
        return draw > 1 - on, draw < off

    def _fire(self, index, fired, rising, shots, now):
        """Events of a frame, then noise events, in its last slot. Kept are events later than the
        dead time behind the last one kept; the others are not counted, so the next frames see them
        again. Moves the dead time on. Returns how many are kept."""
        dr, arr = self.lanes.dr, self.lanes.arr
        waits = "last_event_s" in now
        many = fired
        if isinstance(self.sink, Peaks):
            if not waits:
                return fired
        else:
            for shot in shots:
                many = many + dr.select(shot, arr.UInt32(1), 0)
        first, end = (dr.gather(arr.UInt32, self.first, index + k) for k in (0, 1))
        if waits:
            single = dr.gather(arr.UInt32, self.kept_single, index) != 0
            wait_s = dr.gather(type(self.wait_s), self.wait_s, index)

        def rounded(time_s):
            return dr.select(single, type(time_s)(dr.float32_array_t(arr.Float)(time_s)), time_s)

        def event(nth, kept, last_s):
            own = nth < fired
            place, on = first + nth, rising
            if shots:
                place = dr.select(own, place, end - 1)
                on = dr.select(own, rising, shots[0] & (nth == fired))
            ready = own
            if waits:
                time_s = dr.gather(type(self.times), self.times, place)
                ready = own & (rounded(time_s - last_s) > wait_s)
                last_s = dr.select(ready, rounded(time_s), last_s)
            self.sink.take(index, place, on, ready | ~own, None)
            return nth + 1, kept + dr.select(ready, arr.UInt32(1), 0), last_s

        none = dr.zeros(arr.UInt32, self.lanes.width)
        last_s = rounded(now["last_event_s"]) if waits else arr.Float(0)
        _, kept, last_s = dr.while_loop(
            (none, none, last_s), lambda nth, *_: nth < many, event, mode="symbolic"
        )
        if waits:
            now["last_event_s"] = last_s
        return kept
