"""Order, joining and counting of event streams."""

import torch

from codesign.events import to_counts
from codesign.events.stream import ordered


def tensors(*lists):
    return [torch.tensor(values) for values in lists]


def test_sorting_against_python():
    generator = torch.Generator().manual_seed(0)
    t, x, y = (torch.randint(0, 6, (500,), generator=generator) for _ in range(3))
    p = torch.randint(0, 2, (500,), generator=generator) * 2 - 1
    stream = ordered(t + 2**40, x, y, p, 6, 6)
    found = list(
        zip(stream.t_us.tolist(), stream.y.tolist(), stream.x.tolist(), stream.p.tolist(), strict=True)
    )
    assert found == sorted(zip((t + 2**40).tolist(), y.tolist(), x.tolist(), p.tolist(), strict=True))


def test_an_event_at_a_frame_time_belongs_to_the_interval_that_ends_there():
    t_us = torch.tensor([-1, 0, 1, 1000, 1001, 2000, 2001])
    zero = torch.zeros(7, dtype=torch.int64)
    counts = to_counts(ordered(t_us, zero, zero, zero - 1, 1, 1), [0, 0.001, 0.002])
    assert counts[:, :, 0, 0].tolist() == [[0, 3], [0, 2]]


def test_counts_land_in_their_pixel():
    t_us, x, y, p = tensors([5, 6, 7, 7], [0, 2, 2, 2], [1, 0, 0, 0], [1, -1, 1, 1])
    counts = to_counts(ordered(t_us, x, y, p, 2, 3), [0, 1e-5])
    assert counts.tolist() == [[[[0, 0, 2], [1, 0, 0]], [[0, 0, 1], [0, 0, 0]]]]
