"""The loop over time of every pixel of an event layer, in drjit: frames in, hard counts out."""

import torch

from codesign import backend


class Loop:
    """Frames, thresholds and the loop over time, in chunks."""

    def __init__(self, frames, theta_on, theta_off):
        import drjit as dr

        self.dr = dr
        self.arr = backend.arrays(frames.device.type, frames.dtype)
        self.frames = frames
        self.width = frames[0].numel()
        self.lane = dr.arange(self.arr.UInt32, self.width)
        self.pixels = dr.opaque(self.arr.UInt32, self.width)
        shape = frames.shape[1:]
        self.theta_on, self.theta_off = (
            self.load(theta if theta.numel() == 1 else theta.expand(shape)) for theta in (theta_on, theta_off)
        )
        self.values = self.load(frames)

    def load(self, tensor):
        return backend.load(self.arr.Float, tensor)

    def tensor(self, value, shape):
        return value.torch().reshape(shape).clone()

    def fresh(self, count):
        """Memory to be filled by kernels. It is drjit's, which hands the same pages out again and again: new
        pages from the system cost more than the kernel."""
        target = self.dr.empty(self.arr.Float, count)
        self.dr.eval(target)
        return target

    def fire(self, target, index, difference):
        """Write the counts of a step; ``difference``: level less memorised level. Returns what the memorised
        level moves by."""
        dr = self.dr
        rose = difference > 0
        theta = dr.select(rose, self.theta_on, self.theta_off)
        total = exact_floor(dr, dr.abs(difference), theta)
        on = dr.select(rose, total, 0)
        off = dr.select(rose, 0, total)
        place = 2 * index * self.pixels + self.lane
        dr.scatter(target, on, place, mode=dr.ReduceMode.NoConflicts)
        dr.scatter(target, off, place + self.pixels, mode=dr.ReduceMode.NoConflicts)
        return (on - off) * theta

    def beyond(self, level, centre):
        """How far the level lies above and below the play, >= 0 each."""
        half = (self.theta_on + self.theta_off) * 0.25
        return self.dr.maximum(level - centre - half, 0), self.dr.maximum(centre - half - level, 0)

    def follow(self, level, centre):
        """Centre of the play behind a step."""
        rise, fall = self.beyond(level, centre)
        return centre + (rise - fall)

    def result(self, target, after, bad):
        """Counts [T, 2, ...], state [rows, ...], and whether a value may not enter, as tensors and a bool."""
        shape = self.frames.shape[1:]
        bad = bool(self.dr.any(bad)[0])
        self.dr.sync_thread()
        counts = target.torch().reshape(len(self.frames), 2, *shape)
        return counts, torch.stack([self.tensor(value, shape) for value in after]), bad

    def __call__(self, step, carried, target):
        """Carry values through step(index, value, *carried) for every frame; ``target`` is what the steps
        write to."""
        dr = self.dr
        arr = self.arr
        size = backend.frames_per_kernel(self.width)
        with dr.suspend_grad():
            for first in range(0, len(self.frames), size):
                begin = dr.opaque(arr.UInt32, first, self.width)
                end = dr.opaque(arr.UInt32, min(first + size, len(self.frames)))

                def body(index, *carried):
                    value = dr.gather(arr.Float, self.values, index * self.pixels + self.lane)
                    return index + 1, *step(index, value, *carried)

                _, *carried = dr.while_loop(
                    (begin, *carried), lambda index, *_, end=end: index < end, body, mode="symbolic"
                )
                dr.eval(carried, target)
        return carried


def exact_floor(dr, value, divisor):
    """floor(value/divisor) of the two floats as they are, for value >= 0: a rounded quotient may reach the
    next whole number too early."""
    whole = dr.floor(value / divisor)
    rest = dr.fma(-whole, divisor, value)
    return dr.select(rest < 0, whole - 1, dr.select(rest >= divisor, whole + 1, whole))
