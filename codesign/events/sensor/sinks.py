"""Where the sensor's kernel puts its events: a list of sortable 64-bit keys, or dense counts per frame
interval.

A sink gives ``tally`` (what it carries through the events of one interval of a pixel), ``take`` (one event),
``close`` (the end of the interval) and ``arrays`` (what to evaluate).
"""

from dataclasses import dataclass

import numpy as np
import torch


class EventKeys:
    """Events as integers that sort by (t, y, x, p): microseconds since an origin, row, column, polarity, from
    high to low bits."""

    def __init__(self, dr, arr, start_s, end_s, layout, capacity):
        """Args: start_s, end_s: lists, ends of every interval, seconds. layout: KeyLayout. capacity: room for
        so many events; ``found`` tells how many there were."""
        start_us, end_us = ([round(time_s * 1e6) for time_s in times] for times in (start_s, end_s))
        length_us = [(end - start) * 1e6 for start, end in zip(start_s, end_s, strict=True)]
        # single precision resolves a microsecond of intervals up to a second to better than a tenth
        self._Time = arr.Float if max(length_us) <= 1e6 else dr.float64_array_t(arr.Float)
        self._Key = dr.uint64_array_t(arr.Float)
        self._length_us = self._Time(np.array(length_us))
        self._fraction_us = self._Time(
            np.array([time_s * 1e6 - us for time_s, us in zip(start_s, start_us, strict=True)])
        )
        self._span_us = self._Time(
            np.array([end - start for start, end in zip(start_us, end_us, strict=True)], np.float64)
        )
        self._start = self._Key(
            np.array([us - layout.origin_us for us in start_us], np.uint64) << np.uint64(layout.pixel_bits)
        )
        self._pixel = self._Key(layout.pixels())
        self._bits = layout.pixel_bits
        self.capacity = capacity
        self._keys = dr.empty(self._Key, capacity)
        self._count = dr.zeros(arr.UInt32, 1)
        dr.eval(
            self._length_us,
            self._fraction_us,
            self._span_us,
            self._start,
            self._pixel,
            self._keys,
            self._count,
        )

    def tally(self, dr, arr):
        return arr.UInt32(0)

    def take(self, dr, arr, index, when, on, kept, tally):
        length, fraction, span, start = (
            dr.gather(type(table), table, index)
            for table in (self._length_us, self._fraction_us, self._span_us, self._start)
        )
        # after the start, so that rounding moves no event to the interval before
        since_us = dr.clip(dr.round(self._Time(when) * length + fraction), dr.minimum(span, 1), span)
        key = (
            (start + (self._Key(since_us) << self._bits))
            | self._pixel
            | self._Key(dr.select(on, arr.UInt32(1), 0))
        )
        slot = dr.scatter_inc(self._count, arr.UInt32(0), active=kept)
        dr.scatter(self._keys, key, slot, active=kept & (slot < self.capacity))
        return tally

    def close(self, dr, arr, index, lane, tally):
        pass

    def arrays(self):
        return self._keys, self._count

    @property
    def found(self):
        """Number of events, also those that had no room."""
        return int(self._count[0])

    def sorted(self):
        """[N] int64 keys in order."""
        return np.sort(self._keys.numpy()[: self.found]).view(np.int64)


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
        """[H W] uint64 low bits of every pixel, OFF."""
        pixel = np.arange(self.height_px * self.width_px, dtype=np.uint64)
        return ((pixel // self.width_px) << np.uint64(self.x_bits + 1)) | (
            (pixel % self.width_px) << np.uint64(1)
        )

    def columns(self, keys):
        """t_us, x, y, p of int64 keys: int64 [N] each."""
        x = (keys >> 1) & ((1 << self.x_bits) - 1)
        y = (keys >> (self.x_bits + 1)) & ((1 << (self.pixel_bits - self.x_bits - 1)) - 1)
        t_us = keys >> self.pixel_bits
        t_us += self.origin_us
        p = keys & 1
        p *= 2
        p -= 1
        return tuple(torch.from_numpy(column) for column in (t_us, x, y, p))


class DenseCounts:
    """Counts [T, 2, ...] per interval, ON first."""

    def __init__(self, dr, arr, intervals, pixels):
        self._counts = dr.empty(arr.Float, intervals * 2 * pixels)
        self._pixels = dr.opaque(arr.UInt32, pixels)

    def tally(self, dr, arr):
        return arr.Float(0), arr.Float(0)

    def take(self, dr, arr, index, when, on, kept, tally):
        return tally[0] + dr.select(kept & on, arr.Float(1), 0), tally[1] + dr.select(
            kept & ~on, arr.Float(1), 0
        )

    def close(self, dr, arr, index, lane, tally):
        place = 2 * index * self._pixels + lane
        dr.scatter(self._counts, tally[0], place, mode=dr.ReduceMode.NoConflicts)
        dr.scatter(self._counts, tally[1], place + self._pixels, mode=dr.ReduceMode.NoConflicts)

    def arrays(self):
        return (self._counts,)

    def tensor(self, shape):
        """The counts as a tensor; call once, it takes the memory over."""
        return self._counts.torch().reshape(shape)
