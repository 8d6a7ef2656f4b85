"""Event streams that tests make and compare."""

import torch

from codesign.events.stream import ordered

FIELDS = ("t_us", "x", "y", "p")


def rows(stream):
    """Events as tuples, in order."""
    return [tuple(row) for row in torch.stack([getattr(stream, name) for name in FIELDS], 1).tolist()]


def same(first, second):
    """Whether two streams hold the same events."""
    return all(torch.equal(getattr(first, name), getattr(second, name)) for name in FIELDS)


def stream_of(*events, height_px=480, width_px=640):
    """Stream of (t_us, x, y, p)."""
    return ordered(*torch.tensor(events).unbind(1), height_px, width_px)


def random_stream(count, height_px, width_px, last_us, first_us=0, seed=0):
    """Events anywhere, with many equal times, from first_us to first_us + last_us."""
    generator = torch.Generator().manual_seed(seed)
    sizes = (last_us + 1, width_px, height_px, 2)
    t_us, x, y, p = (torch.randint(0, size, (count,), generator=generator) for size in sizes)
    return ordered(first_us + t_us, x, y, 2 * p - 1, height_px, width_px)
