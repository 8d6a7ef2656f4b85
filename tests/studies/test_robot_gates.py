"""The gates of robots and their worlds: blur by traced rays, polynomials given back, rankings of known noise, and the
study on a landscape in closed form."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from scenes import robot_pair, worlds
from scenes.robot_pair import Drives, RobotPair
from scenes.robot_pairs import PAIRS
from studies.frame.run import main
from studies.robot_gates import __main__ as gates
from studies.robot_gates import measures

D = torch.float64
GROWTH = {
    "efl_mm": 0.3,
    "focus_per_m": -0.4,
    "z_m": 0.5,
    "pitch_rad": 0.2,
}  # of the log error, squared shares


@pytest.fixture(scope="module")
def pair():
    return PAIRS["outdoors"]()


def test_blur_is_what_the_edges_of_the_pupil_leave_on_the_film(pair):
    poses = torch.eye(4, dtype=D).expand(1, 1, robot_pair.FRAMES, 4, 4)
    batch = Drives(poses, robot_pair.times(), (worlds.smooth_plane(),), 0, twist=torch.zeros(1, 6))
    found = measures.blur_px(pair, batch)[0].reshape(9, 8, 8)
    camera = pair.design.camera()
    mount = pair.design.mount()
    pixels = camera.film.pixels().reshape(9, 32, 32, 2)[:, ::4, ::4].reshape(-1, 2)
    rays = camera.chief_rays(pixels)
    falling = rays.direction @ mount[2, :3]
    hit = falling < -1e-3
    points = 1e3 * rays.direction[hit] * (-mount[2, 3] / falling[hit])[:, None]
    edges = [
        camera.lens.film_points(points, torch.tensor([[s, 0.0]], dtype=D).expand(len(points), 2))[0]
        for s in (-1.0, 1.0)
    ]
    expected = (edges[1] - edges[0]).norm(dim=1) / robot_pair.PITCH_MM
    torch.testing.assert_close(found.reshape(-1)[hit], expected, rtol=1e-9, atol=1e-9)


def test_summary_of_blur():
    discs = torch.linspace(0, 1, 101, dtype=D)[None] * torch.tensor([[2.0], [4.0], [6.0]], dtype=D)
    blur = measures.blur_over(torch.cat([discs, torch.full((3, 7), torch.nan)], 1))
    assert blur.frame == pytest.approx(0.96 * 4)
    assert blur.smallest < 0.1
    assert 5.6 < blur.largest < 6


def test_levels_reach_the_bounds_and_focal_lengths_go_by_their_logarithm(pair):
    for name in measures.VARIABLES:
        low, start, high = (getattr(each, name) for each in (pair.low, pair.design, pair.high))
        ends = [measures.level(pair, name, share) for share in (-1.0, 0.0, 1.0)]
        assert ends == pytest.approx([low, start, high])
        assert measures.farther(pair, name) == (1.0 if high - start > start - low else -1.0)
    half = measures.level(pair, "efl_mm", 0.5)
    assert half**2 == pytest.approx(pair.design.efl_mm * pair.high.efl_mm)
    moved = measures.shifted(pair, z_m=0.5)
    assert moved == replace(pair.design, z_m=(pair.design.z_m + pair.high.z_m) / 2)


def test_margin_is_that_of_the_nearest_bound(pair):
    near = replace(
        pair, design=replace(pair.design, y_m=pair.low.y_m + 0.01 * (pair.high.y_m - pair.low.y_m))
    )
    assert measures.margin(near) == pytest.approx(0.01)
    assert measures.margin(pair) >= measures.MARGIN


def test_polynomials_of_second_order_are_given_back():
    generator = torch.Generator().manual_seed(1)
    at = torch.rand(40, 4, generator=generator, dtype=D) * 2 - 1
    coefficients = torch.randn(15, 2, generator=generator, dtype=D)
    errors = measures.surface(coefficients, at)
    torch.testing.assert_close(measures.fit(at, errors), coefficients, rtol=1e-9, atol=1e-9)
    first = torch.tensor([[0.3, 0.0, -0.2, 0.0]], dtype=D)
    by_hand = coefficients[0] + 0.3 * coefficients[1] - 0.2 * coefficients[3]
    by_hand = by_hand + 0.09 * coefficients[5] - 0.06 * coefficients[7] + 0.04 * coefficients[12]
    torch.testing.assert_close(measures.surface(coefficients, first)[0], by_hand.exp(), rtol=1e-12, atol=0)


def test_planes_move_two_variables():
    at = measures.plane(("focus_per_m", "pitch_rad"), 0.9, 3)
    assert at[:, [0, 2]].abs().max() == 0
    assert at[:3, 1].tolist() == [-0.9] * 3
    assert at[:3, 3].tolist() == pytest.approx([-0.9, 0.0, 0.9])


def test_spread_of_an_even_ladder():
    # of 1 to 101 the tenth and ninetieth percentiles are 11 and 91
    assert float(measures.spread(torch.arange(1.0, 102.0, dtype=D)[:, None])) == pytest.approx(91 / 11)


def test_rankings_of_known_noise():
    generator = torch.Generator().manual_seed(2)
    worlds_, motions, shift, deviation = 4000, 6, 0.012, 0.12
    first = torch.full((worlds_, motions), 0.4, dtype=D)
    noise = deviation * torch.randn(worlds_, motions, generator=generator, dtype=D)
    second = first + shift + noise - noise.mean()
    found = measures.ranking(first, second, generator)

    def share(difference):
        return 0.5 * (1 + math.erf(difference * math.sqrt(96) / deviation / math.sqrt(2)))

    assert found.right == pytest.approx(share(shift), abs=0.03)  # 2000 draws, and the sample's own deviation
    error = (0.4 / 0.6) ** 0.25 * (0.412 / 0.588) ** 0.25
    ends = [(error * 1.1**half) ** 2 for half in (-0.5, 0.5)]
    step = ends[1] / (1 + ends[1]) - ends[0] / (1 + ends[0])
    assert found.expected == pytest.approx(share(step), abs=0.01)
    assert found.ratio == pytest.approx(math.sqrt(0.412 / 0.588 / (0.4 / 0.6)))


def test_the_study_finds_the_factors_of_a_landscape_in_closed_form(tmp_path, monkeypatch):
    """Errors exp of squares of the shares of the way to a bound, with a little noise from world to world."""

    def judged(self: RobotPair, design, batch, layer="memory"):
        at = {
            name: next(
                share
                for share in (-0.9, -0.25, 0.0, 0.25, 0.9)
                if math.isclose(measures.level(self, name, share), getattr(design, name), rel_tol=1e-6)
            )
            for name in measures.VARIABLES
        }
        error = 0.7 * math.exp(sum(growth * at[name] ** 2 for name, growth in GROWTH.items()))
        count = len(batch.twist)
        ripple = 1e-3 * torch.sin(torch.arange(count) * (1.0 + 5 * at["z_m"] + 3 * at["efl_mm"]))
        return SimpleNamespace(bounded=lambda: error**2 / (1 + error**2) + ripple)

    monkeypatch.setattr(RobotPair, "judged", judged)
    arguments = ["--quick", "--pair", "outdoors", "--out", str(tmp_path / "run")]
    assert main(gates.study, gates.Config, arguments) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["outdoors_default_error"] == pytest.approx(0.7, rel=2e-3)
    line = torch.linspace(-0.9, 0.9, gates.FINE, dtype=D) ** 2
    for first, second in measures.PLANES:
        flat = (GROWTH[first] * line[:, None] + GROWTH[second] * line).exp().flatten()
        low, high = torch.quantile(flat, torch.tensor([0.1, 0.9], dtype=D))
        # a ripple of 0.1 % of the bounded error is some 0.3 % of the error
        assert metrics[f"outdoors_factor_{first}_{second}"] == pytest.approx(float(high / low), rel=2e-2)
    assert metrics["outdoors_blur_span_px"] > 4
    assert (tmp_path / "run" / "report.html").is_file()
    assert (tmp_path / "run" / "outdoors_robot.png").is_file()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--pair", "submarine"], "--pair submarine: choose from outdoors, corridor, flight"),
        (["--levels", "4"], "levels = 4 must be odd"),
        (["--reach", "1.0"], "between 0 and 1"),
        (["--pool", "1"], "pool at least 2"),
    ],
)
def test_what_cannot_be_measured_is_told_in_a_sentence(options, sentence, tmp_path, capsys):
    assert main(gates.study, gates.Config, [*options, "--out", str(tmp_path / "run")]) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())
