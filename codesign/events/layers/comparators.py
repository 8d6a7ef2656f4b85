"""Event layers by name, and their comparators: from what a pixel sees to counts, all called alike.

A comparator is a small object with ``comparator(frames, theta_on, theta_off, state, log_input) ->
counts, state``: frames [T, ...] on the 0-255 scale, or log levels with log_input, give counts
[T-1, 2, ...], ON first, and with a state of an earlier call [T, 2, ...]. theta_on, theta_off: 0-dim
or [...]. ``mismatched`` says whether it takes the thresholds of every pixel, or the nominal ones.
``refines`` says whether it may be asked between frames, for the times of events: whether it counts
the same events, or more of the sensor's, the more often it looks. Without it the events of an
interval are spread evenly.
"""

import difflib
import warnings
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Generator, Tensor

from codesign.checks import check_whole
from codesign.errors import DomainError
from codesign.events.entry import check_chunk, check_later, check_state, check_times
from codesign.events.intensity import log_levels
from codesign.events.layers.layer import EventLayer
from codesign.events.layers.memory import memory, soft_counts
from codesign.events.layers.physical import PhysicalLayer
from codesign.events.layers.soft import dense, expected, soft
from codesign.events.low_pass import low_pass
from codesign.events.sensor.model import (
    SensorModel,
    apart,
    draw_deviates,
    draw_shot_counts,
    of_pixels,
)
from codesign.events.spiking.srm import count_spikes

MOST_REMEMBERED = 2**24  # random numbers of a draw
MOST_STEPS = 4096  # of spiking neurons per frame interval


class LastDraw:
    """Remembers one draw: what was asked for, the generators' states before and behind it, and what
    came."""

    def __init__(self):
        self._known = None

    def __deepcopy__(self, memo):
        return LastDraw()

    def __call__(self, asked, generators, draw):
        """What ``draw()`` returns, and the generators as it leaves them.

        Args:
          asked: all that the draw depends on but its generators, to be compared by ==.
          generators: in the order in which they are drawn from, also several times.
          draw: without arguments; what it returns, a tuple of tensors or None, is not changed
            afterwards.
        """
        own = list(dict.fromkeys(generators))
        place = {generator: number for number, generator in enumerate(own)}
        asked = asked, [place[generator] for generator in generators]
        before = [generator.get_state() for generator in own]
        if (
            self._known
            and self._known[0] == asked
            and all(map(torch.equal, before, self._known[1]))
        ):
            _, _, behind, drawn = self._known
            for generator, state in zip(own, behind, strict=True):
                generator.set_state(state)
            return drawn
        drawn = draw()
        if sum(numbers.numel() for numbers in drawn if numbers is not None) <= MOST_REMEMBERED:
            self._known = asked, before, [generator.get_state() for generator in own], drawn
        return drawn


@dataclass
class Sigmoid:
    """``events.soft``: sigmoid of the step between two frames, no memory. sharpness: k, or None for
    5/theta."""

    sharpness: float | None = None
    mismatched = False
    refines = False

    def __call__(self, frames, theta_on, theta_off, state, log_input):
        frames = _with_last(frames, state)
        counts = soft(frames, theta_on, theta_off, sharpness=self.sharpness, log_input=log_input)
        return counts, frames[-1].clone()


@dataclass
class SoftCounts:
    """``events.soft_counts``: |dL|/theta between two frames, no memory."""

    mismatched = True
    refines = True

    def __call__(self, frames, theta_on, theta_off, state, log_input):
        frames = _with_last(frames, state)
        return soft_counts(frames, theta_on, theta_off, log_input=log_input), frames[-1].clone()


@dataclass
class Dense:
    """``events.dense``: at most one event per frame and polarity. sharpness: b of the surrogate
    slope."""

    sharpness: float = 5.0
    mismatched = True
    refines = False

    def __call__(self, frames, theta_on, theta_off, state, log_input):
        return dense(
            frames, theta_on, theta_off, sharpness=self.sharpness, state=state, log_input=log_input
        )


@dataclass
class Memory:
    """``events.memory``: hard counts against the memorised level. gradient: "exact", "play" or
    None, as there."""

    gradient: str | None = None
    mismatched = True
    refines = True

    def __call__(self, frames, theta_on, theta_off, state, log_input):
        return memory(
            frames, theta_on, theta_off, state=state, log_input=log_input, gradient=self.gradient
        )


@dataclass
class Expected:
    """``events.expected``: mean counts under threshold mismatch. spread: relative standard
    deviation of the thresholds, in place of a drawn one; assign to anneal it."""

    spread: float = 0.15
    mismatched = False
    refines = False

    def __call__(self, frames, theta_on, theta_off, state, log_input):
        return expected(frames, theta_on, theta_off, self.spread, state=state, log_input=log_input)


