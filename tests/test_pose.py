"""Rigid motions against the matrix exponential, differences, and the axes the camera promises."""

import math

import pytest
import torch

from codesign.errors import ShapeError
from codesign.pose import apply, check_pose, check_poses, inverse, look_at, se3_exp
from codesign.render import Camera, project
from tests import refusals
from tests.numbers import D, close, f64, randn64


def wedge(twist):
    """4 x 4 matrix whose exponential is the transform: [[w]x, v; 0, 0]."""
    v = twist[:3]
    w = twist[3:]
    m = torch.zeros(4, 4, dtype=D)
    m[:3, :3] = torch.linalg.cross(w.expand(3, 3), torch.eye(3, dtype=D), dim=1).T
    m[:3, 3] = v
    return m


@pytest.mark.parametrize(
    "angle", [0.0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-4, 1e-3, 1e-2, 0.3, 1.0, 2.5, 3.1415, math.pi, 4.0]
)
def test_exponential_is_that_of_the_matrix(angle, generator):
    for _ in range(3):
        axis = torch.nn.functional.normalize(randn64(generator, 3), dim=0)
        twist = torch.cat([randn64(generator, 3), angle * axis])
        # torch's Pade form is good to some 1e-15 of a norm of at most 5
        close(se3_exp(twist), torch.linalg.matrix_exp(wedge(twist)), atol=2e-14)


def test_a_quarter_turn_about_z_with_translation_by_hand():
    # left Jacobian of a quarter turn: (2/pi) [[1, -1], [1, 1]]
    found = se3_exp(f64([1.0, 0, 0.5, 0, 0, math.pi / 2]))
    truth = f64([[0, -1, 0, 2 / math.pi], [1, 0, 0, 2 / math.pi], [0, 0, 1, 0.5], [0, 0, 0, 1]])
    close(found, truth, atol=1e-15)


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-5, 0.5, 2.0])
def test_gradcheck(scale, generator):
    twist = (scale * randn64(generator, 2, 6)).requires_grad_()
    # steps of 1e-6: differences are good to 1e-9
    assert torch.autograd.gradcheck(se3_exp, twist, atol=1e-8)


def test_inverse_and_apply(generator):
    transform = se3_exp(randn64(generator, 4, 2, 6))
    points = randn64(generator, 4, 2, 7, 3)
    close(inverse(transform) @ transform, torch.eye(4, dtype=D).expand(4, 2, 4, 4), atol=1e-14)
    homogeneous = torch.cat([points, torch.ones_like(points[..., :1])], -1)
    close(
        apply(transform, points),
        torch.einsum("...ij,...nj->...ni", transform, homogeneous)[..., :3],
        atol=1e-14,
    )


def test_the_gradient_of_the_inverse_is_that_of_differences_and_of_the_group(generator):
    transform = se3_exp(randn64(generator, 2, 3, 6))
    # any change of the entries, as differences see it: the formula is quadratic, so central ones
    # are exact
    entries = transform.clone().requires_grad_()
    assert torch.autograd.gradcheck(inverse, entries, eps=1e-2, rtol=0, atol=1e-12)
    weights = randn64(generator, transform.shape)
    # a rigid change T exp(w): the inverse becomes exp(-w) T^-1, whose derivative is -[w] T^-1
    twist = torch.zeros(2, 3, 6, dtype=D, requires_grad=True)
    (found,) = torch.autograd.grad((inverse(transform @ se3_exp(twist)) * weights).sum(), twist)
    for k in range(6):
        truth = (-wedge(torch.eye(6, dtype=D)[k]) @ torch.linalg.inv(transform) * weights).sum(
            (-2, -1)
        )
        close(found[..., k], truth, atol=1e-12)


def test_constant_twists_give_constant_transforms():
    assert not se3_exp(torch.zeros(3, 6, dtype=D)).requires_grad
    assert se3_exp(torch.zeros(6)).dtype == torch.float32


def test_look_at_makes_a_rigid_camera_with_right_down_forward(thin_camera):
    origin = (1.0, -4.0, 2.0)
    target = (0.5, 1.0, 1.0)
    pose = look_at(origin, target)
    check_poses(pose[None])
    assert float(torch.linalg.det(pose[:3, :3])) == pytest.approx(1, abs=1e-14)
    forward = f64(target) - f64(origin)
    close(pose[:3, 2], forward / forward.norm(), atol=1e-15)
    assert abs(float(pose[2, 0])) <= 1e-15  # the image's rows are level
    assert float(pose[2, 1]) < 0  # down in the image is down in the world
    # seen from y = -4 towards +y, world +x is to the right and world +z up
    world = f64([target, (0.7, 1.0, 1.0), (0.5, 1.0, 1.2)])
    pixels = project(thin_camera, apply(inverse(pose), world))
    close(pixels[0], thin_camera.film.middle_px, atol=1e-9)
    assert float(pixels[1, 0]) > float(pixels[0, 0]) + 1
    assert float(pixels[2, 1]) < float(pixels[0, 1]) - 1


@pytest.fixture
def thin_camera():
    from codesign.lens import Pinhole

    return Camera(Pinhole(8.0), 64, 48, 0.05, 1)


@refusals.table(__file__, "poses")
def test_what_is_no_pose_is_refused(row):
    row.holds(globals())


def test_a_camera_may_look_straight_down():
    straight_down = look_at((0, 0, 2), (0, 0, 0), down=(0, -1, 0))
    close(straight_down[:3, :3], f64([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]), atol=1e-15)


@pytest.mark.parametrize("part", [(slice(None), slice(3)), slice(0)])
def test_poses_of_another_shape_are_refused(part):
    with pytest.raises(ShapeError, match="poses must be"):
        check_poses(torch.eye(4, dtype=D).repeat(2, 1, 1)[part])


@refusals.table(__file__, "one pose among others")
@pytest.mark.parametrize("place", [(0, 0), (1, 2)])
def test_one_bad_pose_among_good_ones_is_refused(row, place, generator):
    good = se3_exp(randn64(generator, 2, 3, 6))
    assert check_poses(good) is good
    for part in (..., place[0]):

        def looked_at(change, part=part):
            bad = good.clone()
            bad[place] = change(good[place])
            check_poses(bad[part])

        row.holds(globals() | {"looked_at": looked_at})


def test_a_single_pose_is_one_matrix(generator):
    pose = se3_exp(randn64(generator, 6))
    assert torch.equal(check_pose(pose), pose)
