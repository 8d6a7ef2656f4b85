"""Flow along a stream of events: windows by time or by number of events, each with its flow and
confidence, as the chunks of a camera come in."""

import inspect
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.checks import check, check_number, check_whole
from codesign.errors import DomainError, ShapeError, shown
from codesign.events.formats.arrival import BACKWARDS, OFF_SENSOR
from codesign.events.stream import check_stream
from codesign.events.volumes.volume import check_bins, check_interval, of_rows
from codesign.flow.checks import check_field, check_size
from codesign.flow.sources.packet import EMPTY
from codesign.flow.warp import pixel_grid, read_at
from codesign.types import EventStream, FlowField

Chunk = EventStream | tuple[Any, Any, Any, Any]
SKIPPABLE = (EMPTY, BACKWARDS, OFF_SENSOR)
MOST_EMPTY = 10_000  # windows without events that one chunk may bring


@dataclass(frozen=True)
class TrackedWindow:
    """One window of a stream and its flow.

    t0_us, t1_us: from its start, included, to its end, which belongs to the next window. events:
      how many it has.
    field: FlowField [1, ...], px from t0 to t1. warm: the estimator was given the flow of the
      window before.
    processor_s: processor time that volume and estimate took, of all threads.
    """

    t0_us: int
    t1_us: int
    events: int
    field: FlowField
    warm: bool
    processor_s: float


