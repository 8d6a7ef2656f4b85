"""The mount's map against rotation matrices written by hand, its limits, and its gradient."""

import math

import pytest
import torch

from codesign import lens, pose, render
from codesign.mount import Mount
from codesign.mount.pose import yaw_pitch_roll_rad
from codesign.pose import check_poses
from tests.numbers import D, close, f64, randn64

NOMINAL = (0.2, -0.1, 0.4)
HALF = (0.1, 0.05, 0.2)


@pytest.mark.parametrize("up", [1.0, -1.0])
def test_angles_of_a_view_straight_up_or_down_have_a_gradient(up):
    """There only yaw and roll together mean something: turned about the vertical by h, yaw grows by
    h, and the other two angles stay what they are."""
    upright = torch.eye(4, dtype=D)  # a camera's z axis is the body's: straight up
    upright[1:3, 1:3] *= up
    # along no axis, so that both entries of the matrix carry the slope
    angle = f64(0.4)

    def turned(h):
        zero = torch.zeros_like(h)
        return yaw_pitch_roll_rad(
            pose.se3_exp(torch.stack([zero, zero, zero, zero, zero, h])) @ upright
        )

    step = 1e-5
    differences = (turned(angle + step) - turned(angle - step)) / (2 * step)
    slopes = torch.autograd.functional.jacobian(turned, angle)
    close(differences, f64([1.0, 0.0, 0.0]), atol=1e-10)
    close(slopes, differences, atol=1e-10)
    yaw, pitch, roll = turned(0 * angle).tolist()
    again = Mount(NOMINAL, HALF, yaw_rad=yaw, pitch_rad=pitch, roll_rad=roll)().detach()
    close(again[:3, :3], upright[:3, :3], atol=1e-15)


def test_positions_stay_in_the_box_and_rotations_are_free(generator):
    numbers = 4 * randn64(generator, 200, 6)
    poses = Mount(NOMINAL, HALF)(numbers).detach()
    check_poses(poses)
    offset = (poses[:, :3, 3] - f64(NOMINAL)).abs() / f64(HALF)
    assert offset.max() <= 1 + 1e-15
    assert offset.max() > 0.99  # the whole box is in reach
    assert poses[:, 2, 2].min() < -0.9  # and every direction: down and
    assert poses[:, 2, 2].max() > 0.9  # up


def test_start_position_is_kept_and_a_zero_range_holds_an_axis():
    mount = Mount(NOMINAL, (0.1, 0.0, 0.2), position_m=(0.25, -0.1, 0.25))
    close(mount().detach()[:3, 3], f64([0.25, -0.1, 0.25]), atol=1e-15)
    moved = mount(torch.full((6,), 2.0, dtype=D))
    assert moved[1, 3] == -0.1


# straight down, where yaw and roll are one, is no special case
@pytest.mark.parametrize("pitch", [0.3, math.pi / 2])
def test_gradient_of_the_pose(generator, pitch):
    mount = Mount(NOMINAL, HALF, yaw_rad=0.4, pitch_rad=pitch)
    numbers = (0.5 * randn64(generator, 2, 6)).requires_grad_()
    assert torch.autograd.gradcheck(mount, (numbers,), atol=1e-8)
    jacobian = torch.autograd.functional.jacobian(mount, torch.zeros(6, dtype=D))
    assert torch.linalg.matrix_rank(jacobian.reshape(16, 6)) == 6


def far_points(camera, mount, depth_m):
    """Points in body axes under a lattice of pixels."""
    pixels = camera.film.pixels()[::7]
    rays = camera.chief_rays(pixels)
    length = (depth_m - rays.origin_m[:, 2:]) / rays.direction[:, 2:]
    return pose.apply(mount(), rays.origin_m + length * rays.direction).detach()


@pytest.mark.parametrize("optics", ["pinhole", "cooke-triplet"])
@pytest.mark.parametrize("depth_m", [0.8, 3.0])
@pytest.mark.parametrize("position_m", [NOMINAL, (0.25, -0.09, 0.3)])
@torch.no_grad()
def test_a_unit_of_every_number_moves_the_image_by_the_natural_step(optics, depth_m, position_m):
    optic = lens.Pinhole(11.0) if optics == "pinhole" else lens.load(optics).scaled(0.22)
    camera = render.Camera(optic, 48, 36, 0.15, 1)
    mount = Mount(NOMINAL, HALF, yaw_rad=0.4, pitch_rad=0.6, position_m=position_m)
    mount.numbers[3:] = f64([0.2, -0.1, 0.3])
    before = mount().clone()
    assert mount.variables(camera, depth_m, step_px=0.1)[0] is mount.numbers
    close(mount(), before, atol=1e-15)
    unit = mount.unit.clone()
    mount.variables(camera, depth_m, step_px=0.1)  # asked again it says the same
    close(mount.unit, unit, rtol=1e-12)
    points = far_points(camera, mount, depth_m)
    base = render.project(camera, pose.apply(pose.inverse(mount()), points))
    for i in range(6):
        mount.numbers[i] += 1
        moved = render.project(camera, pose.apply(pose.inverse(mount()), points)) - base
        mount.numbers[i] -= 1
        # a larger step meets the walls of the box
        assert float(moved.square().sum(1).nanmean().sqrt()) == pytest.approx(0.1, rel=0.1)


def test_held_and_weak_numbers_keep_their_unit():
    camera = render.Camera(lens.Pinhole(11.0), 8, 8, 0.5, 1)
    mount = Mount(NOMINAL, (0.1, 0.0, 1e-6))
    mount.variables(camera, 100.0)
    assert mount.unit[1:3].tolist() == [1.0, 1.0]
    other = Mount(NOMINAL, (0.1, 0.0, 1e-6))
    other.load_state_dict(mount.state_dict())
    assert torch.equal(other(), mount())
    assert torch.equal(other.unit, mount.unit)


def test_depths_of_a_picture_count_where_there_is_a_surface():
    camera = render.Camera(lens.Pinhole(11.0), 8, 8, 0.5, 1)
    depth = torch.full((64,), 2.0, dtype=D)
    depth[:20] = math.nan
    depth[20:24] = -1.0
    found = Mount(NOMINAL, (0.4, 0.3, 0.2))
    found.variables(camera, depth)
    same = Mount(NOMINAL, (0.4, 0.3, 0.2))
    same.variables(camera, 2.0)
    # a shift across the view moves every pixel alike
    close(found.unit[1:3], same.unit[1:3], rtol=1e-9)
    # pixels per metre at 2 m: 11 mm / 0.5 mm / 2 m
    assert same.unit[1:3].tolist() == pytest.approx([1 / (11 * 0.3), 1 / (11 * 0.2)], rel=1e-6)


def test_a_mount_says_where_it_is():
    mount = Mount((0.1, 0.0, 0.5), (0.1, 0.1, 0.1), yaw_rad=math.radians(20), pitch_rad=math.pi / 4)
    assert repr(mount) == "Mount(at 0.1, 0, 0.5 m, yaw, pitch, roll 20, 45, 0 degrees)"
    assert repr(lens.ThinLens(8.0, 2.0)) == "ThinLens(8 mm, entrance pupil 2 mm)"
