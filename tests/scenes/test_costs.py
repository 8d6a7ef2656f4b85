"""What a whole design pays: noise against v2e's law, a bus against the binomial law, light, and a
mast that bends."""

import math

import pytest
import torch

from codesign.pose import se3_exp
from codesign.types import EventVolume
from scenes.robots.costs import Costs, Exposed, noise_rate_hz, threshold_to_noise
from scenes.robots.pair import SENSOR
from tests import refusals
from tests.numbers import D, f64, seeded


def test_noise_follows_the_fit_of_v2e():
    # at a rate of twice the bandwidth the fit is its constant: 10^0.321
    assert threshold_to_noise(400.0, 200.0) == pytest.approx(10**0.321, rel=1e-12)
    for rate_hz in (1e-3, 0.7, 5.0, 300.0):
        assert noise_rate_hz(threshold_to_noise(rate_hz, 120.0), 120.0) == pytest.approx(
            rate_hz, rel=1e-9
        )


def test_the_nominal_sensor_keeps_its_rate_and_noise_grows_with_bandwidth_and_sensitivity():
    costs = Costs()
    at = {
        (theta, cutoff): costs.sensor(SENSOR, theta, cutoff).shot_rate_hz
        for theta in (0.15, 0.25)
        for cutoff in (100.0, 200.0)
    }
    assert at[0.25, 200.0] == pytest.approx(SENSOR.shot_rate_hz, rel=1e-9)
    assert at[0.15, 100.0] > at[0.25, 100.0]
    assert at[0.25, 200.0] > at[0.25, 100.0]
    # half of the bandwidth has 1 / sqrt(2) of the noise: a threshold as much lower makes half of
    # the rate
    lower = costs.sensor(SENSOR, 0.25 / math.sqrt(2), 100.0).shot_rate_hz
    assert lower == pytest.approx(SENSOR.shot_rate_hz / 2, rel=1e-9)
    assert Costs(noise=False).sensor(SENSOR, 0.1, 200.0).shot_rate_hz == SENSOR.shot_rate_hz


def test_light_goes_with_the_square_of_the_f_number():
    assert Costs(light=0.5).gain(2.4) == pytest.approx(0.125)
    seen = {}

    class Layer(torch.nn.Module):
        def volume(self, frames, t_s, bins, generator=None):
            seen["frames"] = frames
            return EventVolume(torch.zeros(2, 2, bins, 4, 4), t_s, t_s)

    frames = torch.full((2, 3, 4, 4), 80.0)
    Exposed(Layer(), 0.125, None, 2).volume(frames, torch.arange(3.0), 5)
    assert torch.equal(seen["frames"], torch.full((2, 3, 4, 4), 10.0))


class Counted(torch.nn.Module):
    """Gives the counts it was made of."""

    def __init__(self, counts):
        super().__init__()
        self.counts = counts

    def volume(self, frames, t_s, bins, generator=None):
        return EventVolume(self.counts, t_s, t_s)


def test_a_bus_keeps_what_it_can_read_by_the_binomial_law():
    counts = torch.full((4, 2, 5, 40, 40), 3.0, dtype=D)
    counts[2:] = 0.02  # the second body is quiet
    offered = float(counts[:2].sum())
    counts.requires_grad_()
    bus = Exposed(Counted(counts), 1.0, 0.3 * offered, 2)
    read = bus.volume(counts, torch.arange(3.0), 5, seeded(0)).counts
    assert torch.equal(read[2:], counts[2:])
    kept = read[:2].detach()
    assert float(kept.sum() / offered) == pytest.approx(0.3, abs=4 * math.sqrt(0.21 / offered))
    # three events each, kept by a third
    assert float(kept.var()) == pytest.approx(3 * 0.3 * 0.7, rel=0.02)
    (slope,) = torch.autograd.grad(read.sum(), counts)
    assert torch.allclose(slope[:2], torch.full_like(slope[:2], 0.3))
    assert torch.equal(slope[2:], torch.ones_like(slope[2:]))


def test_a_mast_bends_as_a_cantilever():
    """Under a load P at its tip a cantilever deflects by P L^3 / 3 E I and slopes by P L^2 / 2 E
    I."""
    pose = torch.eye(4, dtype=D)
    pose[:3, 3] = torch.tensor([0.4, 0.1, 0.7])
    deviates = f64([[0.3, -1.2], [1.0, 0.5]])
    twist = Costs(sway_per_m_s=0.6).sway(pose, 0.3, f64([0.5, 2.0]), deviates)
    # a tenth of a millisecond of it
    moved = se3_exp(1e-4 * twist) @ pose
    tip = (moved[:, :3, 3] - pose[:3, 3]) / 1e-4
    length = 0.4
    slope_over_deflection = (length**2 / 2) / (length**3 / 3)
    assert torch.allclose(tip[:, 0] * slope_over_deflection, twist[:, 4], rtol=1e-4)
    assert torch.allclose(-tip[:, 1] * slope_over_deflection, twist[:, 3], rtol=1e-4)
    # 0.6 rad/s at 1 m and 1 m/s, by the square of the length; faster than 1 m/s makes no difference
    rates = 0.6 * 0.4**2 * f64([[0.5], [1.0]]) * deviates
    assert torch.allclose(twist[:, 3:5], rates)
    assert not Costs().sway(pose, 0.8, torch.ones(2, dtype=D), deviates).any()


@refusals.table(__file__, "costs")
def test_costs_out_of_range_are_refused(row):
    row.holds(globals())
