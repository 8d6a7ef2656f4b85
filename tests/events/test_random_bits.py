"""Random numbers of the kernels: their distribution, and independence between neighbours."""

import math

import pytest
import torch

from codesign import backend
from codesign.events.sensor.crossing import exponential, hashed, normal_pair, uniform

COUNT = 1 << 20


def test_numbers_follow_their_laws_and_neighbours_are_uncorrelated():
    import drjit as dr

    arr = backend.arrays("cpu", torch.float32)
    bits = hashed(dr, dr.arange(arr.UInt32, COUNT))
    drawn = (
        uniform(arr, bits),
        exponential(dr, arr, bits),
        *normal_pair(dr, arr, dr.arange(arr.UInt32, COUNT)),
    )
    even, waiting, first, second = (value.torch().double() for value in drawn)
    error = 4 / math.sqrt(COUNT)
    histogram = torch.histc(even, bins=1000, min=0, max=1)
    chi_squared = float(((histogram - COUNT / 1000) ** 2 / (COUNT / 1000)).sum())
    assert abs(chi_squared - 999) < 4 * math.sqrt(2 * 999)
    assert 0 < float(even.min()) < float(even.max()) < 1
    assert float(waiting.mean()) == pytest.approx(1, abs=error)
    assert float(waiting.var()) == pytest.approx(1, abs=error * math.sqrt(8))
    for normal in (first, second):
        moments = [float((normal**power).mean()) for power in (1, 2, 4)]
        assert moments[0] == pytest.approx(0, abs=error)
        assert moments[1] == pytest.approx(1, abs=error * math.sqrt(2))
        assert moments[2] == pytest.approx(3, abs=error * math.sqrt(96))
    flat = even - even.mean()
    for lag in (1, 2, 16, 346):
        assert abs(float((flat[lag:] * flat[:-lag]).mean() / flat.var())) < error
    assert abs(float((first * second).mean())) < error
