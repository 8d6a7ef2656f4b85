"""Event layers as modules: one call for all of them, and learnable sensor values as unconstrained
variables."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Generator, Tensor, nn

from codesign.checks import FLOATS, check, check_kind, check_number, check_positive
from codesign.errors import DomainError, ShapeError, shown
from codesign.events.entry import check_begun, check_times
from codesign.events.intensity import FrontEnd
from codesign.events.level_path import finer, parts
from codesign.events.sensor.model import (
    DESIGN,
    SensorModel,
    check_generator,
    check_sensor,
)
from codesign.events.sensor.simulate import simulate
from codesign.events.volumes.volume import check_bins, from_counts, from_stream
from codesign.types import EventVolume

STEP = 0.1  # a unit step of a variable changes its value by a tenth: exp(0.1) - 1 = 10.5 %
THRESHOLDS = ("theta_on", "theta_off")
# intervals, from one node of a volume to the next, from which on finer ones change nothing
PARTS_PER_BIN = 4
MOST_LEAD_S = 1e9
NEAR = 1e-6  # of the lead, by which a frame may miss its end


class PositiveValues(nn.Module):
    """Positive values by name, each start exp(0.1 v) with a variable v in ``raw`` that is 0 at
    first.

    start: value > 0 by name. Whatever the unit, a unit step of a variable is about 10 % of its
      value.
    """

    def __init__(self, start: Mapping[str, float]):
        super().__init__()
        start = {name: check_positive(value, name) for name, value in start.items()}
        zeros = [(name, nn.Parameter(torch.zeros((), dtype=torch.float64))) for name in start]
        self.raw = nn.ParameterDict(zeros)
        for name, value in start.items():  # buffers, so that what is saved is complete
            self.register_buffer(f"start_{name}", torch.tensor(value, dtype=torch.float64))

    def __getitem__(self, name: str) -> Tensor:
        """The value as it is now, a 0-dim float64 tensor. Gradient: its variable."""
        if name not in self.raw:
            raise DomainError(f"no value is called {shown(name)}; there are {', '.join(self.raw)}.")
        return getattr(self, f"start_{name}") * (STEP * self.raw[name]).exp()

    def __contains__(self, name: str) -> bool:
        return name in self.raw

    def __iter__(self) -> Iterator[str]:
        return iter(self.raw)


class EventLayer(nn.Module):
    """What all event layers share; ``events.layer(name)`` makes one.

    sensor: SensorModel that it starts from. learn: fields of the sensor to learn, kept in
      ``learnt`` as unconstrained variables; a unit step of one is about 10 % of its value.
    log_input: frames are log levels instead of linear intensity.
    """

    learnable: tuple[str, ...] = ()
    refines = False  # whether it may be asked between frames, see ``events.layers.comparators``

    def __init__(
        self,
        sensor: SensorModel | None = None,
        *,
        learn: Sequence[str] = THRESHOLDS,
        log_input: bool = False,
    ):
        super().__init__()
        self._sensor = SensorModel() if sensor is None else check_sensor(sensor)
        self.log_input = FrontEnd(log_input).log_input
        if isinstance(learn, str) or not isinstance(learn, Sequence):
            raise DomainError(
                f"learn is {learn!r}; a list of names is needed, such as {THRESHOLDS}, or ()."
            )
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

    @property
    def sensor(self) -> SensorModel:
        """The sensor that the layer was made of. One with other values of what is learnt is refused:
        those are parameters, which begin at the first."""
        return self._sensor

    @sensor.setter
    def sensor(self, sensor: SensorModel) -> None:
        check_sensor(sensor)
        for name in self.learnt:
            if getattr(sensor, name) != getattr(self._sensor, name):
                raise DomainError(
                    f"{name} is learnt here, so another sensor cannot change it; make a layer of the new sensor, or leave "
                    f"it out of learn=."
                )
        self._sensor = sensor

    def value(self, name: str) -> Tensor | float:
        """A field of the sensor as it is now: a 0-dim tensor with a gradient where it is learnt, a
        number otherwise."""
        return self.learnt[name] if name in self.learnt else getattr(self.sensor, name)

    def fitted(self) -> SensorModel:
        """The sensor with all values as they are now, for ``events.simulate``."""
        return replace(
            self.sensor, **{name: float(self.learnt[name].detach()) for name in self.learnt}
        )

    def forward(
        self, frames: Tensor, t_s: Tensor, generator: Generator | Sequence[Generator] | None = None
    ) -> Tensor:
        """Event counts of the frames.

        Args:
          frames: [..., T, H, W] linear intensity on the 0-255 scale (log levels with
            ``log_input``); axes before time are a batch. t_s: [T] seconds, strictly increasing, the
            same for the whole batch.
          generator: for threshold mismatch and noise where the sensor has them. One for all: the
            samples of a batch draw one after the other, as if each were given by itself; or a list
            with one each. None: seed 0 in every sample and call.
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

        Args:
          as for ``forward``.
          state: what the chunk before returned, which brings copies of the generators as they were
            then, and stays as it is; then T frames give T intervals. None: the first chunk. Noise is that of the whole where every sample has
            its own generator; those of a batch that share one draw in the order of the calls.
        Returns: counts [..., T-1, 2, H, W] ([..., T, 2, H, W] with a state); state to carry on,
          with its graph.
        Gradient: that of the whole, unless all pixels share two thresholds that differ by more than
          a quarter: "memory", "srm" and "physical" (but through a long dead time) then follow pairs
          of pixels, which begin anew with every chunk.
        """
        check_axes(frames)
        check_begun(state, generator)
        frames = frames.movedim(-3, 0)
        check(frames, "T>=2 ..." if state is None else "T ...", "frames", FLOATS)
        counts, state = self._count(frames, t_s, state, _generators(generator, frames.shape[1:-2]))
        return counts.movedim((0, 1), (-4, -3)), state

    def finely(
        self,
        frames: Tensor,
        t_s: Tensor,
        longest_s: float,
        generator: Generator | Sequence[Generator] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Event counts in intervals no longer than asked for: when events come, and not only
        between which frames.

        A layer that can (``refines``) is asked on the way of the log level between frames
        (``events.finer``); another one has the events of an interval spread evenly over it.

        Args:
          as for ``forward``.
          longest_s: length of the longest interval, seconds, > 0.
        Returns: counts [..., T'-1, 2, H, W], times [T'] float64, those of the frames among them.
          Frames that are dense enough are taken as they are: then these are the counts of
          ``forward``.
        Gradient: as ``forward``, also for when events come.
        Raises: as ``forward``; DomainError for a length that is not positive.
        """
        check_axes(frames)
        if self.refines:
            fine, times_s = finer(frames.movedim(-3, 0), t_s, longest_s, log_input=self.log_input)
            return self(fine.movedim(0, -3), times_s, generator), times_s
        counts = self(frames, t_s, generator)
        given_s = check_times(t_s, frames.shape[-3])
        interval, _, times_s = parts(given_s, longest_s, counts.select(-4, 0).numel())
        if len(interval) == counts.shape[-4]:
            return counts, times_s
        alike = torch.bincount(interval)[interval].to(counts).reshape(-1, 1, 1, 1)
        return counts.index_select(-4, interval.to(counts.device)) / alike, times_s

    def volume(
        self,
        frames: Tensor,
        t_s: Tensor,
        bins: int,
        generator: Generator | Sequence[Generator] | None = None,
    ) -> EventVolume:
        """Events of the frames in time bins, each near its own time however few the frames are
        (``finely``).

        Args:
          as for ``forward``.
          bins: number of bins.
        Returns: EventVolume of counts [B, 2, bins, H, W], see ``events.from_counts``; several batch
          axes come as one.
        Gradient: as ``forward``, also for when events come.
        """
        return self._volume(frames, t_s, bins, generator, 0.0)

    def _volume(self, frames, t_s, bins, generator, lead_s):
        """``volume`` of what comes after a lead."""
        check_bins(bins)
        check_axes(frames)
        given_s = check_times(t_s, frames.shape[-3])
        start_s = float(given_s[0]) + lead_s
        longest_s = (
            float(given_s[-1] - start_s) / (bins - 1) / PARTS_PER_BIN if bins > 1 else math.inf
        )
        if lead_s:
            off_s = (given_s[:-1] - start_s).abs()
            if len(given_s) < 2 or float(off_s.min()) > NEAR * max(
                lead_s, float(given_s.diff().min())
            ):
                raise DomainError(
                    f"settled: no frame stands {lead_s:g} s after the first; give frames at "
                    f"{(given_s - given_s[0]).tolist()} s a lead that ends with one, before the last."
                )
        counts, times_s = self.finely(frames, t_s, longest_s, generator)
        first = int((times_s - start_s).abs().argmin())
        return from_counts(counts.movedim((-4, -3), (0, 1))[first:], times_s[first:], bins)

    def _count(self, frames, t_s, state, generators):
        """Counts [T-1, 2, ..., H, W] of frames [T, ..., H, W], and the state to carry on."""
        raise NotImplementedError


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


