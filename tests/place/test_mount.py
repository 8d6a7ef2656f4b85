"""The mount's map against rotation matrices written by hand, its limits, and its gradient."""

import math

import pytest
import torch

from codesign.errors import DomainError, ShapeError
from codesign.place import Mount
from codesign.place.mount import yaw_pitch_roll_rad
from codesign.pose import check_poses

D = torch.float64
NOMINAL = (0.2, -0.1, 0.4)
HALF = (0.1, 0.05, 0.2)


def axes(mount):
    """Camera x (right), y (down), z (view) in body axes."""
    return mount().detach()[:3, :3].unbind(1)


@pytest.mark.parametrize(
    ("angles", "right", "view"),
    [
        ({}, (0, -1, 0), (1, 0, 0)),  # level, forward: image right is the body's right
        ({"yaw_rad": math.pi / 2}, (1, 0, 0), (0, 1, 0)),  # yaw turns the view to the left
        ({"pitch_rad": math.pi / 2}, (0, -1, 0), (0, 0, -1)),  # pitch tilts it down
        ({"roll_rad": math.pi / 2}, (0, 0, -1), (1, 0, 0)),
        ({"yaw_rad": math.pi / 2, "pitch_rad": math.pi / 6}, (1, 0, 0), (0, math.cos(math.pi / 6), -0.5)),
    ],
)
def test_known_attitudes(angles, right, view):
    x, y, z = axes(Mount(NOMINAL, HALF, **angles))
    torch.testing.assert_close(x, torch.tensor(right, dtype=D), rtol=0, atol=1e-15)
    torch.testing.assert_close(z, torch.tensor(view, dtype=D), rtol=0, atol=1e-15)
    torch.testing.assert_close(y, torch.linalg.cross(z, x), rtol=0, atol=1e-15)


def test_angles_are_read_back(generator):
    for yaw, pitch, roll in (
        (torch.rand(20, 3, generator=generator, dtype=D) * 2 - 1) * torch.tensor([3.1, 1.5, 3.1], dtype=D)
    ).tolist():
        mount = Mount(NOMINAL, HALF, yaw_rad=yaw, pitch_rad=pitch, roll_rad=roll)
        torch.testing.assert_close(
            yaw_pitch_roll_rad(mount().detach()),
            torch.tensor([yaw, pitch, roll], dtype=D),
            rtol=0,
            atol=1e-13,
        )  # atan2 near the pole: rounding over cos 1.5


def test_positions_stay_in_the_box_and_rotations_are_free(generator):
    numbers = 4 * torch.randn(200, 6, generator=generator, dtype=D)
    poses = Mount(NOMINAL, HALF)(numbers).detach()
    check_poses(poses)
    offset = (poses[:, :3, 3] - torch.tensor(NOMINAL, dtype=D)).abs() / torch.tensor(HALF, dtype=D)
    assert float(offset.max()) <= 1 + 1e-15
    assert float(offset.max()) > 0.99  # the whole box is in reach
    assert float(poses[:, 2, 2].min()) < -0.9  # and every direction: down and
    assert float(poses[:, 2, 2].max()) > 0.9  # up


def test_start_position_is_kept_and_a_zero_range_holds_an_axis():
    mount = Mount(NOMINAL, (0.1, 0.0, 0.2), position_m=(0.25, -0.1, 0.25))
    torch.testing.assert_close(
        mount().detach()[:3, 3], torch.tensor([0.25, -0.1, 0.25], dtype=D), rtol=0, atol=1e-15
    )
    moved = mount(torch.full((6,), 2.0, dtype=D))
    assert float(moved[1, 3]) == -0.1


@pytest.mark.parametrize(
    "pitch", [0.3, math.pi / 2]
)  # straight down, where yaw and roll are one, is no special case
def test_gradient_of_the_pose(generator, pitch):
    mount = Mount(NOMINAL, HALF, yaw_rad=0.4, pitch_rad=pitch)
    numbers = (0.5 * torch.randn(2, 6, generator=generator, dtype=D)).requires_grad_()
    assert torch.autograd.gradcheck(mount, (numbers,), atol=1e-8)
    jacobian = torch.autograd.functional.jacobian(mount, torch.zeros(6, dtype=D))
    assert torch.linalg.matrix_rank(jacobian.reshape(16, 6)) == 6


def test_a_moving_body_carries_its_camera():
    mount = Mount((0.2, 0.0, 0.4), HALF, pitch_rad=math.pi / 2)
    turned = torch.tensor(
        [[0.0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=D
    )  # body at (5, 6), heading +y
    pose = mount.in_world(turned).detach()
    torch.testing.assert_close(pose[:3, 3], torch.tensor([5.0, 6.2, 0.4], dtype=D), rtol=0, atol=1e-15)
    torch.testing.assert_close(
        pose[:3, 1], torch.tensor([0.0, -1, 0], dtype=D), rtol=0, atol=1e-15
    )  # image down is backward


@pytest.mark.parametrize(
    ("make", "error", "sentence"),
    [
        (lambda: Mount((0, 0, math.nan), HALF), DomainError, "nominal_m"),
        (lambda: Mount(NOMINAL, (0.1, -0.1, 0.1)), DomainError, "at least 0"),
        (lambda: Mount(NOMINAL, HALF, yaw_rad=math.inf), DomainError, "yaw_rad"),
        (
            lambda: Mount(NOMINAL, HALF, position_m=(0.31, -0.1, 0.4)),
            DomainError,
            "not strictly inside the allowed box",
        ),
        (lambda: Mount((0, 0), HALF), ShapeError, "three numbers"),
        (lambda: Mount(NOMINAL, HALF)(torch.zeros(5, dtype=D)), ShapeError, r"\[..., 6\]"),
        (lambda: Mount(NOMINAL, HALF)(torch.full((6,), math.nan, dtype=D)), DomainError, "last finite"),
    ],
)
def test_bad_input_gets_a_sentence(make, error, sentence):
    with pytest.raises(error, match=sentence):
        make()
