"""A sensor whose values change during a recording, against the same written out pixel by pixel."""

from dataclasses import replace

import pytest
import torch

from codesign import events
from codesign.events import SensorModel, SensorState, dense_counts, simulate, to_counts

BEGAN = SensorModel(
    theta_sigma=0.03, leak_rate_hz=5.0, rate_cov_decades=0.2, hot_pixel_share=0.1, hot_pixel_rate_hz=40.0
)
CHANGES = {
    "higher thresholds": {"theta_on": 0.6, "theta_off": 0.5},
    "lower thresholds": {"theta_on": 0.06, "theta_off": 0.09},
    "no mismatch": {"theta_sigma": 0.0},
    "more mismatch": {"theta_sigma": 0.1},
    "more leak": {"leak_rate_hz": 500.0},
    "no leak": {"leak_rate_hz": 0.0, "hot_pixel_rate_hz": 0.0},
    "more hot pixels": {"hot_pixel_share": 0.5},
}


def written_out(levels, t_s, sensors, cut, pixel, state, refractory_s):
    """Events (t_us, p) of one pixel: level and leak linear in time, another sensor from frame ``cut`` on."""
    memorised, last_s, found = levels[0], -1e6, []
    for k in range(1, len(t_s)):
        sensor = sensors[k >= cut]
        theta_on, theta_off = (
            max(theta + sensor.theta_sigma * float(deviate.flatten()[pixel]), 0.01)
            if sensor.theta_sigma
            else theta
            for theta, deviate in (
                (sensor.theta_on, state.deviate_on),
                (sensor.theta_off, state.deviate_off),
            )
        )
        hot = float(state.leak_heat.flatten()[pixel]) < sensor.hot_pixel_share
        spread = 10 ** (sensor.rate_cov_decades * float(state.leak_spread.flatten()[pixel]))
        slope = (levels[k] - levels[k - 1]) / (t_s[k] - t_s[k - 1])
        slope += theta_on * (sensor.leak_rate_hz * spread + hot * sensor.hot_pixel_rate_hz)
        now_s, above = t_s[k - 1], levels[k - 1] - memorised
        while True:
            p = 1 if above >= theta_on else -1 if above <= -theta_off else 0
            if not p:
                p = 1 if slope > 0 else -1
                wait_s = ((theta_on if p > 0 else -theta_off) - above) / slope if slope else 1e9
                if now_s + wait_s > t_s[k]:
                    break
                now_s, above = now_s + wait_s, above + slope * wait_s
            above -= theta_on if p > 0 else -theta_off
            if now_s - last_s >= refractory_s:
                found.append((max(round(now_s * 1e6), round(t_s[k - 1] * 1e6) + 1), p))
                last_s = now_s
        memorised = levels[k] - (above + slope * (t_s[k] - now_s))
    return found


@pytest.mark.parametrize("refractory_s", [0.0, 0.004])
@pytest.mark.parametrize("changed", CHANGES.values(), ids=CHANGES)
def test_a_changed_sensor_goes_on_as_if_simulated_in_two_pieces(changed, refractory_s):
    generator = torch.Generator().manual_seed(3)
    began = replace(BEGAN, refractory_s=refractory_s)
    sensors = began, replace(began, **changed)
    t_s = (torch.arange(16) / 200 + 0.00037).tolist()
    levels = 4 + torch.randn(16, 4, 5, generator=generator, dtype=torch.float64).cumsum(0) * 0.15
    cut = 9
    state, counted = SensorState(), SensorState()
    call = {"log_input": True}
    streams, counts = [], []
    for part, sensor in ((slice(0, cut), sensors[0]), (slice(cut, None), sensors[1])):
        streams.append(simulate(levels[part], t_s[part], sensor, state=state, **call))
        counts.append(dense_counts(levels[part], t_s[part], sensor, state=counted, **call))
    stream = events.concatenate(streams)
    assert torch.equal(torch.cat(counts), to_counts(stream, t_s))
    for pixel in range(20):
        here = (stream.y * 5 + stream.x == pixel).nonzero()[:, 0]
        found = list(zip(stream.t_us[here].tolist(), stream.p[here].tolist(), strict=True))
        wanted = written_out(
            levels.flatten(1)[:, pixel].tolist(), t_s, sensors, cut, pixel, state, refractory_s
        )
        assert [p for _, p in found] == [p for _, p in wanted]
        assert all(abs(a - b) <= 1 for (a, _), (b, _) in zip(found, wanted, strict=True))


def test_noise_and_bandwidth_change_from_one_frame_to_the_next():
    sensor = SensorModel(shot_rate_hz=5.0, cutoff_hz=1.0)
    frames = torch.full((21, 40, 40), 255.0)
    state = SensorState()
    rates_hz = []
    for part, shot_rate_hz in enumerate((5.0, 500.0, 50.0)):
        t_s = torch.arange(21) / 20 + 2 * part
        stream = simulate(frames, t_s, replace(sensor, shot_rate_hz=shot_rate_hz), state=state)
        rates_hz.append(len(stream) / 1600 / float(t_s[-1] - (t_s[0] if part == 0 else t_s[0] - 1)))
    # a quarter at full light; five standard deviations
    for found, wanted, seconds in zip(rates_hz, (1.25, 125.0, 12.5), (1, 2, 2), strict=True):
        assert found == pytest.approx(wanted, abs=5 * (wanted / 1600 / seconds) ** 0.5)
    still = replace(sensor, shot_rate_hz=0.0)
    for time_s, cutoff_hz, follows in ((9.0, 0.0, 1.0), (9.001, 1e-4, 0.0), (9.002, 1e7, 1.0)):
        bright = frames[:1] * 0.1 if time_s != 9.001 else frames[:1]
        before = state.level.clone()
        simulate(bright, [time_s], replace(still, cutoff_hz=cutoff_hz), state=state)
        wanted = torch.lerp(before, events.lin_log(bright)[0], follows)
        torch.testing.assert_close(state.level, wanted, atol=1e-4, rtol=0)