class Settled(nn.Module):
    """An event layer whose events in the first ``lead_s`` are not read; frames begin as much before
    the window.

    A few time constants of the sensor's bandwidth are enough, and as much motion as makes an event
    or two.

    Args:
      layer: of ``events.layer``.
      lead_s: length of a whole number of intervals between frames, seconds, >= 0.

    >>> import torch
    >>> from codesign import events
    >>> settled = events.Settled(events.layer("memory"), lead_s=0.01)
    >>> frames = 255 * torch.rand(1, 5, 8, 8, generator=torch.Generator().manual_seed(0))
    >>> float(settled.volume(frames, torch.linspace(0, 0.04, 5), 3).collected_s.sum().round(decimals=3))
    0.03
    """

    def __init__(self, layer: EventLayer, lead_s: float) -> None:
        super().__init__()
        check_kind(layer, EventLayer, "the layer", "events.layer makes one")
        self.layer = layer
        self.lead_s = check_lead(lead_s)

    def volume(
        self, frames: Tensor, t_s: Tensor, bins: int, generator: Generator | None = None
    ) -> EventVolume:
        """Events after the lead in time bins, [B, 2, bins, H, W]. Args and gradient: as
        ``EventLayer.volume``.
        Raises: DomainError when no frame stands at the end of the lead."""
        return self.layer._volume(frames, t_s, bins, generator, self.lead_s)