@dataclass
class Spikes:
    """``events.srm`` with step kernels and coupled polarities, fed with steps of the log level: at
    most one event per frame and polarity, the rest of a step stays for the frames after it; with
    the gradient of the mean count, as ``events.memory``. steps: of the neurons per frame interval,
    over which the level runs
    linearly: the most events that an interval can give."""

    steps: int = 1
    mismatched = True
    refines = True

    def __post_init__(self):
        self.steps = check_whole(self.steps, "steps", 1, MOST_STEPS)

    def __call__(self, frames, theta_on, theta_off, state, log_input):
        level = log_levels(frames, log_input, minimum=2 if state is None else 1)
        if self.steps > 1:
            level = _between(_with_last(level, None if state is None else state[0]), self.steps)
            level = level if state is None else level[1:]
        thetas = torch.stack((theta_on, theta_off))
        spikes, state = count_spikes(level, thetas, state)
        return spikes.unflatten(0, (-1, self.steps)).sum(1) if self.steps > 1 else spikes, state


def _between(level, steps):
    """Levels [T, ...] with steps - 1 more between two, on a straight line:
    [(T - 1) * steps + 1, ...]."""
    share = torch.arange(1, steps + 1, dtype=level.dtype, device=level.device) / steps
    share = share.reshape(-1, *[1] * (level.ndim - 1))
    line = level[:-1, None] + share * level.diff(dim=0)[:, None]
    # the last of a line is the level itself, also where rounding says otherwise
    line = torch.cat((line[:, :-1], level[1:, None]), 1)
    return torch.cat((level[:1], line.flatten(0, 1)))


def _with_last(frames, last):
    """The frames, behind the last one of the chunk before where there is one."""
    return frames if last is None else torch.cat((last[None], frames))


def check_comparator(comparator: object, sensor: SensorModel, learnt: Container[str]) -> None:
    """Refuse what is no comparator, or takes no mismatch that is to be learnt; warn of what the
    sensor has and no comparator knows."""
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


@dataclass(frozen=True)
class LayerState:
    """What a ``ComparatorLayer`` carries over chunks.

    comparator: state of the comparator, and what it is a state of. level, frame: [..., H, W] level
      behind the low-pass and last frame, None without a low-pass. deviates: [2, ..., H, W] standard
      normal numbers of the thresholds, None without mismatch. time_s: time of the last frame.
      generators: of the noise still to come, one per sample.
    shape, dtype: of a frame [..., H, W].
    """

    comparator: Any
    level: Tensor | None
    frame: Tensor | None
    deviates: Tensor | None
    time_s: float
    generators: Sequence[Generator]
    shape: torch.Size
    dtype: torch.dtype
    kind: type


