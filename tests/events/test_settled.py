"""A sensor that ran before its window, against the closed form of a ramp."""

import math
from dataclasses import replace

import pytest
import torch

from codesign import events

RATE = 25.0  # of the log level, per second
THETA = 0.2
LEAD_S = 0.02
WINDOW_S = 0.02
IDEAL = events.SensorModel(theta_on=THETA, theta_off=THETA)
SLOW = replace(IDEAL, cutoff_hz=100.0)
STEADY = RATE * WINDOW_S / THETA


def ramps(times_s, slope=1.0):
    """Frames [1, T, 1, 200] whose log level rises by RATE, up to one event's time after the first of them:
    all phases of the threshold are alike often."""
    delay_s = torch.linspace(0, THETA / RATE, 201, dtype=torch.float64)[:-1]
    since_s = (times_s[:, None] - times_s[0] - delay_s).clamp(min=0) if times_s[0] < 0 else times_s[:, None]
    return (4.0 + slope * RATE * since_s.expand(-1, 200)).exp()[None, :, None]


def times(lead_s=LEAD_S):
    return torch.linspace(-lead_s, WINDOW_S, 61, dtype=torch.float64)


PARTS = {
    "layer": lambda sensor, lead_s: events.Settled(events.layer("memory", sensor), lead_s).volume,
    "hard": lambda sensor, lead_s: (
        lambda frames, t_s, bins: events.HardSensor(sensor, bins, lead_s)(frames, t_s)
    ),
}


@pytest.mark.parametrize("part", PARTS.values(), ids=PARTS)
def test_the_steady_rate_of_a_ramp_is_read_after_the_lead(part):
    """Events of a window are its rise over the threshold; a sensor that begins with the window counts whole
    ones."""
    settled = part(IDEAL, LEAD_S)(ramps(times()), times(), 5)
    assert float(settled.collected_s.sum()) == pytest.approx(WINDOW_S)
    assert settled.counts[:, 0].sum(1).mean().item() == pytest.approx(STEADY, abs=0.03)
    assert (settled.counts[0, 0].detach().mean((1, 2)) / settled.collected_s).tolist() == pytest.approx(
        [RATE / THETA] * 5, rel=0.12
    )
    sudden = part(IDEAL, 0.0)(ramps(times(0.0)), times(0.0), 5)
    assert sudden.counts[:, 0].sum(1).mean().item() == math.floor(STEADY)


@pytest.mark.parametrize("part", PARTS.values(), ids=PARTS)
def test_a_slow_sensor_has_settled_after_its_lead(part):
    """Behind a low pass the first events come later still; after the lead what is left is that its time
    constant, which goes as one over the light, is shorter at the end of the ramp than at its beginning."""
    settled = part(SLOW, LEAD_S)(ramps(times()), times(), 5).counts.sum().item() / 200
    sudden = part(SLOW, 0.0)(ramps(times(0.0)), times(0.0), 5).counts.sum().item() / 200
    assert sudden <= STEADY - 0.5
    assert STEADY < settled < STEADY + 0.2


def test_gradient_is_that_of_the_count():
    """The derivative of the steady count to the slope of the ramp."""
    slope = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    volume = PARTS["layer"](IDEAL, LEAD_S)(ramps(times(), slope), times(), 5)
    volume.counts[:, 0].sum(1).mean().backward()
    assert float(slope.grad) == pytest.approx(STEADY, rel=0.03)