def check_lead(lead_s: float) -> float:
    """Seconds. Raises: DomainError for others than finite ones of at least 0."""
    return check_number(lead_s, "lead_s", 0.0, below=MOST_LEAD_S)


class HardSensor(nn.Module):
    """``events.simulate`` and ``events.from_stream`` called like an event layer.

    Args:
      sensor: SensorModel.
      bins: time bins of the volume.
      lead_s: events before it are not read (``Settled``).
    """

    def __init__(self, sensor: SensorModel, bins: int, lead_s: float = 0.0):
        super().__init__()
        check_bins(bins)
        self.sensor = check_sensor(sensor)
        self.bins = bins
        self.lead_s = check_lead(lead_s)

    @torch.no_grad()
    def forward(
        self,
        frames: Tensor,
        t_s: Tensor,
        generator: Generator | None = None,
    ) -> EventVolume:
        """Events of frames [N, T, H, W] at t_s [T] in time bins, [N, 2, bins, H, W].

        generator: one for all samples, which stand above one another as one tall sensor; None: seed
          0.
        Raises: ShapeError for other shapes; DomainError as ``simulate``.
        """
        check(frames, "N T H W", "frames", FLOATS)
        count, times, height, width = frames.shape
        tall = frames.movedim(1, 0).reshape(times, count * height, width)
        stream = simulate(tall, t_s, self.sensor, generator)
        start_s, end_s = check_times(t_s, times)[[0, -1]].tolist()
        start_us, end_us = (round(time_s * 1e6) for time_s in (start_s + self.lead_s, end_s))
        volume = from_stream(stream, start_us, end_us, self.bins)
        counts = (
            volume.counts.reshape(2, self.bins, count, height, width)
            .permute(2, 0, 1, 3, 4)
            .contiguous()
        )
        return EventVolume(counts, volume.centroid_s, volume.collected_s)
