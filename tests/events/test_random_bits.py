"""Random numbers of the kernels: their distribution, and independence between neighbours."""

import math

import pytest
import torch

from codesign import backend
from codesign.events.sensor.crossing import exponential, hashed, normal_pair, uniform


@pytest.fixture(scope="module")
def drawn():
    import drjit as dr

    arr = backend.arrays("cpu", torch.float32)
    bits = hashed(dr, dr.arange(arr.UInt32, 1 << 20))
    return [
        value.torch().double()
        for value in (
            uniform(arr, bits),
            exponential(dr, arr, bits),
            *normal_pair(dr, arr, dr.arange(arr.UInt32, 1 << 20)),
        )
    ]


def test_uniform_numbers_fill_the_unit_interval(drawn):
    count = len(drawn[0])
    histogram = torch.histc(drawn[0], bins=1000, min=0, max=1)
    chi_squared = float(((histogram - count / 1000) ** 2 / (count / 1000)).sum())
    assert abs(chi_squared - 999) < 4 * math.sqrt(2 * 999)
    assert 0 < float(drawn[0].min()) < 1e-5
    assert 1 - 1e-5 < float(drawn[0].max()) < 1


def test_moments_are_those_of_the_laws(drawn):
    _, waiting, first, second = drawn
    error = 4 / math.sqrt(len(waiting))
    assert float(waiting.mean()) == pytest.approx(1, abs=error)
    assert float(waiting.var()) == pytest.approx(1, abs=error * math.sqrt(8))
    for normal in (first, second):
        assert float(normal.mean()) == pytest.approx(0, abs=error)
        assert float(normal.var()) == pytest.approx(1, abs=error * math.sqrt(2))
        assert float((normal**4).mean()) == pytest.approx(3, abs=error * math.sqrt(96))
        assert float((normal.abs() > 3).double().mean()) == pytest.approx(
            math.erfc(3 / math.sqrt(2)), rel=0.1
        )


def test_neighbours_and_pairs_are_uncorrelated(drawn):
    error = 4 / math.sqrt(len(drawn[0]))
    flat = drawn[0] - drawn[0].mean()
    for lag in (1, 2, 16, 346):
        assert abs(float((flat[lag:] * flat[:-lag]).mean() / flat.var())) < error
    assert abs(float((drawn[2] * drawn[3]).mean())) < error
    assert abs(float((drawn[2][1:] * drawn[2][:-1]).mean())) < error
