"""What is drawn of each stage of the chain alone is what theory has."""

import math

import numpy as np
import pytest
import torch

from codesign.events import SensorModel
from scenes import textures, trajectories, worlds
from studies.chain_picture import panels

T_S = torch.linspace(0, 0.1, 101, dtype=torch.float64)


def swinging(size=1.0):
    """Frames whose log level swings by ``size``, each of 64 pixels with a phase of its own."""
    phase = torch.linspace(0, 2 * math.pi, 64, dtype=torch.float64).reshape(8, 8)
    return 80 * (size * torch.sin(2 * math.pi * 10 * T_S[:, None, None] + phase)).exp()


def test_a_step_has_come_to_63_per_cent_after_one_time_constant():
    curves, delays = panels.smoothing((30, 100, 300))
    constants_ms, found_ms = delays.series[""]
    assert constants_ms == pytest.approx([1e3 / (2 * math.pi * f) for f in (30, 100, 300)])
    assert found_ms == pytest.approx(constants_ms, abs=0.02)  # two of its times
    at_ms, passed = curves.series["100 Hz"]
    # the step lasts one of its times, and is late by half of it
    expected = 1 - torch.exp(-2 * math.pi * 0.1 * (at_ms - 0.005))
    np.testing.assert_allclose(passed[1:], expected[1:], atol=1e-4)


def test_half_the_threshold_gives_about_twice_the_events():
    thetas = (0.02, 0.04, 0.08, 0.16)
    drawn = panels.thresholds(swinging(), T_S, thetas).series
    for polarity in panels.POLARITIES:
        events = drawn[polarity][1]
        # a swing from -1 to 1 has 2/theta of them; less than one is left out at each turn
        assert events == pytest.approx(64 * 2 / np.array(thetas), rel=0.12)
        assert ((events[:-1] / events[1:] > 1.95) & (events[:-1] / events[1:] < 2.25)).all()


def test_sharp_sigmoids_have_the_hard_count():
    sharpness = (2, 5, 20, 100, 1000)
    answers, totals = panels.sigmoids(swinging(2.5), sharpness)
    (_, soft), (_, hard) = totals.series["sigmoid"], totals.series["hard"]
    off = np.abs(np.array(soft) / hard - 1)
    assert hard[0] > 100
    assert (np.diff(off) < 0).all()
    assert off[-1] < 0.01
    for k in sharpness:
        step, count = answers.series[f"k = {k:g}/θ"]
        still, at_threshold = (count[(step - place).abs().argmin()] for place in (0, 1))
        assert float(still) == pytest.approx(math.exp(-k) / (1 + math.exp(-k)), rel=1e-9)
        assert float(at_threshold) == pytest.approx(0.5, abs=1e-9)


def test_a_rest_thins_the_events_of_a_ramp():
    """A level that rises by 40 thresholds in 0.1 s fires every 2.5 ms; after a rest of 6 ms the
    third of them is the next, after 7.5 ms."""
    frames = (3 + 40 * 0.1 * T_S / 0.1).exp()[:, None, None].expand(-1, 2, 3)
    sensors = {"all": SensorModel(0.1, 0.1), "rest": SensorModel(0.1, 0.1, refractory_s=0.006)}
    drawn = panels.rates(frames, T_S, sensors).series
    means = {name: float(rate.mean()) for name, (_, rate) in drawn.items()}
    assert means["ON, all"] == pytest.approx(400, abs=10)  # one event more or less
    assert means["ON, rest"] == pytest.approx(400 / 3, abs=10)
    assert means["OFF, all"] == means["OFF, rest"] == 0


def test_events_of_the_loop_stay_on_the_left_and_fade_on_the_right():
    """One pixel brightens by two thresholds in the first interval, and rests."""
    frames = torch.full((101, 4, 6), 50.0)
    frames[1:, 2, 3] *= math.exp(2.5 * panels.THETA)
    shown = np.stack([np.asarray(picture) for picture in panels.loop(frames, T_S)]).astype(float)
    grey, held, fading = np.split(shown, 3, axis=2)
    assert (grey == grey[:1]).all()
    white = np.ones((4, 6), dtype=bool)
    white[2, 3] = False
    assert (held[:, white] == 255).all()
    assert (fading[:, white] == 255).all()
    assert (held[:, 2, 3] == held[0, 2, 3]).all()
    strength = 2 / panels.FULL_COUNT * np.exp(-(T_S[1:] - T_S[1]).numpy() / panels.FADE_S)
    np.testing.assert_allclose(fading[:, 2, 3, 2], 255 * (1 - strength), atol=0.51)


def test_a_lens_out_of_focus_sharpens_the_edges_of_its_events():
    wall = worlds.wall(textures.shrunk(textures.photo("gravel"), 2), texel_m=0.003)
    t_s = torch.linspace(0, 0.05, 4, dtype=torch.float64)
    drive = trajectories.translation(torch.eye(4, dtype=torch.float64), (0.3, 0.1, 0.0), t_s)
    drive[:, :3, :3] = torch.tensor([[1, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
    drive[:, 1, 3] -= 2
    _, energies = panels.lens_way(wall, drive, t_s, 8)
    assert energies.series[""][1][-1] > 2 * energies.series[""][1][0]
