"""What a run of video_to_events keeps, so that an interrupted one ends with the same events: the
events so far, how far it has come, and how far pixels step from frame to frame."""

from bisect import bisect_right
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from codesign.errors import CodesignError, FileFormatError
from codesign.events import SensorState, soft_counts
from codesign.types import EventStream

RECORD = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])  # 13 bytes
LARGEST = 64  # steps of more thresholds are counted as this many
# thresholds: an event in the middle of such a step is placed by interpolation over several others
LARGE = 3
WORRYING = 0.1  # share of the moving pixels


class EventLog:
    """A file of events in order of time, appended to while they are made and read in pieces: memory
    stays flat.

    path: the file.
    count: events in it that count; later ones, written before a run was killed, are cut off.
    height_px, width_px: sensor size.
    Raises: FileFormatError when the file holds fewer than ``count``.
    """

    def __init__(self, path, count, height_px, width_px):
        self.path = path
        self.count = count
        self.height_px = height_px
        self.width_px = width_px
        held = path.stat().st_size if path.exists() else 0
        if held < count * RECORD.itemsize:
            raise FileFormatError(
                f"'{path}' holds {held // RECORD.itemsize} of the {count} events made so far; it was "
                "damaged: start a new run."
            )
        with path.open("ab") as file:
            file.truncate(count * RECORD.itemsize)

    def append(self, stream):
        records = np.empty(len(stream), RECORD)
        for name, values in (("t", stream.t_us), ("x", stream.x), ("y", stream.y), ("p", stream.p)):
            records[name] = values.cpu().numpy()
        try:
            # closed before the number of events is stored elsewhere
            with self.path.open("ab") as file:
                file.write(records.tobytes())
        except OSError as error:
            raise CodesignError(
                f"cannot write to '{self.path}' ({error.strerror}); free space there, or choose another "
                "folder with --out."
            ) from error
        self.count += len(stream)

    def read(self, first, last):
        """EventStream of the events ``first`` to ``last`` - 1."""
        return self._stream(self._records(first, last - first))

    def pick(self, indices):
        """EventStream of single events, by increasing index (a tensor)."""
        return self._stream(np.concatenate([self._records(index, 1) for index in indices.tolist()]))

    def positions(self, times_us):
        """For each time, the number of events at or before it."""
        every = range(self.count)
        return [
            bisect_right(every, time, key=lambda k: self._records(k, 1)["t"][0])
            for time in times_us
        ]

    def _records(self, first, count):
        # no memory map, whose pages would count as memory of the process
        return np.fromfile(self.path, RECORD, max(count, 0), offset=first * RECORD.itemsize)

    def _stream(self, records):
        t_us, x, y, p = (torch.from_numpy(records[name].astype(np.int64)) for name in "txyp")
        return EventStream(t_us, x, y, p, self.height_px, self.width_px)


@dataclass
class Progress:
    """State of the simulation behind the frame ``next_frame`` - 1.

    facts: what must be the same when the run goes on.
    sensor: SensorState.
    events, on: events made, and how many of them are ON.
    simulated: frames that the sensor saw, those put between with them.
    largest: digital value seen.
    seconds: time spent.
    histogram: [LARGEST + 1] int64; entry n counts pixels and intervals whose level moved by n to n
      + 1 thresholds.
    before: [H, W] the last frame seen.
    """

    next_frame: int
    facts: dict[str, int]
    sensor: SensorState
    events: int = 0
    on: int = 0
    simulated: int = 0
    largest: float = 0.0
    seconds: float = 0.0
    histogram: Tensor = field(default_factory=lambda: torch.zeros(LARGEST + 1, dtype=torch.int64))
    before: Tensor | None = None

    def add(self, frames, found, thetas):
        """Take in frames [N, H, W] and their events; steps are counted in whole thresholds
        (ON, OFF)."""
        self.events += len(found)
        self.on += int((found.p > 0).sum())
        self.simulated += len(frames)
        if self.before is not None:
            frames = torch.cat((self.before.to(frames)[None], frames))
        self.before = frames[-1].clone()
        if len(frames) > 1:
            # of the two polarities one is 0
            size = soft_counts(frames, *thetas).sum(1).clamp(max=LARGEST).long()
            self.histogram += torch.bincount(size.flatten(), minlength=LARGEST + 1).cpu()

    @property
    def large_share(self):
        """Share of steps beyond LARGE thresholds among those that make events, of one threshold and
        more."""
        return float(self.histogram[LARGE:].sum() / self.histogram[1:].sum().clamp(min=1))

    @property
    def remedy(self):
        """By which factor the frame rate would have to grow so that nine in ten moving pixels step
        at most LARGE thresholds; 1 where they do."""
        moving = self.histogram[1:].cumsum(0)
        if not int(moving[-1]):
            return 1.0
        step = 2 + int(
            torch.searchsorted(moving, int(0.9 * int(moving[-1])) + 1).clamp(max=len(moving) - 1)
        )
        return max(1.0, step / LARGE)

    def save(self, run):
        tensors = {"histogram": self.histogram}
        if self.before is not None:
            tensors["before"] = self.before
        names = ("next_frame", "facts", "events", "on", "simulated", "largest", "seconds")
        numbers = {name: getattr(self, name) for name in names}
        numbers["sensor"] = {"start_s": self.sensor.start_s, "time_s": self.sensor.time_s}
        for name, value in self.sensor.tensors().items():
            tensors[f"sensor.{name}"] = value.contiguous()
        assert self.sensor.generator is not None
        tensors["generator"] = self.sensor.generator.get_state()
        run.save_state(tensors, numbers)

    @classmethod
    def load(cls, run, first_frame, seed, facts):
        """The state an earlier session stored, or a fresh one. Raises: FileFormatError when the
        input is no longer the one of the run."""
        generator = torch.Generator().manual_seed(seed)
        sensor = SensorState(generator=generator)
        stored = run.load_state()
        if stored is None:
            return cls(first_frame, facts, sensor)
        numbers = dict(stored.numbers)
        if numbers["facts"] != facts:
            raise FileFormatError(
                f"the input now gives {facts}, but the run began with {numbers['facts']}; start a new run."
            )
        numbers.pop("simulating_s", None)  # of runs that began with an earlier version
        for name, value in numbers.pop("sensor").items():
            setattr(sensor, name, value)
        for name, value in stored.tensors.items():
            if name.startswith("sensor."):
                setattr(sensor, name.removeprefix("sensor."), value.to(run.device))
        generator.set_state(stored.tensors["generator"])
        kept = {name: stored.tensors.get(name) for name in ("histogram", "before")}
        return cls(**numbers, sensor=sensor, **kept)
