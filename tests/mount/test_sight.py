"""What cameras are blind to, against closed forms of pinholes over ground, symmetries, and errors
of drawn estimates."""

import math

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

from codesign import lens, render
from codesign.errors import DomainError
from codesign.mount import (
    ATTITUDES,
    PLANAR,
    VELOCITIES,
    LookAhead,
    Mount,
    Surroundings,
    expected_error,
    flow_precision,
    sight,
    sight_map,
    sight_table,
    sight_units,
)
from codesign.report.mount_sphere import mount_sphere
from tests.numbers import D, close, f64, randn64

FOCAL_PX = 3.4 / 0.148
HEIGHT = 0.4


@pytest.fixture(scope="module")
def camera():
    return render.Camera(lens.Pinhole(3.4), 32, 24, 0.148)


@pytest.fixture(scope="module")
def over_ground():
    return Surroundings((0.0, 0.0, HEIGHT), deviation_px_s=2.0, points=48.0)


def test_a_downward_camera_sees_what_textbooks_say(camera, over_ground):
    """Over its body's origin on the ground, alone: forward and left by f / h each, up by (x, y) /
    h, yaw by the radius, and turns about the ground below it by no more than (x y, y^2) / f: shift
    and turn cancel in the middle."""
    pixels = camera.film.pixels() - camera.film.middle_px
    x, y = pixels.unbind(1)
    sums = {
        "forward": (FOCAL_PX / HEIGHT) ** 2 * len(x),
        "left": (FOCAL_PX / HEIGHT) ** 2 * len(x),
        "up": float((x**2 + y**2).sum()) / HEIGHT**2,
        "roll": float((x**4 + x**2 * y**2).sum()) / FOCAL_PX**2,
        "pitch": float((y**4 + x**2 * y**2).sum()) / FOCAL_PX**2,
        "yaw": float((x**2 + y**2).sum()),
    }
    found = sight_table(camera, over_ground)["downward"]["sight"].alone
    expected = [2.0 / math.sqrt(48 / len(x) * value) for value in sums.values()]
    # rows are differences of chief rays, good to 1e-9
    close(found, f64(expected), rtol=1e-6)


def test_the_table_says_what_each_is_blind_to(camera, over_ground):
    table = sight_table(camera, over_ground)
    assert list(table) == list(ATTITUDES)
    assert table["downward"]["seen"] == 1.0
    assert table["forward"]["seen"] == 0.5  # no row lies on the horizon
    for row in table.values():
        columns = [row[name] for name in VELOCITIES]
        assert columns == row["sight"].deviation.tolist()
        assert row["blind"] == [
            name
            for name, value in zip(
                ("forward", "left", "up", "roll", "pitch", "yaw"), columns, strict=True
            )
            if value > 0.1
        ]
    # forward and sideways are one camera turned by a right angle: forward and left, roll and pitch
    # change places
    ahead, beside = (table[name]["sight"].deviation for name in ("forward", "sideways"))
    close(ahead[[1, 0, 2, 4, 3, 5]], beside, rtol=1e-6)
    assert set(table["downward"]["weakest"].split()[1::2]) <= {"forward", "left", "roll", "pitch"}


def test_far_walls_show_turns_alone(camera):
    """Before something 1000 times farther, shifts are a thousandth as visible, turns are as they
    were."""
    found = []
    for far in (2.0, 2000.0):
        around = Surroundings(
            (0.0, 0.0, 0.0),
            depth=lambda camera, pixels, poses, scene, far=far: torch.full(
                pixels.shape[:2], far, dtype=D
            ),
            farthest_m=1e4,
        )
        found.append(sight_table(camera, around, {"ahead": (0.0, 0.0)})["ahead"]["sight"].alone)
    close(found[1][:3], 1000 * found[0][:3], rtol=1e-6)
    close(found[1][3:], found[0][3:], rtol=1e-9)
    # beyond what is farthest, nothing
    nothing = Surroundings((0.0, 0.0, 0.0), depth=around.depth, farthest_m=10.0)
    row = sight_table(camera, nothing, {"ahead": (0.0, 0.0)})["ahead"]
    assert row["seen"] == 0.0
    assert row["blind"] == ["forward", "left", "up", "roll", "pitch", "yaw"]


def test_the_map_is_even_around_a_body_that_has_no_front(camera, over_ground):
    square = render.Camera(lens.Pinhole(3.4), 16, 16, 0.148)
    yaw, pitch, error = sight_map(square, over_ground, rows=6, columns=5)
    assert error.shape == (6, 5)
    assert yaw.tolist() == pytest.approx([math.radians(a) for a in (-144, -72, 0, 72, 144)])
    assert pitch.tolist() == pytest.approx([math.radians(a) for a in (-75, -45, -15, 15, 45, 75)])
    close(error, error[:, :1].expand(6, 5), rtol=1e-6)
    # nothing but sky: the prior of 1 in units of 0.1
    assert error[:2].flatten().tolist() == pytest.approx([10.0] * 10)
    assert error[4:].max() < 0.2 * error[0, 0]