class Tracker:
    """Flow of one window after the other.

    Args:
      estimate: estimator, EventVolume -> FlowField: flow.estimate_lk, a network, or a function of
        your own.
      window_s: length of the windows in seconds, whole microseconds; or events: number of events of
        a window, which then lasts until the first event of the next.
      bins: of the volumes; the network's own, else 8, when None.
      size_px: (height, width) of the sensor, for events as arrays; an EventStream says it itself.
      warm_start: hand the flow of the window before, scaled to the new duration and carried along
        itself, to estimators that take ``start_px``; for others it changes nothing.
      skip: faults that are left out and counted in ``left_out`` instead of refused (events) or
        handed out with flow 0, confidence 0 and valid False (windows): names of SKIPPABLE.
    windows, events: how many came out so far. processor_s: processor time spent, event_s: time of
      the stream that was covered, seconds. left_out: {fault: number}.
    Every event is in one window, whatever the chunks; memory is that of one chunk and one window.
    Raises: DomainError, ShapeError.

    >>> from codesign import events, flow
    >>> y, x = torch.meshgrid(torch.arange(32.0), torch.arange(48.0), indexing="ij")
    >>> times = [0.001 * k for k in range(21)]  # a texture that moves right by 200 px/s
    >>> frames = torch.stack([130 + 60 * torch.sin((x - 200 * t) / 3) + 60 * torch.sin((y + x) / 5) for t in times])
    >>> stream = events.simulate(frames, times, events.SensorModel())
    >>> tracker = flow.Tracker(flow.estimate_lk, window_s=0.01)
    >>> found = [round(float(window.field.flow_px[0, 0].mean())) for window in tracker.track([stream])]
    >>> found, tracker.windows, tracker.events == len(stream), tracker.real_time_factor > 0
    ([2, 2], 2, True, True)
    """

    def __init__(
        self,
        estimate: Callable[..., FlowField],
        window_s: float | None = None,
        events: int | None = None,
        bins: int | None = None,
        size_px: tuple[int, int] | None = None,
        warm_start: bool = True,
        skip: tuple[str, ...] = (),
    ) -> None:
        if not callable(estimate):
            raise DomainError(
                f"the estimator is {shown(estimate)}; a function of an EventVolume is needed."
            )
        if (window_s is None) == (events is None):
            raise DomainError(
                f"window_s is {shown(window_s)} and events {shown(events)}; windows are cut by time or by number of "
                "events: give one of both."
            )
        if not isinstance(skip, tuple) or not set(skip) <= set(SKIPPABLE):
            raise DomainError(
                f"skip is {shown(skip)}; a tuple of {', '.join(SKIPPABLE)} is possible."
            )
        self.estimate = estimate
        self.window_us = (
            None if window_s is None else round(1e6 * check_number(window_s, "window_s", 1e-6))
        )
        self.number = None if events is None else check_whole(events, "events", 1)
        config = getattr(estimate, "config", None)
        self.bins: int = (
            (config.get("bins", 8) if isinstance(config, dict) else 8) if bins is None else bins
        )
        check_bins(self.bins)
        self.size_px = None if size_px is None else check_size(size_px, "size_px")
        self.warm_start = bool(warm_start) and _takes_start(estimate)
        self.skip = skip
        self.left_out = dict.fromkeys(skip, 0)
        self.windows = 0
        self.events = 0
        self.processor_s = 0.0
        self.event_s = 0.0
        self._forget()

    @property
    def real_time_factor(self) -> float:
        """Processor time over the time of the stream: below 1 where one core keeps up with the
        camera."""
        if not self.event_s:
            raise DomainError(
                "no window is done, so there is no real-time factor; give events first."
            )
        return self.processor_s / self.event_s

    def track(self, chunks: Iterable[Chunk]) -> Iterator[TrackedWindow]:
        """The windows of all chunks, as soon as each is complete, the last one included."""
        for chunk in chunks:
            yield from self.add(chunk)
        yield from self.finish()

    def add(self, chunk: Chunk) -> list[TrackedWindow]:
        """Take the next events in and return the windows that they complete.

        Args:
          chunk: EventStream, or arrays (t_us, x, y, p) of whole numbers, p +1 and -1 or 1 and 0,
            with rising times; of any length, 0 included.
        Raises: DomainError for what is no such stream, for events before those of the chunks before
          or off the sensor; ShapeError for another sensor. What it raises, or the estimator, leaves
          the tracker as it was before the chunk.
        """
        with self._whole():
            rows = self._checked(chunk)
            if not rows.shape[1]:
                return []
            self._rows.append(rows)
            self._last_us = int(rows[0, -1])
            if self._start_us is None:
                self._start_us = int(rows[0, 0])
            if self.window_us is not None and self._last_us < self._start_us + self.window_us:
                return []
            if self.number is not None and sum(rows.shape[1] for rows in self._rows) <= self.number:
                return []
            return self._cut(self._start_us, last=False)

    def finish(self) -> list[TrackedWindow]:
        """Return the last window, which ends at the last event (a microsecond later where that is
        its start), and forget stream and clock: what is added next is another stream."""
        with self._whole():
            found = [] if self._start_us is None else self._cut(self._start_us, last=True)
        self._forget()
        return found

    @contextmanager
    def _whole(self):
        """Within it, what fails leaves the tracker as it was."""
        before = {**vars(self), "left_out": dict(self.left_out), "_rows": list(self._rows)}
        try:
            yield
        except BaseException:
            vars(self).update(before)
            raise

    def _forget(self):
        self._rows: list[Tensor] = []  # of [4, N]: t_us, x, y, p
        self._last_us: int | None = None
        self._start_us: int | None = None
        self._before: TrackedWindow | None = None
        self._off: int | None = None

    def _checked(self, chunk):
        """The chunk as rows [4, N] of this sensor, no event before the last one of the chunks
        before."""
        if isinstance(chunk, EventStream):
            stream = check_stream(chunk, slice(0), ordered=False)
            size_px = stream.height_px, stream.width_px
            self.size_px = self.size_px or size_px
            if size_px != self.size_px:
                raise ShapeError(
                    f"the stream is of a sensor of {stream.width_px} x {stream.height_px} px, the tracker of "
                    f"{self.size_px[1]} x {self.size_px[0]}; take one tracker for each."
                )
            rows = torch.stack([stream.t_us, stream.x, stream.y, stream.p])
        else:
            rows = _rows_of(chunk)
            self._off = _off(rows[3], self._off)
            rows[3] = torch.where(rows[3] == 0, -1, rows[3])
        if self.size_px is None:
            raise DomainError(
                "events as arrays do not say how large the sensor is; give size_px to the tracker."
            )
        height, width = self.size_px
        _, x, y, _ = rows
        if not (_within(x, width) and _within(y, height)):
            outside = (x < 0) | (x >= width) | (y < 0) | (y >= height)
            said = f"lies outside the sensor of {width} x {height} px"
            rows = self._without(OFF_SENSOR, outside, rows, said)
        t_us = rows[0]
        before = t_us[:1] if self._last_us is None else t_us.new_tensor([self._last_us])
        if bool((t_us < torch.cat([before, t_us[:-1]])[: len(t_us)]).any()):
            latest = torch.cat([before, t_us]).cummax(0).values[1:]
            rows = self._without(BACKWARDS, t_us < latest, rows, "lies before {} us", latest)
        check_stream(EventStream(*rows, height, width))
        return rows

    def _without(self, fault, bad, rows, reason, latest=None):
        if not bool(bad.any()):
            return rows
        if fault not in self.skip:
            at = int(bad.nonzero()[0])
            t_us, x, y, _ = rows[:, at].tolist()
            reason = reason if latest is None else reason.format(int(latest[at]))
            raise DomainError(
                f"event {at} of the chunk, at {t_us} us and ({x}, {y}), {reason}; order the stream, or leave such events "
                f"out with skip=({fault!r},)."
            )
        self.left_out[fault] += int(bad.sum())
        return rows[:, ~bad]

    def _cut(self, start_us: int, last: bool) -> list[TrackedWindow]:
        """The complete windows of the waiting events, and with ``last`` the rest of them; what is
        not complete waits on."""
        rows = torch.cat(self._rows, 1)
        t_us = rows[0]
        found = []
        at = 0
        while at < len(t_us):
            if self.window_us is not None:
                found += self._idle(start_us, int(t_us[at]), rows[:, :0])
                start_us += (int(t_us[at]) - start_us) // self.window_us * self.window_us
            to = self._end(t_us, at, start_us)
            if to == len(t_us) and not last:  # nothing has come that lies behind this window
                break
            end_us = int(t_us[-1]) if to == len(t_us) else int(t_us[to])
            if self.window_us is not None and to < len(t_us):
                end_us = start_us + self.window_us
            found.append(self._window(rows[:, at:to], start_us, max(end_us, start_us + 1)))
            start_us = end_us
            at = to
        self._rows = [rows[:, at:].clone()]
        self._start_us = start_us
        return found

    def _end(self, t_us, at, start_us):
        """Number of the first event behind the window that begins with event ``at``; all of them
        where there is none."""
        if self.number is not None:
            return min(at + self.number, len(t_us))
        return int(torch.searchsorted(t_us, start_us + (self.window_us or 0)))

    def _idle(self, start_us, next_us, nothing) -> list[TrackedWindow]:
        """The windows without events before the next event, as they are to be handed out."""
        length_us = self.window_us or 1
        count = (next_us - start_us) // length_us
        if count and EMPTY in self.skip:
            self.left_out[EMPTY] += count
            self._before = None
            return []
        if count > MOST_EMPTY:
            raise DomainError(
                f"{count} windows of {length_us} us in a row hold no event, the next is at {next_us} us; did the clock "
                f"jump? Leave such windows out with skip=({EMPTY!r},), or take longer ones."
            )
        starts = range(start_us, start_us + count * length_us, length_us)
        return [self._window(nothing, t0_us, t0_us + length_us) for t0_us in starts]

    @torch.no_grad()
    def _window(self, rows, t0_us, t1_us):
        began = time.process_time()
        before = self._before if self.warm_start else None
        count = rows.shape[1]
        warm = before is not None and before.events > 0 and count > 0
        height, width = self.size_px or (0, 0)
        if count:
            check_interval((height, width), t1_us - t0_us, self.bins)
            volume = of_rows(rows, (height, width), t0_us, t1_us - t0_us, self.bins)
            start = {"start_px": _carried_on(before, t1_us - t0_us)} if warm else {}
            field = check_field(self.estimate(volume, **start), "what the estimator returned")
            if tuple(field.flow_px.shape) != (1, 2, height, width):
                raise ShapeError(
                    f"the estimator returned a flow {list(field.flow_px.shape)} for a volume "
                    f"{list(volume.counts.shape)}; {[1, 2, height, width]} is needed."
                )
        else:  # all of one number in memory
            zero = torch.zeros((), device=rows.device).expand(1, 2, height, width)
            field = FlowField(zero, zero[:, 0].bool(), (t1_us - t0_us) * 1e-6, zero[:, 0])
        spent_s = time.process_time() - began
        self._before = TrackedWindow(t0_us, t1_us, count, field, warm, spent_s)
        self.windows += 1
        self.events += count
        self.processor_s += spent_s
        self.event_s += (t1_us - t0_us) * 1e-6
        return self._before


