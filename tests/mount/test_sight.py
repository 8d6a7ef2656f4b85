"""What cameras are blind to, against closed forms of pinholes over ground and symmetries."""

import math

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

from codesign import lens, render
from codesign.mount import ATTITUDES, VELOCITIES, Surroundings, sight_map, sight_table
from codesign.report.mount_sphere import mount_sphere

D = torch.float64
FOCAL_PX = 3.4 / 0.148
HEIGHT = 0.4


@pytest.fixture(scope="module")
def camera():
    return render.Camera(lens.Pinhole(3.4), 32, 24, 0.148)


@pytest.fixture(scope="module")
def over_ground():
    return Surroundings((0.0, 0.0, HEIGHT), deviation_px_s=2.0, points=48.0)


def test_a_downward_camera_sees_what_textbooks_say(camera, over_ground):
    """Over its body's origin on the ground, alone: forward and left by f / h each, up by (x, y) / h, yaw by
    the radius, and turns about the ground below it by no more than (x y, y^2) / f: shift and turn cancel in
    the middle."""
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
    torch.testing.assert_close(found, torch.tensor(expected, dtype=D), rtol=1e-6, atol=0)


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
            for name, value in zip(("forward", "left", "up", "roll", "pitch", "yaw"), columns, strict=True)
            if value > 0.1
        ]
    # forward and sideways are one camera turned by a right angle: forward and left, roll and pitch change
    # places
    ahead, beside = (table[name]["sight"].deviation for name in ("forward", "sideways"))
    torch.testing.assert_close(ahead[[1, 0, 2, 4, 3, 5]], beside, rtol=1e-6, atol=0)
    assert set(table["downward"]["weakest"].split()[1::2]) <= {"forward", "left", "roll", "pitch"}


def test_far_walls_show_turns_alone(camera):
    """Before something 1000 times farther, shifts are a thousandth as visible, turns are as they were."""
    found = []
    for far in (2.0, 2000.0):
        around = Surroundings(
            (0.0, 0.0, 0.0),
            depth=lambda camera, pixels, poses, scene, far=far: torch.full(pixels.shape[:2], far, dtype=D),
            farthest_m=1e4,
        )
        found.append(sight_table(camera, around, {"ahead": (0.0, 0.0)})["ahead"]["sight"].alone)
    torch.testing.assert_close(found[1][:3], 1000 * found[0][:3], rtol=1e-6, atol=0)
    torch.testing.assert_close(found[1][3:], found[0][3:], rtol=1e-9, atol=0)
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
    torch.testing.assert_close(error, error[:, :1].expand(6, 5), rtol=1e-6, atol=0)
    # nothing but sky: the prior of 1 in units of 0.1
    assert error[:2].flatten().tolist() == pytest.approx([10.0] * 10)
    assert float(error[4:].max()) < 0.2 * float(error[0, 0])


def test_the_picture_shows_the_map(camera, over_ground):
    yaw, pitch, error = sight_map(camera, over_ground, rows=4, columns=6)
    figure = mount_sphere(yaw, pitch, error, "expected error", {"found": (0.3, 1.0)})
    shown = figure.axes[0].collections[0].get_array()
    assert shown is not None
    # drawn with up at the top: pitch falls from the bottom row upwards
    assert sorted(shown.flatten().tolist()) == sorted(error.flatten().tolist())
    line = figure.axes[0].lines[-1]
    assert np.asarray(line.get_xydata()).tolist() == [[-0.3, -1.0]]
    plt.close(figure)
