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

import torch

from codesign.errors import DomainError
from codesign.events.intensity import DARK_SLOPE, JOINT, FrontEnd, light_share
from codesign.events.kernels import Lanes
from codesign.events.sensor.crossing import MOST_EVENTS, EventKeys, loaded, run

# up to here single-precision seconds resolve a microsecond, and v2e's rounding is repeated; later
# slots are computed in double
EXACT_SINGLE_S = 8.0
CHUNK = 1 << 22  # pixels of all frames of a chunk
NEAR = 1 << 17  # whose levels in double precision stay near the processor
MOST_RUNS = 64  # of a chunk with a dead time: each settles a frame or more
CARRIED = ("reference", "level", "noise", "last_event_s")


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


def chunk_size(frames, front_end, sensor, state):
    """How many of the frames are a chunk."""
    if state.reference.dtype != _kind(frames, front_end, sensor, state):
        return 1
    most = MOST_RUNS if sensor.refractory_s > 0 else len(frames)
    return min(most, max(1, CHUNK // frames[0].numel()))


def _kind(frames, front_end, sensor, state):
    """Type of the memorised level once a frame has been seen."""
    single = not front_end.log_input or frames.dtype == torch.float32
    single = single and sensor.cutoff_hz == 0 and state.reference.dtype == torch.float32
    return torch.float32 if single else torch.float64


class Slots:
    """Times of the slots of frames, of each so many.

    first: [T+1] place of each frame's first slot in the lists. times_s: [N] since the first frame.
    times_us: [N]. wait_s: [T] dead time, below 0 where it is shorter than a slot. single: [T]
    whether the time of the last event is kept in single precision.
    """

    def __init__(self, counts, ends_s, sensor, state):
        counts = torch.tensor(counts)
        slot_s = ends_s.diff() / counts
        now_s = ends_s[1:] - state.start_s
        first_s = ends_s[:-1] - state.start_s + slot_s
        self.first = torch.cat((counts[:1] * 0, counts.cumsum(0)))
        early = now_s < EXACT_SINGLE_S
        self.times_s = _spread(first_s, now_s, counts, self.first)
        for k in (~early).nonzero().flatten().tolist():
            at = float(first_s[k]), float(now_s[k]), int(counts[k])
            exact = torch.linspace(*at, dtype=torch.float64)
            self.times_s[self.first[k] : self.first[k + 1]] = exact
        start_us = round(state.start_s * 1e6)
        since_s = self.times_s + (state.start_s - start_us / 1e6)
        self.times_us = start_us + (since_s * 1e6).round().long()
        dead = sensor.refractory_s > slot_s
        self.wait_s = torch.full_like(now_s, sensor.refractory_s)
        self.wait_s = self.wait_s.float().double().where(early, self.wait_s)
        self.wait_s = self.wait_s.where(dead, -math.inf)
        self.single = early
        if state.last_event_s is not None and state.last_event_s.dtype == torch.float32:
            self.single = early | ((dead & ~early).cumsum(0) == 0)


def _spread(first_s, last_s, counts, places):
    """Times from the first to the last of every frame.

    They are torch.linspace in single precision as v2e's processor made it, from the nearer end and
    rounded once (a fused multiply-add); without AVX2 torch rounds twice, and a dead time that ends
    at a slot ends later.
    """
    first, last = first_s.float(), last_s.float()
    step = (last - first) / (counts - 1).clamp(min=1)
    ends = (first.double(), last.double(), step.double(), counts, places[:-1])
    first, last, step, count, place = (values.repeat_interleave(counts) for values in ends)
    nth = torch.arange(len(place)) - place
    rising, falling = first + step * nth, last - step * (count - 1 - nth)
    return torch.where(nth < (count // 2).clamp(min=1), rising, falling).float().double()


class Chunk:
    """Frames with all that is drawn for them, and their steps as drjit operations; the state stays
    as it is."""

    def __init__(self, frames, times_s, front_end, sensor, generator, state):
        self.sensor, self.state, self.generator = sensor, state, generator
        self.level = levels(frames, front_end)
        self.lanes = lanes = Lanes(self.level, frames[0].numel())
        self.ends_s = torch.tensor([state.time_s, *times_s], dtype=torch.float64)
        dt_s = self.ends_s.diff()
        kind = _kind(frames, front_end, sensor, state)
        # the first leak is subtracted in single precision
        self.narrow = state.reference.dtype != kind
        self.carried = {name: getattr(state, name) for name in CARRIED}
        self.carried["reference"] = state.reference.to(kind)
        self.carried["level"] = state.level.to(kind if sensor.cutoff_hz > 0 else self.level.dtype)
        if state.last_event_s is not None:
            self.carried["last_event_s"] = state.last_event_s.double()

        def load(values, dtype=None):
            return loaded(lanes, torch.as_tensor(values, dtype=dtype, device=frames.device))

        self.leak_hz = state.leak_hz if state.leak_hz is None else load(state.leak_hz)
        self.dt_s, self.jitter = (
            load(dt_s, torch.float32),
            load([sensor.leak_jitter], torch.float32),
        )
        self.pace = load(dt_s * (2 * math.pi * sensor.cutoff_hz))
        self.chance = load(sensor.shot_rate_hz / 2 * dt_s)
        if sensor.photoreceptor_noise:
            self.noise = [load(table, state.noise.dtype) for table in self._noise_filter(dt_s)]
        if sensor.cutoff_hz > 0 or sensor.has_shots:
            intensity = frames.exp() if front_end.log_input else frames
            self.light = load(light_share(intensity.double()))
        self.drawn = {name: load(numbers) for name, numbers in self._draw(len(frames)).items()}
        thetas = state.theta_on, state.theta_off
        if sensor.theta_sigma == 0:
            thetas = [theta.flatten()[:1] for theta in thetas]
        self.thetas = [load(theta, kind) for theta in thetas]
        self.single_thetas = [load(theta, torch.float32) for theta in thetas]
        nominal = zip((sensor.theta_on, sensor.theta_off), thetas, strict=True)
        self.shares = [load(one / theta, torch.float64) for one, theta in nominal]

    def _noise_filter(self, dt_s):
        """What a frame leaves of the photoreceptor noise, and how much it adds."""
        omega = 2 * math.pi * self.sensor.cutoff_hz
        share = dt_s * omega
        if bool((share >= 2).any()):
            raise DomainError(
                f"frames {float(dt_s[share >= 2][0]):g} s apart make v2e's noise filter of "
                f"{self.sensor.cutoff_hz:g} Hz unstable; use frames closer than {2 / omega:.3g} s, or timing "
                "'interpolated'."
            )
        # the filter lets this part of white noise through
        strength = self.sensor.noise_level() / (share / (2 - share)).sqrt()
        return 1 - share, share * strength

    def _draw(self, count):
        """Random numbers of all pixels, one frame after the other."""
        sensor = self.sensor
        kinds = {
            "noise": (
                sensor.photoreceptor_noise,
                torch.randn,
                getattr(self.state.noise, "dtype", None),
            ),
            "leak": (sensor.leak_jitters, torch.randn, torch.float32),
            "shots": (sensor.has_shots, torch.rand, torch.float64),
        }
        kinds = {name: how for name, (wanted, *how) in kinds.items() if wanted}
        place = {"generator": self.generator, "device": self.generator.device}
        rows = [
            [draw(self.state.level.shape, dtype=dtype, **place) for draw, dtype in kinds.values()]
            for _ in range(count)
        ]
        return {
            name: torch.stack(row)
            for name, row in zip(kinds, zip(*rows, strict=True), strict=False)
        }

    def slots(self):
        """Slots of the frames, and what is wrong, as ``run`` has it."""
        counts, found, wrong = None, [1] * len(self.level), 0
        while counts != found and not wrong:
            counts = found
            fired = self.lanes.fresh(len(self.level), self.lanes.arr.UInt32)
            _, wrong = self.run(Slots(counts, self.ends_s, self.sensor, self.state), fired=fired)
            fired = fired.torch().view(torch.int32).reshape(len(self.level), -1)
            found = fired.amax(1).clamp(min=1).tolist()
            if self.sensor.refractory_s == 0:
                break
        return Slots(found, self.ends_s, self.sensor, self.state), wrong

    def sink(self, slots, layout, *room):
        """Keys of events, whose intervals end with the last slots of the frames."""
        since_us = slots.times_us - layout.origin_us
        ends_us = since_us.cummax(0).values[slots.first[1:] - 1]
        starts_us = torch.cat((since_us[:1] - 1, ends_us[:-1]))
        whole = (ends.numpy() / 1e6 for ends in (starts_us, ends_us))
        Whole = self.lanes.dr.int64_array_t(self.lanes.arr.Float)
        self.since_us = Whole((since_us - starts_us.repeat_interleave(slots.first.diff())).numpy())
        self.lanes.dr.eval(self.since_us)
        return EventKeys(self.lanes, *whole, replace(layout, origin_us=0), *room)

    def run(self, slots, sink=None, fired=None):
        """Run over the frames: all events go to the sink, or how often pixels fire, dead times
        apart, into an array. Returns the carried tensors and what is wrong, as ``crossing.run``."""
        tables = slots.first.int(), slots.times_s, slots.wait_s, slots.single.int()
        self.tables = [loaded(self.lanes, table.to(self.level.device)) for table in tables]
        self.keys, self.fired = sink, fired
        written = [fired] if sink is None else sink.arrays()
        # the frames are checked; levels may be below 0
        after, wrong = run(
            self.lanes, self.level, FrontEnd(log_input=True), self._step, self.carried, written
        )
        if "last_event_s" in after and bool(slots.single[-1]):
            after["last_event_s"] = after["last_event_s"].float()
        return after, wrong

    def _step(self, index, level, now):
        dr, lanes, sensor = self.lanes.dr, self.lanes, self.sensor
        Kind, Single = type(now["reference"]), dr.float32_array_t(lanes.arr.Float)

        def of_frame(table):
            return dr.gather(type(table), table, index)

        if sensor.cutoff_hz > 0:
            share = dr.minimum(lanes.at(self.light, index) * of_frame(self.pace), 1)
            level = (1 - share) * now["level"] + share * Kind(level)
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
        theta, beyond = dr.select(rising, *self.thetas), dr.abs(seen - base)
        too_many = ~(beyond <= MOST_EVENTS * theta)
        beyond = dr.select(too_many, 0, beyond)
        fires = dr.floor(beyond / theta)  # a rounded quotient may be a whole number too large
        fires = fires - dr.select(dr.fma(-fires, theta, beyond) < 0, Kind(1), 0)
        fires = lanes.arr.UInt32(fires)
        shots = []
        if sensor.has_shots:
            draw = lanes.at(self.drawn["shots"], index)
            chance = of_frame(self.chance) * (1 - 0.75 * lanes.at(self.light, index))
            on, off = (chance * share for share in self.shares)
            shots = [draw > 1 - on, draw < off]
        if self.keys is None:
            lanes.put(self.fired, fires, index)
        if self.keys is not None or "last_event_s" in now:
            fires = self._fire(index, fires, rising, shots, now)
        moved = Single(fires) * dr.select(rising, *self.single_thetas)
        base = base + Kind(dr.select(rising, moved, -moved))
        # a noise event sets the memorised level to the level seen
        now["reference"] = dr.select(shots[0] | shots[1], Kind(level), base) if shots else base
        return now, too_many

    def _fire(self, index, fires, rising, shots, now):
        """Events of a frame, then noise events, at most one of either polarity, in its last slot.
        Those within the dead time behind the last one kept are not counted, so the next frames see
        them again. Moves the dead time on. Returns how many are counted."""
        dr, arr = self.lanes.dr, self.lanes.arr
        firsts, times_s, waits_s, singles = self.tables
        first, end = (dr.gather(arr.UInt32, firsts, index + k) for k in (0, 1))
        wait_s = dr.gather(type(waits_s), waits_s, index)
        single = dr.gather(arr.UInt32, singles, index) != 0
        waits = "last_event_s" in now
        many = fires
        for shot in shots:
            many = many + dr.select(shot, arr.UInt32(1), 0)

        def kept(time_s):
            rounded = type(time_s)(dr.float32_array_t(arr.Float)(time_s))
            return dr.select(single, rounded, time_s)

        def event(nth, counted, last_s):
            own = ready = nth < fires
            place, on = first + nth, rising
            if shots:
                place = dr.select(own, place, end - 1)
                on = dr.select(own, rising, shots[0] & (nth == fires))
            if waits:
                time_s = dr.gather(type(times_s), times_s, place)
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
