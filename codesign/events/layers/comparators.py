"""The comparators of an event layer: from what a pixel sees to counts, all called alike.

Each is a small object with ``comparator(frames, theta_on, theta_off, state, log_input) -> counts, state``:
frames [T, ...] give counts [T-1, 2, ...], ON first, and with a state of an earlier call [T, 2, ...].
``mismatched`` says whether it takes the thresholds of every pixel, or the nominal ones. ``refines`` says
whether it may be asked between frames, for the times of events: whether it counts the same events, or more of
the sensor's, the more often it looks. Without it the events of an interval are spread evenly.
``whole`` says whether it counts whole events.
"""

import warnings
from collections.abc import Container
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.events.entry import check_whole
from codesign.events.intensity import log_levels
from codesign.events.layers.dense import dense
from codesign.events.layers.expected import expected
from codesign.events.layers.memory import memory, soft_counts
from codesign.events.layers.soft import soft
from codesign.events.sensor.model import SensorModel
from codesign.events.spiking.comparators import count_spikes

MOST_STEPS = 4096  # of spiking neurons per frame interval


class Comparator(Protocol):
    """What ``ComparatorLayer`` calls. frames: [T, ...] on the 0-255 scale, or log levels with log_input;
    theta_on, theta_off: 0-dim or [...]; state: what the call before returned, None at first."""

    @property
    def mismatched(self) -> bool: ...

    @property
    def refines(self) -> bool: ...

    @property
    def whole(self) -> bool: ...

    def __call__(
        self, frames: Tensor, theta_on: Tensor, theta_off: Tensor, state: Any, log_input: bool, /
    ) -> tuple[Tensor, Any]: ...


@dataclass
class Sigmoid:
    """``events.soft``: sigmoid of the step between two frames, no memory. sharpness: k, or None for 5/theta."""

    sharpness: float | None = None
    mismatched = False
    refines = False
    whole = False

    def __call__(
        self, frames: Tensor, theta_on: Tensor, theta_off: Tensor, state: Tensor | None, log_input: bool
    ) -> tuple[Tensor, Tensor]:
        frames = _with_last(frames, state)
        on = soft(frames, theta_on, sharpness=self.sharpness, log_input=log_input)[:, 0]
        off = soft(frames, theta_off, sharpness=self.sharpness, log_input=log_input)[:, 1]
        return torch.stack((on, off), dim=1), frames[-1]


@dataclass
class SoftCounts:
    """``events.soft_counts``: |dL|/theta between two frames, no memory."""

    mismatched = True
    refines = True
    whole = False

    def __call__(
        self, frames: Tensor, theta_on: Tensor, theta_off: Tensor, state: Tensor | None, log_input: bool
    ) -> tuple[Tensor, Tensor]:
        frames = _with_last(frames, state)
        return soft_counts(frames, theta_on, theta_off, log_input=log_input), frames[-1]


@dataclass
class Dense:
    """``events.dense``: at most one event per frame and polarity. sharpness: b of the surrogate slope."""

    sharpness: float = 5.0
    mismatched = True
    refines = False
    whole = True

    def __call__(
        self, frames: Tensor, theta_on: Tensor, theta_off: Tensor, state: Tensor | None, log_input: bool
    ) -> tuple[Tensor, Tensor]:
        return dense(frames, theta_on, theta_off, sharpness=self.sharpness, state=state, log_input=log_input)


@dataclass
class Memory:
    """``events.memory``: hard counts against the memorised level. gradient: "exact", "play" or None, as there."""

    gradient: str | None = None
    mismatched = True
    refines = True
    whole = True

    def __call__(
        self, frames: Tensor, theta_on: Tensor, theta_off: Tensor, state: Tensor | None, log_input: bool
    ) -> tuple[Tensor, Tensor]:
        return memory(frames, theta_on, theta_off, state=state, log_input=log_input, gradient=self.gradient)