def test_the_picture_shows_the_map(camera, over_ground):
    yaw, pitch, error = sight_map(camera, over_ground, rows=4, columns=6)
    figure = mount_sphere(yaw, pitch, error, "expected error", {"found": (0.3, 1.0)})
    shown = figure.axes[0].collections[0].get_array()
    assert shown is not None
    # drawn with up at the top: pitch falls from the bottom row upwards
    assert sorted(shown.flatten().tolist()) == sorted(error.flatten().tolist())
    line = figure.axes[0].lines[-1]
    assert np.asarray(line.get_xydata()).tolist() == [[-0.3, -1.0]]
    # in whatever order directions come, whole turns aside
    turned = mount_sphere((yaw + math.tau) % math.tau, pitch.flip(0), error.flip(0), "error")
    assert np.array_equal(turned.axes[0].collections[0].get_array(), shown)
    with pytest.raises(DomainError, match="middles of equal cells over the whole sphere"):
        mount_sphere(yaw / 2, pitch, error, "error")
    plt.close("all")


def test_precision_is_the_inverse(generator):
    root = randn64(generator, 20, 2, 2)
    full = root @ root.mT + 0.1 * torch.eye(2, dtype=D)
    packed = torch.stack([full[:, 0, 0], full[:, 0, 1], full[:, 1, 1]], -1)
    close(flow_precision(packed), torch.linalg.inv(full), rtol=1e-12)
    floored = torch.linalg.inv(full + 0.09 * torch.eye(2, dtype=D))
    close(flow_precision(packed, 0.3), floored, rtol=1e-12)


def test_expected_error_is_what_estimates_miss_on_average(generator):
    """Velocities drawn from the prior, measured with noise, estimated by the mean of what they can
    be."""
    rows = randn64(generator, 7, 3)
    prior = f64([0.5, 1.0, 2.0])
    unit = f64([0.1, 0.1, 0.3])
    draws = 20000
    velocity = prior * randn64(generator, draws, 3)
    measured = velocity @ rows.T + randn64(generator, draws, 7)
    information = rows.T @ rows
    estimate = measured @ rows @ torch.linalg.inv(information + torch.diag(prior**-2))
    rms = ((estimate - velocity) / unit).square().mean().sqrt()
    # three squared errors a draw: relative error 1 / sqrt(2 * draws) of one alone, five of them
    assert float(expected_error(information, unit, prior)) == pytest.approx(float(rms), rel=5 / 200)


def test_gradient_of_the_criterion_to_mount_and_lens(generator):
    mount = Mount((0.1, 0.05, 0.4), (0.1, 0.1, 0.1), pitch_rad=0.9)
    around = Surroundings((0.0, 0.0, 0.0), deviation_px_s=20.0)

    def error(numbers, focal):
        camera = render.Camera(lens.Pinhole(focal), 12, 8, 0.4, 1)
        information, _ = around.information(camera, mount(numbers))
        return expected_error(information, sight_units(around), (1.0,) * 6)

    numbers = (0.2 * randn64(generator, 6)).requires_grad_()
    focal = torch.tensor(4.0, dtype=D, requires_grad=True)
    # rows are differences of chief rays, good to 1e-9 over steps of 1e-6
    assert torch.autograd.gradcheck(error, (numbers, focal), eps=1e-5, atol=1e-5, rtol=1e-4)


def test_sight_of_independent_velocities():
    found = sight(torch.diag(f64([400.0, 25.0, 0.0])), (0.1, 0.2, 0.1), PLANAR)
    assert found.deviation.tolist() == [0.05, 0.2, math.inf]
    assert found.alone.tolist() == [0.05, 0.2, math.inf]
    assert found.weakest_deviation == math.inf
    assert found.weakest_named() == "+1.00 yaw"
    assert (found.blind(), found.blind(0.6), found.blind(0.1)) == (
        ["yaw"],
        ["left", "yaw"],
        ["forward", "left", "yaw"],
    )


def test_sight_of_two_that_look_alike():
    """Forward and pitch seen by their sum alone, each measured a little: the difference shows
    least."""
    together = f64([[1.0, 1.0], [1.0, 1.0]]) * 100 + torch.eye(2, dtype=D)
    found = sight(together, (1.0, 1.0), (0, 4))
    inverse = torch.linalg.inv(together)
    torch.testing.assert_close(found.deviation, inverse.diagonal().sqrt())
    torch.testing.assert_close(found.alone, torch.full((2,), 101.0, dtype=D).rsqrt())
    assert found.weakest_named() in ("+0.71 forward -0.71 pitch", "-0.71 forward +0.71 pitch")
    assert found.weakest_deviation == pytest.approx(1.0)


@pytest.mark.parametrize("scale", [1e-10, 1e10])
def test_what_is_seen_does_not_hang_on_the_unit_of_information(scale):
    """NOTHING is a share of the largest eigenvalue: of 4 and 1 times any scale both are seen."""
    found = sight(scale * torch.diag(f64([4.0, 1.0, 0.0])), (1.0, 1.0, 1.0), PLANAR)
    expected = f64([0.5, 1.0, math.inf]) / math.sqrt(scale)
    close(found.deviation, expected, rtol=1e-12)


def test_pixels_without_light_see_nothing(over_ground):
    """A triplet before a film far beyond its field."""
    wide = render.Camera(lens.load("cooke-triplet").scaled(0.22), 24, 24, 0.77, 4)
    down = over_ground.mount(0.0, math.pi / 2)
    lit = (wide.chief_rays(wide.film.pixels()).weight > 0).double().mean()
    assert 0.1 < lit < 0.6
    assert over_ground.information(wide, down)[1] <= lit
    assert (LookAhead(1.0, 0.5).angles(down, wide) == -1.0).double().mean() >= 1 - lit
