"""A layer draws again what it drew from the same generators, and only then."""

import pytest
import torch

from codesign import events

SENSOR = events.SensorModel(theta_on=0.2, theta_off=0.2, theta_sigma=0.03, shot_rate_hz=50.0)


def frames(generator, samples=3):
    return 50 + 100 * torch.rand(samples, 4, 6, 5, generator=generator)


def counted(layer, shown, seed, dt_s=0.01):
    """Counts, and a number that the generator draws afterwards."""
    source = torch.Generator().manual_seed(seed)
    counts = layer(shown, torch.arange(4, dtype=torch.float64) * dt_s, source)
    return counts, torch.rand(1, generator=source)


def test_a_layer_counts_what_a_fresh_one_counts_call_after_call(generator):
    layer = events.layer("memory", SENSOR)
    shown = frames(generator)
    for call in (
        {"seed": 0},
        {"seed": 0},  # remembered
        {"seed": 1},
        {"seed": 1, "dt_s": 0.1},  # more noise in a longer interval
        {"seed": 0},
    ):
        for mine, fresh in zip(
            counted(layer, shown, **call),
            counted(events.layer("memory", SENSOR), shown, **call),
            strict=True,
        ):
            assert torch.equal(mine, fresh)


@pytest.mark.bits
def test_shapes_and_chunks_keep_their_own_draws(generator):
    layer = events.layer("memory", SENSOR)
    shown = frames(generator)
    t_s = torch.arange(4, dtype=torch.float64) / 100
    whole, _ = counted(layer, shown, 0)
    assert not torch.equal(counted(layer, shown[:1], 0)[0], whole[1:2])
    one = torch.Generator().manual_seed(0)
    first, state = layer.advance(shown[:1, :2], t_s[:2], None, one)
    rest, _ = layer.advance(shown[:1, 2:], t_s[2:], state)
    alone, _ = counted(events.layer("memory", SENSOR), shown[:1], 0)
    assert torch.equal(torch.cat([first, rest], 1), alone)