class ComparatorLayer(EventLayer):
    """Low-pass (where the sensor has a bandwidth), thresholds (with mismatch), a comparator, noise
    events.

    Of the sensor it uses theta_on, theta_off, theta_sigma, cutoff_hz and shot_rate_hz (Poisson, as
    ``draw_shot_counts``, without gradient); leak, dead time, hot pixels and photoreceptor noise are
    those of ``PhysicalLayer``: a sensor that has them is taken without, and a warning names them.
    comparator: one of ``events.layers.comparators``, or your own of the same call.
    """

    learnable = ("theta_on", "theta_off", "theta_sigma", "cutoff_hz")

    def __init__(
        self,
        comparator: Callable[..., tuple[Tensor, Any]],
        sensor: SensorModel | None = None,
        **options: Any,
    ):
        super().__init__(sensor, **options)
        check_comparator(comparator, self.sensor, self.learnt)
        self.comparator = comparator
        self._last_draw = LastDraw()
        self.refines = getattr(comparator, "refines", False)

    def _count(self, frames, t_s, state, generators):
        check_state(state, LayerState)
        times_s = check_times(t_s, len(frames))
        if state is None:
            kept = (generators, frames.shape[1:], frames.dtype, type(self.comparator))
            state = LayerState(None, None, None, None, 0.0, *kept)
        elif state.kind is not type(self.comparator):
            raise DomainError(
                f"the state comes from a layer with the comparator {state.kind.__name__}, this one has "
                f"{type(self.comparator).__name__}; pass what this layer returned."
            )
        elif state.level is None and self.sensor.cutoff_hz > 0:
            raise DomainError(
                "the layer has a bandwidth, the one that began the state had not; begin anew."
            )
        else:
            check_chunk(frames, state.shape, state.dtype)
            times_s = check_later(times_s, state.time_s)
            # copies, so that a state used twice gives the same twice
            state = replace(state, generators=apart(state.generators))
        deviates, shots = self._noise(frames, times_s.diff(), state)
        seen, level = self._seen(frames, times_s.diff(), state)
        drawn = (None, None) if deviates is None or not self.comparator.mismatched else deviates
        theta_on, theta_off = (
            of_pixels(self.value(name), self.value("theta_sigma"), deviate, frames)
            for name, deviate in zip(("theta_on", "theta_off"), drawn, strict=True)
        )
        is_level = self.log_input or level is not None
        counts, comparator = self.comparator(seen, theta_on, theta_off, state.comparator, is_level)
        if shots is not None:
            counts = counts + shots
        frame = None if level is None else frames[-1].clone()  # its buffer may be filled again
        return counts, replace(
            state,
            comparator=comparator,
            level=level,
            frame=frame,
            deviates=deviates,
            time_s=float(times_s[-1]),
            generators=apart(state.generators),
        )

    def _noise(self, frames, interval_s, state):
        """Deviates of the thresholds [2, ..., H, W] and noise events [T-1, 2, ..., H, W], None each
        where the sensor has none; one sample after the other."""
        draws_thetas = self.sensor.theta_sigma > 0 and state.deviates is None
        if not draws_thetas and not self.sensor.has_shots:
            return state.deviates, None
        rate_hz = self.sensor.shot_rate_hz
        of_frames = frames.shape, frames.dtype, frames.device
        asked = (*of_frames, interval_s.tolist(), draws_thetas, rate_hz)
        deviates, shots = self._last_draw(
            asked,
            state.generators,
            lambda: self._draw(frames, interval_s, state.generators, draws_thetas),
        )
        return state.deviates if deviates is None else deviates, shots

    def _draw(self, frames, interval_s, generators, draws_thetas):
        pixels = frames.shape[-2:]
        deviates = []
        shots = []
        for generator in generators:
            if draws_thetas:
                deviates.append(draw_deviates(pixels, generator, dtype=frames.dtype))
            if self.sensor.has_shots:
                shots.append(
                    draw_shot_counts(self.sensor, pixels, interval_s, generator, dtype=frames.dtype)
                )
        batch = frames.shape[1:]
        return (
            torch.stack(deviates, 1).reshape(2, *batch).to(frames) if deviates else None,
            torch.stack(shots, 2).reshape(-1, 2, *batch).to(frames) if shots else None,
        )

    def _seen(self, frames, interval_s, state):
        """What the comparator gets: the frames, or log levels behind the low-pass with the last of
        them."""
        if self.sensor.cutoff_hz == 0:
            return frames, None
        both = frames if state.frame is None else torch.cat((state.frame[None], frames))
        level = log_levels(both, self.log_input, minimum=2)
        intensity = both.exp() if self.log_input else both
        level = low_pass(level, intensity, interval_s, self.value("cutoff_hz"), state.level)
        return level[-len(frames) :], level[-1]


COMPARATORS = {
    "sigmoid": Sigmoid,
    "counts": SoftCounts,
    "dense": Dense,
    "memory": Memory,
    "expected": Expected,
    "srm": Spikes,
}
LAYERS = (*COMPARATORS, "physical")


def layer(name: str = "memory", sensor: SensorModel | None = None, **options: Any) -> EventLayer:
    """The event layer of that name, a module with learnable thresholds.

    Args:
      name: "sigmoid" (per frame pair, no memory: the baseline), "counts" (the same without cap or
        ghosts), "dense" (comparator with surrogate, at most one event per frame), "memory"
        (memorised level, straight-through counts: the default), "expected" (mean counts under
        threshold mismatch), "srm" (spike response model, at most one event per frame), "physical"
        (the full sensor).
      sensor: SensorModel to start from. options: learn, log_input (see ``EventLayer``), and spread
        of "expected", sharpness of "sigmoid" and "dense", gradient of "memory"
        ("exact", "play" or None), steps (per frame interval) of "srm".
    Raises: DomainError for an unknown name, with the nearest one, an unknown option, or a value
      that cannot be learnt. A warning names what the sensor has and the layer does not know
      (leak, dead time, ...).

    Example:
    >>> import torch
    >>> from codesign import events
    >>> sensor = events.layer("memory", events.SensorModel(theta_on=0.2, theta_off=0.3))
    >>> frames = torch.tensor([40.0, 100.0, 30.0]).reshape(3, 1, 1)
    >>> sensor(frames, torch.tensor([0.0, 0.01, 0.02])).flatten(1).tolist()  # ON: ln(100/40)/0.2
    [[4.0, 0.0], [0.0, 3.0]]
    """
    if name not in LAYERS:
        near = difflib.get_close_matches(str(name), LAYERS, n=1)
        raise DomainError(
            f"there is no event layer {name!r}{f', did you mean {near[0]!r}?' if near else ';'} event layers "
            f"are {', '.join(map(repr, LAYERS))}."
        )
    own = () if name == "physical" else tuple(field.name for field in fields(COMPARATORS[name]))
    known = ("learn", "log_input", *own)
    if unknown := [option for option in options if option not in known]:
        raise DomainError(
            f"the event layer {name!r} has no option {unknown[0]!r}; its options are {', '.join(known)}."
        )
    if name == "physical":
        return PhysicalLayer(sensor, **options)
    values = {option: options.pop(option) for option in own if option in options}
    return ComparatorLayer(COMPARATORS[name](**values), sensor, **options)
