"""Event layers as modules: one call for all of them, and learnable sensor values as unconstrained variables."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Generator, Tensor, nn

from codesign.errors import DomainError, ShapeError
from codesign.events.entry import check_layout, check_times
from codesign.events.intensity import FrontEnd, log_levels
from codesign.events.layers.comparators import Comparator, check_comparator
from codesign.events.layers.last_draw import LastDraw
from codesign.events.layers.physical import DESIGN, PhysicalState, sensor_counts
from codesign.events.layers.positive import PositiveValues
from codesign.events.level_path import finer, parts
from codesign.events.low_pass import low_pass
from codesign.events.sensor.model import (
    SensorModel,
    check_generator,
    check_sensor,
    draw_deviates,
    draw_shot_counts,
    mismatched,
)
from codesign.events.volumes.hard_surface import surface_from_hard_counts
from codesign.events.volumes.surface import surface_from_counts
from codesign.events.volumes.traces import check_tau
from codesign.events.volumes.volume import check_bins, from_counts
from codesign.types import EventVolume

THRESHOLDS = ("theta_on", "theta_off")
PARTS_PER_BIN = 4  # intervals, from one node of a volume to the next, from which on finer ones change nothing
PARTS_PER_TAU = 8  # the same for the time in which a surface fades


class EventLayer(nn.Module):
    """What all event layers share; ``events.layer(name)`` makes one.

    sensor: SensorModel that it starts from. learn: fields of the sensor to learn, kept in
      ``learnt`` as unconstrained variables; a unit step of one is about 10 % of its value.
    log_input: frames are log levels instead of linear intensity.
    """

    learnable: tuple[str, ...] = ()
    refines = False  # whether it may be asked between frames, see ``events.layers.comparators``
    whole = False  # whether it counts whole events

    def __init__(
        self,
        sensor: SensorModel | None = None,
        *,
        learn: Sequence[str] = THRESHOLDS,
        log_input: bool = False,
    ):
        super().__init__()
        self.sensor = SensorModel() if sensor is None else check_sensor(sensor)
        self.log_input = FrontEnd(log_input).log_input
        if isinstance(learn, str) or not isinstance(learn, Sequence):
            raise DomainError(f"learn is {learn!r}; a list of names is needed, such as {THRESHOLDS}, or ().")
        for name in learn:
            if name not in self.learnable:
                raise DomainError(
                    f"a {type(self).__name__} cannot learn {name!r}, which has no gradient there; it learns "
                    f"{', '.join(self.learnable)} (the layer 'physical' {', '.join(DESIGN)})."
                )
            if getattr(self.sensor, name) <= 0:
                raise DomainError(
                    f"{name} is 0 in the sensor, so it is switched off; give a value above 0 to learn it."
                )
        self.learnt = PositiveValues({name: getattr(self.sensor, name) for name in learn})

    def value(self, name: str) -> Tensor | float:
        """A field of the sensor as it is now: a 0-dim tensor with a gradient where it is learnt, a number
        otherwise."""
        return self.learnt[name] if name in self.learnt else getattr(self.sensor, name)

    def fitted(self) -> SensorModel:
        """The sensor with all values as they are now, for ``events.simulate``."""
        return replace(self.sensor, **{name: float(self.learnt[name].detach()) for name in self.learnt})

    def forward(
        self, frames: Tensor, t_s: Tensor, generator: Generator | Sequence[Generator] | None = None
    ) -> Tensor:
        """Event counts of the frames.

        Args:
          frames: [..., T, H, W] linear intensity on the 0-255 scale (log levels with ``log_input``); axes
            before time are a batch. t_s: [T] seconds, strictly increasing, the same for the whole batch.
          generator: for threshold mismatch and noise where the sensor has them. One for all: the samples of
            a batch draw one after the other, as if each were given by itself; or a list with one each. None:
            seed 0 in every sample and call.
        Returns: counts [..., T-1, 2, H, W] >= 0, ON first.
        Gradient: frames and ``parameters()``, as of the function that the layer calls.
        Raises: ShapeError, DomainError for frames, times or generators that do not fit.
        """
        return self.advance(frames, t_s, None, generator)[0]

    def advance(
        self,
        frames: Tensor,
        t_s: Tensor,
        state: Any = None,
        generator: Generator | Sequence[Generator] | None = None,
    ) -> tuple[Tensor, Any]:
        """The same in chunks of time.

        Args: as for ``forward``. state: what the chunk before returned, which brings its own generators; then
          T frames give T intervals. None: the first chunk.
        Returns: counts [..., T-1, 2, H, W] ([..., T, 2, H, W] with a state); state to carry on, with its graph.
        """
        check_axes(frames)
        if state is not None and generator is not None:
            raise DomainError(
                "a generator and a state are given; the state carries the generator of its first chunk on: "
                "leave the generator out."
            )
        frames = frames.movedim(-3, 0)
        check_layout(frames, 2 if state is None else 1)
        counts, state = self._count(frames, t_s, state, _generators(generator, frames.shape[1:-2]))
        return counts.movedim((0, 1), (-4, -3)), state

    def finely(
        self,
        frames: Tensor,
        t_s: Tensor,
        longest_s: float,
        generator: Generator | Sequence[Generator] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Event counts in intervals no longer than asked for: when events come, and not only between which
        frames.

        A layer that can (``refines``) is asked on the way of the log level between frames (``events.finer``);
        another one has the events of an interval spread evenly over it.

        Args: as for ``forward``. longest_s: length of the longest interval, seconds, > 0.
        Returns: counts [..., T'-1, 2, H, W], times [T'] float64, those of the frames among them. Frames that
          are dense enough are taken as they are: then these are the counts of ``forward``.
        Gradient: as ``forward``, also for when events come.
        Raises: as ``forward``; DomainError for a length that is not positive.
        """
        check_axes(frames)
        if self.refines:
            fine, times_s = finer(frames.movedim(-3, 0), t_s, longest_s, log_input=self.log_input)
            return self(fine.movedim(0, -3), times_s, generator), times_s
        counts = self(frames, t_s, generator)
        interval, share, times_s = parts(
            check_times(t_s, counts.shape[-4] + 1), longest_s, counts.select(-4, 0).numel()
        )
        if len(interval) == counts.shape[-4]:
            return counts, times_s
        alike = torch.bincount(interval)[interval]
        alike = alike.to(counts).reshape(-1, 1, 1, 1)
        return counts.index_select(-4, interval.to(counts.device)) / alike, times_s

    def volume(
        self,
        frames: Tensor,
        t_s: Tensor,
        bins: int,
        generator: Generator | Sequence[Generator] | None = None,
    ) -> EventVolume:
        """Events of the frames in time bins, each near its own time however few the frames are (``finely``).

        Args: as for ``forward``. bins: number of bins.
        Returns: EventVolume of counts [B, 2, bins, H, W], see ``events.from_counts``; several batch axes come
          as one.
        Gradient: as ``forward``, also for when events come.
        """
        check_bins(bins)
        check_axes(frames)
        given_s = check_times(t_s, frames.shape[-3])
        longest_s = float(given_s[-1] - given_s[0]) / (bins - 1) / PARTS_PER_BIN if bins > 1 else math.inf
        counts, times_s = self.finely(frames, t_s, longest_s, generator)
        return from_counts(counts.movedim((-4, -3), (0, 1)), times_s, bins)

    def surface(
        self,
        frames: Tensor,
        t_s: Tensor,
        tau_s: float,
        generator: Generator | Sequence[Generator] | None = None,
    ) -> Tensor:
        """Time surface at every frame but the first, each event near its own time (``finely``).

        Args: as for ``forward``. tau_s: time in which the surface fades to 1/e, seconds, > 0.
        Returns: [..., T-1, 2, H, W] in 0 to 1, ON first.
        Gradient: of layers that count whole events as ``surface_from_hard_counts`` of these counts, of others as
          ``surface_from_counts``.
        Raises: as ``forward``; DomainError for tau.
        """
        tau_s = check_tau(tau_s)
        counts, times_s = self.finely(frames, t_s, tau_s / PARTS_PER_TAU, generator)
        counts = counts.movedim((-4, -3), (0, 1))
        given_s = check_times(t_s, frames.shape[-3])[1:]
        if self.refines and self.whole:
            surface = surface_from_hard_counts(counts, times_s, given_s, tau_s)
        else:
            at = torch.searchsorted(times_s, given_s) - 1  # parts end at frames
            surface = surface_from_counts(counts, times_s, tau_s)[at.to(counts.device)]
        return surface.movedim((0, 1), (-4, -3))

    def _count(self, frames, t_s, state, generators):
        """Counts [T-1, 2, ..., H, W] of frames [T, ..., H, W], and the state to carry on."""
        raise NotImplementedError