@dataclass
class Expected:
    """``events.expected``: mean counts under threshold mismatch. spread: relative standard deviation of the
    thresholds, in place of a drawn one; assign to anneal it (see ``events.annealed``)."""

    spread: float = 0.15
    mismatched = False
    refines = False
    whole = False

    def __call__(
        self, frames: Tensor, theta_on: Tensor, theta_off: Tensor, state: Tensor | None, log_input: bool
    ) -> tuple[Tensor, Tensor]:
        return expected(frames, theta_on, theta_off, self.spread, state=state, log_input=log_input)


@dataclass
class Spikes:
    """``events.srm`` with step kernels and coupled polarities, fed with steps of the log level: at most one
    event per frame and polarity, the rest of a step stays for the frames after it. gradient: "play" (of the
    mean count, as ``events.memory``) or "surrogate" (of a fast sigmoid). steps: of the neurons per frame
    interval, over which the level runs linearly: the most events that an interval can give."""

    gradient: str = "play"
    steps: int = 1
    mismatched = True
    refines = True
    whole = True

    def __post_init__(self):
        if self.gradient not in ("surrogate", "play"):
            raise DomainError(
                f"gradient is {self.gradient!r}; choose one of 'surrogate', 'play': the layer memorises a level."
            )
        self.steps = check_whole(self.steps, "steps", 1, MOST_STEPS)

    def __call__(
        self, frames: Tensor, theta_on: Tensor, theta_off: Tensor, state: Any, log_input: bool
    ) -> tuple[Tensor, Any]:
        level = log_levels(frames, log_input, minimum=2 if state is None else 1)
        if self.steps > 1:
            level = _between(_with_last(level, None if state is None else state[0]), self.steps)
            level = level if state is None else level[1:]
        thetas = torch.stack((theta_on, theta_off))
        spikes, state = count_spikes(level, None, thetas, state, None, gradient=self.gradient)
        return spikes.unflatten(0, (-1, self.steps)).sum(1) if self.steps > 1 else spikes, state


def _between(level, steps):
    """Levels [T, ...] with steps - 1 more between two, on a straight line: [(T - 1) * steps + 1, ...]."""
    share = torch.arange(1, steps + 1, dtype=level.dtype, device=level.device) / steps
    share = share.reshape(-1, *[1] * (level.ndim - 1))
    line = level[:-1, None] + share * level.diff(dim=0)[:, None]
    return torch.cat((level[:1], line.flatten(0, 1)))


def _with_last(frames, last):
    """The frames, behind the last one of the chunk before where there is one."""
    return frames if last is None else torch.cat((last[None], frames))


def check_comparator(comparator: object, sensor: SensorModel, learnt: Container[str]) -> None:
    """Refuse what is no comparator, or takes no mismatch that is to be learnt; warn of what the sensor has and no
    comparator knows."""
    if not callable(comparator) or not hasattr(comparator, "mismatched"):
        raise DomainError(
            f"the comparator is {comparator!r}; it is called (frames, theta_on, theta_off, state, log_input) "
            "and has an attribute mismatched, see codesign.events.layers.comparators."
        )
    name = type(comparator).__name__
    if "theta_sigma" in learnt and not comparator.mismatched:
        raise DomainError(
            f"theta_sigma has no gradient in the comparator {name}, which takes nominal thresholds; leave it "
            "out of learn."
        )
    asked = {
        "leak_rate_hz": sensor.leak_rate_hz,
        "hot pixels": sensor.hot_pixel_share * sensor.hot_pixel_rate_hz,
        "refractory_s": sensor.refractory_s,
        "photoreceptor_noise": sensor.photoreceptor_noise,
    }
    if left_out := [what for what, value in asked.items() if value]:
        warnings.warn(
            f"the comparator {name} knows no {', '.join(left_out)}: the sensor is taken without. The layer "
            "'physical' has them all; dataclasses.replace(sensor, ...) with zeros says that you mean it.",
            stacklevel=4,
        )
