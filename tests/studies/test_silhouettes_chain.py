"""The study of gradients at silhouettes through the chain: its judge on made-up numbers, and its core in a few
seconds."""

import math

import pytest
import torch

from studies.frame.run import main
from studies.silhouettes_chain import __main__ as chain
from studies.silhouettes_chain.case import GROUPS, STEPS, Case

D = torch.float64


@pytest.fixture(scope="module")
def case():
    return Case(0, 24)


def test_every_pixel_goes_through_even_places_of_its_threshold(case):
    places = case.places(8, 3)
    assert places.shape == (8, 24, 24)
    held = ((places + 0.5) * 8).floor().sort(0).values
    assert torch.equal(held, torch.arange(8.0)[:, None, None].expand(8, 24, 24))
    assert not torch.equal(places, case.places(8, 4))


def test_hard_counts_are_whole_and_in_the_mean_the_smooth_ones_of_a_rise(case):
    level = torch.linspace(0, 1.7, 12)[:, None, None].expand(12, 24, 24)
    frames = 60 * level.exp()  # above 20 the front end is a logarithm
    hard = case.hard(frames, case.places(64, 0)).sum(0)
    assert torch.equal(hard, hard.round())
    # one threshold from the middle of its place, half a threshold is not yet reached: floor(x - u) over a unit of u
    expected = 1.7 / case.theta - 0.5
    assert float((hard[0].mean(0) - expected).abs().max()) <= 1 / 64
    assert float(hard[1].abs().max()) == 0
    torch.testing.assert_close(case.smooth(frames).sum(0)[0], 1.7 / case.theta, rtol=1e-5, atol=0)


def test_the_judge_finds_the_error_noise_and_cosine_that_were_put_in(generator):
    truth = torch.randn(3, 1, 6, generator=generator, dtype=D)
    noise = torch.randn(3, 400, 6, generator=generator, dtype=D)
    values = torch.stack([truth + 0.5 * noise, 0 * noise - truth, 1.25 * truth + 0 * noise, 0 * noise], 2)
    row = chain.judged(values)
    size = float(truth.norm())
    # 18 numbers of a standard error of 0.5 / 20 each, known to 1 in sqrt(2 x 18 x 399)
    assert row.noise == pytest.approx(0.025 * math.sqrt(18) / size, rel=0.05)
    found = (truth[:, 0] + 0.5 * noise.mean(1)).flatten()
    away = (1.25 * truth.flatten() - found).norm() / found.norm()
    assert row.boundary == pytest.approx(float(away), rel=1e-12)
    assert row.spread == pytest.approx(0, abs=1e-12)
    assert row.single == pytest.approx(1, rel=1e-12)
    cosine = float(truth.flatten() @ found / (truth.norm() * found.norm()))
    assert (row.cosine_boundary, row.cosine_interior) == pytest.approx((cosine, -cosine), rel=1e-12)


def test_what_is_asked_of_which_loss():
    row = chain.Row(1.0, 0.06, 0.2, 0.01, 0.01, 0.5, 0.95)
    assert not chain.missed("smooth flow", row)
    assert chain.missed("smooth flow", chain.Row(1.0, 0.08, 0.2, 0.01, 0.01, 0.5, 0.95))
    assert not chain.missed("hard flow", row)
    assert chain.missed("hard flow", chain.Row(1.0, 0.06, 0.2, 0.11, 0.01, 0.5, 0.95))
    assert chain.missed("hard flow", chain.Row(1.0, 0.06, 0.2, 0.01, 0.01, 0.5, 0.89))
    assert not chain.missed("hard flow, one place", chain.Row(1.0, 2.0, 2.0, 3.0, 0.01, 0.5, -0.9))


def test_the_pose_gradient_of_counts_needs_the_boundary_term(case):
    losses = {k: v for k, v in case.losses(case.places(8, 0)).items() if k.endswith("counts")}
    pose = GROUPS["pose"]
    seeds = range(4)
    truth = [case.differences(losses, 64, seed) for seed in seeds]
    found = {
        way: [case.gradients(losses, 64, seed, way, 16.0) for seed in seeds]
        for way in ("interior", "boundary")
    }
    for name in losses:
        values = torch.stack([t[name][pose] for t in truth])
        mean = values.mean(0)
        for way, (least, most) in {"interior": (0.3, 3.0), "boundary": (0.0, 0.05)}.items():
            other = torch.stack([g[name][pose] for g in found[way]])
            error = float((other.mean(0) - mean).norm() / mean.norm())
            # both sides are means over four seeds
            noise = float((values.var(0) + other.var(0)).sum().sqrt() / 2 / mean.norm())
            assert noise < 0.15
            assert least <= error <= most + 2 * noise, (name, way)


def test_steps_are_small_beside_a_pixel(case):
    """Every step of the pose moves the image by less than a third of a pixel of 48."""
    camera = case.camera(torch.zeros(9, dtype=D), 1, 0)
    px_per_rad = 2.0 / camera.slope_per_px()  # of 48 instead of 24
    nearest_m = 0.9
    assert px_per_rad * float(STEPS[:3].max()) / nearest_m < 0.35
    assert px_per_rad * float(STEPS[3:6].max()) < 0.35


def test_wrong_numbers_are_refused(tmp_path, capsys):
    assert main(chain.study, chain.Config, ["--seeds", "1", "--out", str(tmp_path / "run")]) == 2
    assert "seeds = 1" in capsys.readouterr().err