@dataclass(frozen=True)
class LayerState:
    """What a ``ComparatorLayer`` carries over chunks.

    comparator: state of the comparator, and what it is a state of. level, frame: [..., H, W] level behind the low-pass and last frame,
      None without a low-pass. deviates: [2, ..., H, W] standard normal numbers of the thresholds, None without
      mismatch. time_s: time of the last frame. generators: of the noise still to come, one per sample.
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
    """Low-pass (where the sensor has a bandwidth), thresholds (with mismatch), a comparator, noise events.

    Of the sensor it uses theta_on, theta_off, theta_sigma, cutoff_hz and shot_rate_hz (Poisson, as
    ``draw_shot_counts``, without gradient); leak, dead time, hot pixels and photoreceptor noise are those of
    ``PhysicalLayer``: a sensor that has them is taken without, and a warning names them.
    comparator: one of ``events.layers.comparators``, or your own of the same call.
    """

    learnable = ("theta_on", "theta_off", "theta_sigma", "cutoff_hz")

    def __init__(self, comparator: Comparator, sensor: SensorModel | None = None, **options: Any):
        super().__init__(sensor, **options)
        check_comparator(comparator, self.sensor, self.learnt)
        self.comparator = comparator
        self._last_draw = LastDraw()
        self.refines = getattr(comparator, "refines", False)
        self.whole = getattr(comparator, "whole", False)

    def _count(self, frames, t_s, state, generators):
        if state is not None and not isinstance(state, LayerState):
            raise DomainError(f"the state is a {type(state).__name__}; pass what this layer returned.")
        if state is not None and state.kind is not type(self.comparator):
            raise DomainError(
                f"the state comes from a layer with the comparator {state.kind.__name__}, this one has "
                f"{type(self.comparator).__name__}; pass what this layer returned."
            )
        if state is not None and state.level is None and self.sensor.cutoff_hz > 0:
            raise DomainError("the layer has a bandwidth, the one that began the state had not; begin anew.")
        if state is not None and (state.shape, state.dtype) != (frames.shape[1:], frames.dtype):
            raise ShapeError(
                f"{frames.dtype} frames of {list(frames.shape[1:])} follow {state.dtype} frames of "
                f"{list(state.shape)}; a sensor keeps its size and type, a batch its samples."
            )
        times_s = _times(frames, t_s, None if state is None else state.time_s)
        if state is None:
            kept = (generators, frames.shape[1:], frames.dtype, type(self.comparator))
            state = LayerState(None, None, None, None, 0.0, *kept)
        deviates, shots = self._noise(frames, times_s.diff(), state)
        seen, level = self._seen(frames, times_s.diff(), state)
        on, off = (None, None) if deviates is None else deviates
        theta_on = self._threshold("theta_on", frames, on)
        theta_off = self._threshold("theta_off", frames, off)
        is_level = self.log_input or level is not None
        counts, comparator = self.comparator(seen, theta_on, theta_off, state.comparator, is_level)
        if shots is not None:
            counts = counts + shots
        frame = None if level is None else frames[-1]
        time_s = float(times_s[-1])
        return counts, replace(
            state, comparator=comparator, level=level, frame=frame, deviates=deviates, time_s=time_s
        )

    def _noise(self, frames, interval_s, state):
        """Deviates of the thresholds [2, ..., H, W] and noise events [T-1, 2, ..., H, W], None each where the
        sensor has none; one sample after the other."""
        draws_thetas = self.sensor.theta_sigma > 0 and state.deviates is None
        if not draws_thetas and not self.sensor.has_shots:
            return state.deviates, None
        asked = (frames.shape, frames.dtype, frames.device, interval_s.tolist(), draws_thetas)
        deviates, shots = self._last_draw(
            asked, state.generators, lambda: self._draw(frames, interval_s, state.generators, draws_thetas)
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
                shots.append(draw_shot_counts(self.sensor, pixels, interval_s, generator, dtype=frames.dtype))
        batch = frames.shape[1:]
        return (
            torch.stack(deviates, 1).reshape(2, *batch).to(frames) if deviates else None,
            torch.stack(shots, 2).reshape(-1, 2, *batch).to(frames) if shots else None,
        )

    def _seen(self, frames, interval_s, state):
        """What the comparator gets: the frames, or log levels behind the low-pass with the last of them."""
        if self.sensor.cutoff_hz == 0:
            return frames, None
        both = frames if state.frame is None else torch.cat((state.frame[None], frames))
        level = log_levels(both, self.log_input, minimum=2)
        intensity = both.exp() if self.log_input else both
        level = low_pass(level, intensity, interval_s, self.value("cutoff_hz"), state.level)
        return level[-len(frames) :], level[-1]

    def _threshold(self, name, frames, deviate):
        theta = torch.as_tensor(self.value(name), dtype=frames.dtype, device=frames.device)
        if deviate is None or not self.comparator.mismatched:
            return theta
        sigma = torch.as_tensor(self.value("theta_sigma"), dtype=frames.dtype, device=frames.device)
        return mismatched(theta, sigma, deviate)


class PhysicalLayer(EventLayer):
    """``events.sensor_counts``: exactly the events of ``events.simulate``, noise and all, with gradients to
    the sensor. A batch is one sample after the other."""

    learnable = DESIGN
    refines = True
    whole = True

    def _count(self, frames, t_s, state, generators):
        samples = frames.reshape(len(frames), -1, *frames.shape[-2:]).unbind(1)
        if state is not None and not (
            isinstance(state, tuple) and all(isinstance(before, PhysicalState) for before in state)
        ):
            raise DomainError(f"the state is a {type(state).__name__}; pass what this layer returned.")
        if state is not None and len(state) != len(samples):
            raise ShapeError(
                f"{len(samples)} samples follow {len(state)}; a batch keeps its samples over the chunks."
            )
        design = {name: self.value(name) for name in self.learnt}
        counts, states = zip(
            *(
                sensor_counts(
                    sample,
                    t_s,
                    self.sensor,
                    generator=generator,
                    state=before,
                    log_input=self.log_input,
                    **design,
                )
                for sample, generator, before in zip(
                    samples, generators, state or [None] * len(samples), strict=True
                )
            ),
            strict=True,
        )
        return torch.stack(counts, 2).reshape(-1, 2, *frames.shape[1:]), states


def check_axes(frames: Tensor) -> None:
    """Raise ShapeError for frames that are no tensor of at least three axes."""
    if not isinstance(frames, Tensor) or frames.ndim < 3:
        given = list(frames.shape) if isinstance(frames, Tensor) else type(frames).__name__
        raise ShapeError(f"frames are {given}; a tensor [T, H, W] or [..., T, H, W] is needed.")


def _generators(generator, batch):
    """One generator per sample; the same object several times where one serves all."""
    count = math.prod(batch)
    if generator is None:
        return [Generator().manual_seed(0) for _ in range(count)]
    if isinstance(generator, Generator) or not isinstance(generator, Sequence):
        check_generator(generator)
        return [generator] * count
    for each in generator:
        check_generator(each)
    if len(generator) != count:
        raise ShapeError(
            f"{len(generator)} generators are given for a batch of {count}; give one, or one per sample."
        )
    return list(generator)


def _times(frames, t_s, before_s):
    """Times of the frames, and before them that of the last frame of the chunk before."""
    times_s = check_times(t_s, len(frames))
    if before_s is None:
        return times_s
    if float(times_s[0]) <= before_s:
        raise DomainError(
            f"the chunk starts at {float(times_s[0])!r} s, the last frame seen was at {before_s!r} s; times "
            "must go on increasing."
        )
    return torch.cat((torch.tensor([before_s], dtype=torch.float64), times_s))