def _within(column, size):
    """Whether all of them lie on an axis of so many pixels."""
    return not len(column) or (int(column.min()) >= 0 and int(column.max()) < size)


def _takes_start(estimate):
    """Whether an estimator has a parameter ``start_px``."""
    estimate = getattr(estimate, "_orig_mod", estimate)  # of torch.compile
    function = estimate.forward if isinstance(estimate, torch.nn.Module) else estimate
    try:
        return "start_px" in inspect.signature(function).parameters
    except (TypeError, ValueError):  # built-in functions do not say
        return False


def _rows_of(chunk):
    """t_us, x, y, p [4, N] int64 of arrays."""
    if not isinstance(chunk, (tuple, list)) or len(chunk) != 4:
        raise DomainError(
            f"the chunk is {shown(chunk)}; an EventStream or arrays (t_us, x, y, p) are needed."
        )
    columns = []
    for name, given in zip(("t_us", "x", "y", "p"), chunk, strict=True):
        if isinstance(given, Tensor):
            given = check(given, "...>=0", name, (given.dtype,)).detach().cpu().numpy()
        values = np.asarray(given)
        whole = values.dtype.kind in "iub" or not values.size
        if values.dtype.kind == "f":
            whole = bool(((np.abs(values) < 2**53) & (values % 1 == 0)).all())
        if values.ndim != 1 or not whole:
            raise DomainError(f"{name} is {shown(values)}; a list [N] of whole numbers is needed.")
        columns.append(torch.from_numpy(values.astype(np.int64)))
    if len({len(values) for values in columns}) > 1:
        raise ShapeError(
            f"t_us, x, y, p have {[len(values) for values in columns]} entries; equal lists are needed."
        )
    return torch.stack(columns)


def _off(polarity, before):
    """By which number a stream tells events OFF, 0 or -1; None where none has come. Raises:
    DomainError where both come."""
    told = {number for number in (0, -1) if number == before or bool((polarity == number).any())}
    if len(told) > 1:
        raise DomainError(
            "polarities hold 0 and -1, so events OFF cannot be told from events without one; give +1 and -1, or 1 and 0."
        )
    return told.pop() if told else None


def _carried_on(before, duration_us):
    """Flow [1, 2, H, W] of the window before, at the same speed over the new duration, on the
    pixels it has led to: read where each pixel came from."""
    flow = before.field.flow_px
    came_from = pixel_grid(*flow.shape[2:], flow) - flow
    return read_at(flow, came_from) * (duration_us / (before.t1_us - before.t0_us))
