"""Gradients of frames from the slopes of every ray's light: kept, or worked out again; and which
rays visit what."""

import pytest
import torch

from codesign import lens, pose, render
from codesign.errors import GradientError
from codesign.render import pixel_means
from codesign.render.wavefront import look, shade
from codesign.types import Rays
from scenes import worlds
from tests.numbers import close, rand64, randn64

FRAMES = 3


def plane():
    return render.TexturedPlane([[0.4, 0.1], [-0.2, 0.5]], [0.3, 0.2], [0.1, 0.7], 90.0)


@pytest.fixture
def rays(generator):
    """Eight rays of two pixels about the camera's axis, in float64, with all of their numbers
    asking."""
    aside = 0.2 * randn64(generator, 8, 2)
    direction = torch.nn.functional.normalize(
        torch.cat([aside, torch.ones(8, 1).double()], 1), dim=1
    )
    origin = 0.01 * randn64(generator, 8, 3)
    weight = 0.5 + rand64(generator, 8)
    return [value.requires_grad_() for value in (origin, direction, weight)]


@pytest.fixture
def motion(generator):
    """Twists of a camera and of an object."""
    return [(0.05 * randn64(generator, FRAMES, 6)).requires_grad_() for _ in range(2)]


def pictures(origin, direction, weight, camera, thing):
    """Two pixels of a camera three metres before a plane; another plane moves before it in the
    second frame, and behind it in the others."""
    behind = torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)
    behind[:, 2, 3] = torch.tensor([0.8, -0.8, 0.8])
    scene = render.MovingScene(plane(), {"thing": (plane(), behind @ pose.se3_exp(thing))})
    down = pose.look_at((0.0, 0.0, -3.0), (0.0, 0.0, 0.0), down=(0, 1, 0))
    return shade(Rays(origin, direction, weight), scene, down @ pose.se3_exp(camera), 4)


def test_gradient_to_rays_weights_and_poses_of_camera_and_object_is_that_of_differences(
    rays, motion
):
    assert torch.autograd.gradcheck(pictures, (*rays, *motion))


def test_what_memory_does_not_hold_is_worked_out_again_frame_by_frame(rays, motion, monkeypatch):
    inputs = (*rays, *motion)
    seed = torch.linspace(-1, 1, 2 * FRAMES, dtype=torch.float64).reshape(FRAMES, 2)
    kept = torch.autograd.grad(pictures(*inputs), inputs, seed)
    monkeypatch.setattr(pixel_means, "KEPT", 0.0)
    again = torch.autograd.grad(pictures(*inputs), inputs, seed)
    for a, b in zip(kept, again, strict=True):  # the frames' sums are added in another order
        close(a, b, rtol=1e-13, atol=1e-13 * float(a.abs().max()))


def test_room_is_given_back_with_the_graph(rays, motion):
    before = pixel_means.ROOM.taken
    image = pictures(*rays, *motion)
    assert pixel_means.ROOM.taken - before == 7 * 8 * 8 * FRAMES  # numbers, bytes, rays, frames
    del image
    assert pixel_means.ROOM.taken == before
    with torch.no_grad():
        pictures(*rays, *motion)
    assert pixel_means.ROOM.taken == before


def test_second_derivatives_are_refused(rays, motion):
    (grad,) = torch.autograd.grad(pictures(*rays, *motion).sum(), motion[:1], create_graph=True)
    with pytest.raises(GradientError, match="first derivatives only"):
        grad.sum().backward()


def by_difference(shift):
    poses = pose.look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0)).repeat(2, 1, 1)
    poses = torch.cat([poses[:, :3, :3], poses[:, :3, 3:] + shift[:, None]], 2)
    poses = torch.cat([poses, torch.tensor([0.0, 0, 0, 1]).double().expand(2, 1, 4)], 1)
    behind = render.Camera(lens.Pinhole(8.0), 4, 4, 0.1, 2)
    return render.frames(behind, worlds.smooth_plane(), poses, "difference")


@pytest.mark.parametrize(
    "found",
    [
        lambda shift: render.project(
            render.Camera(lens.Pinhole(8.0), 4, 4, 0.1, 1), 1 + shift[None]
        ),
        by_difference,
    ],
    ids=["project", "difference"],
)
def test_gradients_at_a_point_that_is_held_have_none_of_their_own(found):
    """Hessians of squares would lack what the point's own motion adds."""
    with pytest.raises(GradientError, match="has none of its own"):
        torch.autograd.functional.hessian(
            lambda shift: found(shift).square().sum(), torch.zeros(3).double()
        )


@pytest.mark.parametrize("shape", ["sphere", "rectangle", "cube"])
def test_box_around_a_scene_takes_no_ray_from_it(shape, generator):
    """Rays from before, inside and behind, at the shape and past it, some along its box's faces."""
    glow = {"type": "area", "radiance": {"type": "uniform", "value": 7.0}}
    scene = render.MitsubaScene({"thing": {"type": shape, "emitter": glow}}).two_sided()
    origin = 3 * randn64(generator, 4000, 3)
    target = 1.2 * (2 * rand64(generator, 4000, 3) - 1)
    target[::4] = target[::4].round()
    direction = torch.nn.functional.normalize(target - origin, dim=1)
    still = torch.eye(4, dtype=torch.float64)[None, None], torch.zeros(4000, dtype=torch.long)
    light, distance = look(scene, *still, origin, direction)
    scene._box = None
    again, same = look(scene, *still, origin, direction)
    assert torch.equal(light, again)
    assert torch.equal(distance, same)
    assert 0.05 < (light == 7.0).double().mean() < 0.95


def test_a_ray_without_a_slope_counts_none_and_leaves_the_others_theirs():
    """As one that touches a ball: infinite slopes of roots against each other."""
    import drjit as dr
    from drjit.llvm.ad import Array3f, Float

    def shown(origin, direction):
        return 2 * direction.y + dr.sqrt(origin.x) - dr.sqrt(origin.x), Array3f(0, 0, 1)

    with dr.suspend_grad():
        light, _, to_origin, to_direction = pixel_means.with_slopes(shown)(
            Array3f(Float([0, 1]), 0, 0), Array3f(0, Float([3, 4]), 1)
        )
    assert light.numpy().tolist() == [6, 8]
    assert to_origin.numpy().tolist() == [[0, 0], [0, 0], [0, 0]]
    assert to_direction.numpy().tolist() == [[0, 0], [0, 2], [0, 0]]
