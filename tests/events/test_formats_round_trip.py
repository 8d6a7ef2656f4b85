"""Round trips of 200,000 random events, exact in every format that can hold them."""

import pytest
import torch

from codesign.events import read, write
from codesign.events.stream import ordered
from tests.event_streams import random_stream, same

EPOCH_US = 1_643_243_628_737_093  # a clock that counts from 1970


def told(name):
    """What the reader must be told of the sensor: text has no place for its size."""
    return {"height_px": 480, "width_px": 640} if name.lower().endswith("csv") else {}


@pytest.mark.parametrize(
    ("name", "first_us", "span_us", "options"),
    [
        ("e.h5", EPOCH_US, 10_000_000, {}),
        ("e.h5", EPOCH_US, 2**32, {}),
        ("e.aedat4", EPOCH_US, 10_000_000, {}),
        ("e.aedat4", 2**32 - 1000, 2**34, {}),
        ("e.raw", EPOCH_US, 10_000_000, {"evt": 3, "t0_us": EPOCH_US - 5}),
        ("e.raw", 2**32 - 1000, 2**34, {"evt": 3}),
        ("e.raw", EPOCH_US, 2**34, {"evt": 2, "t0_us": EPOCH_US}),
        ("e.raw", 2**32 - 1000, 2**33, {"evt": 2}),
        ("e.dat", EPOCH_US, 2**32, {"t0_us": EPOCH_US}),
        ("e.dat", 5000, 2**31, {}),
        ("e.npz", 5000, 2**50, {}),
        ("e.csv", 5000, 2**50, {}),
    ],
)
def test_many_events_come_back_exactly(tmp_path, name, first_us, span_us, options):
    stream = random_stream(200_000, 480, 640, span_us - 1, first_us)
    write(tmp_path / name, stream, **options)
    back = read(tmp_path / name, **told(name))
    assert same(stream, back)
    assert (back.height_px, back.width_px) == (480, 640)


@pytest.mark.parametrize(
    ("name", "evt"),
    [
        ("e.h5", None),
        ("e.aedat4", None),
        ("e.raw", 3),
        ("e.raw", 2),
        ("e.dat", None),
        ("e.npz", None),
        ("e.CSV", None),
    ],
)
@pytest.mark.parametrize("count", [0, 1])
def test_no_event_and_one_event_come_back_with_the_sensor_size(tmp_path, name, evt, count):
    t_us, x, y, p = (torch.tensor([value] * count, dtype=torch.int64) for value in (2**32 - 1, 3, 5, -1))
    stream = ordered(t_us, x, y, p, 480, 640)
    write(tmp_path / name, stream, evt=evt)
    back = read(tmp_path / name, **told(name))
    assert [getattr(back, field).tolist() for field in ("t_us", "x", "y", "p")] == [
        [value] * count for value in (2**32 - 1, 3, 5, -1)
    ]
    assert (back.height_px, back.width_px) == (480, 640)
