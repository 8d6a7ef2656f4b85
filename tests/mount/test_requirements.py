"""What a mount has to keep, against trigonometry and counting, and slopes against differences."""

import math

import pytest
import torch

from codesign import lens, render
from codesign.mount import Body, CableSide, Clearance, Housing, LookAhead, Mount, penalty
from scenes import bodies
from tests.numbers import D, close, randn64

HEIGHT = 0.4
STILL = (0.0, 0.0, 0.0)


def mount_at(pitch_rad, position=(0.0, 0.0, HEIGHT), **angles):
    return Mount(position, STILL, pitch_rad=pitch_rad, **angles)().detach()


@pytest.fixture(scope="module")
def cube():
    box = bodies.box((0.2, 0.2, 0.2), (0.0, 0.0, 0.0))
    return Body([(box.vertices_m, box.faces)])


def test_clearance_is_that_of_the_housing_less_the_margin(cube, camera):
    kept = Clearance(cube, Housing(0.03), margin_m=0.02)
    assert float(kept.slack(mount_at(0.3), camera)) == pytest.approx(
        HEIGHT - 0.1 - 0.03 - 0.02, abs=1e-14
    )
    assert float(kept.exact(mount_at(0.3, (0.12, 0.0, 0.0)), camera)) == pytest.approx(
        -0.03, abs=1e-14
    )


@pytest.mark.parametrize("angle_deg", [5, 29.9, 30.1, 90, 179])
def test_the_cable_side_is_an_angle(camera, angle_deg):
    """A camera pitched down by p has its back p above the rear: from straight back it is p away."""
    requirement = CableSide((-2.0, 0.0, 0.0), math.radians(30))
    slack = float(requirement.slack(mount_at(math.radians(angle_deg)), camera))
    assert (slack >= 0) == (angle_deg >= 30)
    over = math.radians(angle_deg - 30)
    assert float(requirement.exact(mount_at(math.radians(angle_deg)), camera)) == pytest.approx(
        over, abs=1e-12
    )
    if abs(over) < 0.01:
        assert slack == pytest.approx(over, abs=over**2)  # cos to second order over sin 30 degrees


def beyond(camera, T_body_cam, distance_m):
    """Whether each pixel sees beyond: rays followed to the ground one by one."""
    rays = camera.chief_rays(camera.film.pixels())
    found = []
    for direction in (rays.direction.double() @ T_body_cam[:3, :3].mT).tolist():
        x, _, z = T_body_cam[:3, 3].tolist()
        if z + 1e9 * direction[2] > 0:
            found.append(direction[0] >= 0)
        else:
            found.append(direction[0] >= 0 and x - z / direction[2] * direction[0] >= distance_m)
    return torch.tensor(found)


@pytest.mark.parametrize(
    "angles", [{}, {"roll_rad": 0.3}, {"yaw_rad": 0.8}, {"yaw_rad": 2.0, "roll_rad": -1.0}]
)
@pytest.mark.parametrize("pitch_rad", [-0.4, 0.2, 0.6, 1.3])
def test_what_looks_ahead_is_counted(camera, pitch_rad, angles):
    pose = mount_at(pitch_rad, (0.2, -0.1, HEIGHT), **angles)
    for distance_m in (2.0, 0.15):  # the camera is beyond the latter
        ahead = LookAhead(distance_m, share=0.25)
        counted = beyond(camera, pose, distance_m)
        assert torch.equal(ahead.angles(pose, camera) >= 0, counted)


@pytest.mark.parametrize("share", [0.001, 0.1, 0.5, 0.77, 1.0])
def test_the_exact_answer_changes_with_the_last_pixel(camera, share):
    """Over pitches, a share of the picture is kept exactly as long as so many pixels are
    counted."""
    ahead = LookAhead(1.5, share=share)
    for pitch in torch.linspace(0.0, 1.2, 30).tolist():
        pose = mount_at(pitch)
        counted = int(beyond(camera, pose, 1.5).sum())
        assert (float(ahead.exact(pose, camera)) >= 0) == (counted >= share * 384 - 1e-9)


def requirements(cube):
    return (
        Clearance(cube, Housing(0.03, behind_m=0.06), margin_m=0.2),
        CableSide((-1.0, 0.0, 0.2), 1.0, step=0.5),
        LookAhead(2.0, share=0.4, smooth=0.2),
    )


def test_gradient_of_every_slack_to_the_mount(cube, camera, generator):
    mount = Mount((0.0, 0.0, HEIGHT), (0.2, 0.2, 0.1), pitch_rad=0.3, roll_rad=0.1)
    numbers = (0.3 * randn64(generator, 6)).requires_grad_()
    for each in requirements(cube):
        # a difference of 1e-7 seldom swaps two ranks, and a swap of equal angles changes nothing to
        # first order
        assert torch.autograd.gradcheck(
            lambda x, r=each: r.slack(mount(x), camera), (numbers,), eps=1e-7, atol=1e-6
        ), each.name


def test_gradient_of_the_look_ahead_to_the_focal_length():
    ahead = LookAhead(2.0, share=0.2, smooth=0.2)
    pose = mount_at(0.5, roll_rad=0.1)
    focal = torch.tensor(3.4, dtype=D, requires_grad=True)

    def slack(value):
        return ahead.slack(pose, render.Camera(lens.Pinhole(value), 24, 16, 0.2, 1)).sum()

    assert torch.autograd.gradcheck(slack, focal, eps=1e-5, rtol=1e-6, atol=1e-12)
    (slope,) = torch.autograd.grad(slack(focal), focal)
    assert slope < -1e-3  # a longer lens sees less of the far ground


def test_penalty_pushes_before_the_limit_and_is_smooth(cube, camera):
    wanted = Clearance(cube, Housing(0.03), step=0.05)
    height = torch.linspace(0.13, 0.25, 200, dtype=D, requires_grad=True)
    poses = mount_at(0.0).repeat(200, 1, 1)
    poses[:, 2, 3] = height
    found = penalty([wanted], poses, camera)
    over = (1 - (height.detach() - 0.13) / 0.05).clamp_min(0)
    close(found.detach(), over**2, atol=1e-12)
    (slope,) = torch.autograd.grad(found.sum(), height)
    close(slope, -2 * over / 0.05, atol=1e-9)
    assert not penalty([], poses, camera).any()
