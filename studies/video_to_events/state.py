"""How far a run has come, and how it is stored, so that an interrupted one ends with the same events."""

import dataclasses
from dataclasses import dataclass, field

import torch
from torch import Tensor

from codesign.errors import FileFormatError
from codesign.events import SensorState
from studies.video_to_events.steps import LARGEST


@dataclass
class Progress:
    """State of the simulation behind the frame ``next_frame`` - 1.

    facts: what must be the same when the run goes on. sensor: SensorState. events, on: events made, and how
      many of them are ON.
    simulated: frames that the sensor saw, those put between with them. largest: digital value seen. seconds,
      simulating_s: time spent on everything, and on the sensor alone. histogram, before: see Steps.
    """

    next_frame: int
    facts: dict[str, int]
    sensor: SensorState
    events: int = 0
    on: int = 0
    simulated: int = 0
    largest: float = 0.0
    seconds: float = 0.0
    simulating_s: float = 0.0
    histogram: Tensor = field(default_factory=lambda: torch.zeros(LARGEST + 1, dtype=torch.int64))
    before: Tensor | None = None

    def count(self, found, frames):
        """Take in the events of some frames."""
        self.events = self.events + len(found)
        self.on = self.on + int((found.p > 0).sum())
        self.simulated = self.simulated + frames

    def advance(self, next_frame, largest, seconds):
        """Go on behind a chunk."""
        self.next_frame = next_frame
        self.largest = max(self.largest, largest)
        self.seconds += seconds

    def save(self, run, steps):
        """Write the state into the run's folder."""
        tensors = {"histogram": steps.histogram, **({} if steps.before is None else {"before": steps.before})}
        numbers = {
            name: getattr(self, name)
            for name in (
                "next_frame",
                "facts",
                "events",
                "on",
                "simulated",
                "largest",
                "seconds",
                "simulating_s",
            )
        }
        numbers["sensor"] = {}
        for each in dataclasses.fields(self.sensor):
            value = getattr(self.sensor, each.name)
            if isinstance(value, Tensor):
                tensors[f"sensor.{each.name}"] = value.contiguous()
            elif isinstance(value, torch.Generator):
                tensors["generator"] = value.get_state()
            elif value is not None:
                numbers["sensor"][each.name] = value
        run.save_state(tensors, numbers)

    @classmethod
    def load(cls, run, first_frame, seed, facts):
        """The state an earlier session stored, or a fresh one. Raises: FileFormatError when the input is no
        longer the one of the run."""
        sensor = SensorState(generator=torch.Generator().manual_seed(seed))
        stored = run.load_state()
        if stored is None:
            return cls(first_frame, facts, sensor)
        numbers = dict(stored.numbers)
        if numbers["facts"] != facts:
            raise FileFormatError(
                f"the input now gives {facts}, but the run began with {numbers['facts']}; start a new run."
            )
        for name, value in numbers.pop("sensor").items():
            setattr(sensor, name, value)
        for name, value in stored.tensors.items():
            if name.startswith("sensor."):
                setattr(sensor, name.removeprefix("sensor."), value.to(run.device))
        assert sensor.generator is not None
        sensor.generator.set_state(stored.tensors["generator"])
        return cls(
            **numbers,
            sensor=sensor,
            histogram=stored.tensors["histogram"],
            before=stored.tensors.get("before"),
        )
