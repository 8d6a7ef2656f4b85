"""Views, flow and occlusion with moving objects against closed forms."""

import numpy as np
import pytest
import torch

from codesign import backend, lens, render
from codesign.pose import apply, inverse, look_at, se3_exp
from codesign.render import (
    Camera,
    MitsubaScene,
    MovingScene,
    flow_and_occlusion,
    true_flow,
    view,
)
from scenes import worlds
from tests.numbers import D, close, f64, randn64
from tests.render.differences import assert_gradients
from tests.render.planes import plane
from tests.render.solids import area


def emitting(radiance=100.0, **description):
    light = area(radiance)
    return MitsubaScene({"shape": {**description, "emitter": light}})


def rectangle(half_width_m, half_height_m):
    """A rectangle in z = 0 that faces +z."""
    scale = backend.mitsuba().ScalarTransform4f().scale([half_width_m, half_height_m, 1])
    return emitting(type="rectangle", to_world=scale)


def sphere(radius, **more):
    return emitting(type="sphere", radius=radius, **more)


def world_rays(cam, pose):
    """Eye [3] or [n, 3] and directions [n, 3] of the chief rays of all pixels, world axes."""
    rays = cam.chief_rays(cam.film.pixels())
    return apply(pose, rays.origin_m).detach(), (rays.direction @ pose[:3, :3].T).detach()


def ball_ahead(eye, ray, centre, radius):
    """Distance [n] of a ball along rays, and the root [n] that is negative where they miss it: its
    quadratic."""
    off = eye - centre
    b = (ray * off).sum(1)
    root = b.square() - off.square().sum(1) + radius**2
    return -b - root.clamp_min(0).sqrt(), root


def shifted(*offsets):
    T = torch.eye(4, dtype=D).repeat(len(offsets), 1, 1)
    T[:, :3, 3] = f64(offsets)
    return T


def above(height_m=2.0, count=1):
    """A camera over the origin that looks down, the world's +y downwards in its image."""
    return look_at((0, 0, height_m), (0, 0, 0), down=(0, 1, 0)).repeat(count, 1, 1)


def path(count=3):
    turn = f64([0.05, -0.03, 0.08, 0.02, -0.03, 0.05])
    return above()[0] @ se3_exp(torch.linspace(0, 1, count, dtype=D)[:, None] * turn)


def motion(count=3, height_m=0.4):
    turn = f64([-0.1, 0.06, 0.04, 0.05, 0.03, -0.1])
    pose = se3_exp(torch.linspace(0, 1, count, dtype=D)[:, None] * turn).clone()
    pose[:, 2, 3] += height_m
    return pose


# ---- views


def test_points_depth_normals_and_objects_of_a_view_by_hand():
    """A ball of 0.25 m at (0.1, 0, 0.5) over the ground, seen from 2 m; in frame 0 it is
    elsewhere."""
    cam = Camera(lens.Pinhole(8.0), 61, 41, 0.1, 1)
    centre = f64([0.1, 0.0, 0.5])
    places = shifted((3.0, 0, 0.5), centre.tolist())
    scene = MovingScene(plane(), {"ball": (sphere(0.25), places)})
    found = view(cam, scene, above(count=2), 1)
    eye, ray = world_rays(cam, above()[0])
    ahead, root = ball_ahead(eye, ray, centre, 0.25)
    meets = root > 0
    points = eye + torch.where(meets, ahead, -2 / ray[:, 2])[:, None] * ray
    clear = root.abs() > 1e-4  # not along the outline itself
    assert 100 < meets.sum() < 1500
    assert found.valid.all()
    assert torch.equal(found.object_id.reshape(-1)[clear], meets.long()[clear])
    up = f64([0.0, 0.0, 1.0])
    normal = torch.where(meets[:, None], (points - centre) / 0.25, up)
    # float32 geometry: 1e-7 of 2 m, divided by the cosine at the ball's rim (0.04 with the limit
    # above)
    for seen, truth, tolerance in (
        (found.points_world_m.reshape(-1, 3), points, 1e-5),
        (found.depth_m.reshape(-1, 1), 2 - points[:, 2:], 1e-5),
        (found.normal.reshape(-1, 3), normal, 1e-4),
    ):
        assert (seen - truth)[clear].norm(dim=1).max() <= tolerance
    assert not view(cam, scene, above(count=2), 0).object_id.any()


@pytest.mark.parametrize("kind", ["rectangle", "cube"])
def test_the_normal_of_a_mirrored_shape_is_on_the_side_that_glows(kind):
    mirrored = backend.mitsuba().ScalarTransform4f().scale([-1, 1, 1])
    scene = emitting(type=kind, to_world=mirrored)
    cam = Camera(lens.Pinhole(8.0), 3, 3, 0.1, 1)
    assert float(render.frames(cam, scene, above())[0, 1, 1]) == pytest.approx(100)
    normal = view(cam, scene, above(), 0).normal[1, 1]
    close(normal, f64([0.0, 0.0, 1.0]), atol=1e-6)


def test_pixels_that_meet_nothing_are_zero_and_without_object():
    found = view(Camera(lens.Pinhole(8.0), 33, 21, 0.1, 1), sphere(0.2), above(), 0)
    assert 0 < found.valid.sum() < 33 * 21
    assert torch.equal(found.object_id, torch.where(found.valid, 0, -1))
    for field in (found.points_world_m, found.depth_m, found.normal):
        assert not field[~found.valid].any()


# ---- flow


@pytest.mark.parametrize(
    ("card", "tolerance_px"), [(plane, 1e-9), (lambda: rectangle(3.0, 3.0), 1e-4)]
)
def test_flow_of_a_moving_plane_is_its_homography(card, tolerance_px):
    """Plane coordinates (X, Y, 1) to pixels (Hartley and Zisserman, 8.1)."""
    # asked for: 1e-3. Float32 geometry shifts a point along its ray by 2e-7 of 2 m, which shows as
    # less than 1e-5 px of flow
    cam = Camera(lens.Pinhole(8.0), 24, 16, 0.1, 1)
    flow, valid = true_flow(cam, MovingScene(plane(2, -3.0), {"card": (card(), motion())}), path())
    assert valid.all()
    K = f64([[80.0, 0, 11.5], [0, 80.0, 7.5], [0, 0, 1]])
    seen = K @ (inverse(path()) @ motion())[:, :3, [0, 1, 3]]
    pixels = cam.film.pixels()
    h = (
        torch.cat([pixels, torch.ones_like(pixels[:, :1])], 1)
        @ (seen[1:] @ torch.linalg.inv(seen[:-1])).mT
    )
    truth = (h[..., :2] / h[..., 2:] - pixels).mT
    torch.testing.assert_close(
        flow.flatten(2), truth, rtol=0, atol=tolerance_px, check_stride=False
    )


# ---- occlusion


@pytest.mark.parametrize("optics", [lens.Pinhole(8.0), lens.load("cooke-triplet").scaled(0.16)])
def test_a_card_that_moves_hides_what_it_comes_to_cover(optics):
    """A card of 0.3 x 0.2 m at half height, 0.25 m to the right and 0.06 m up between the frames:
    ground points are hidden where they lie in its later shadow."""
    cam = Camera(optics, 48, 40, 0.05, 1)
    offsets = f64([[-0.1, 0.02, 1.0], [0.15, -0.04, 1.0]])
    card = rectangle(0.15, 0.1)
    scene = MovingScene(
        worlds.ground(np.full((8, 8), 50.0, dtype=np.float32)),
        {"card": (card, shifted(*offsets.tolist()))},
    )
    found = flow_and_occlusion(cam, scene, above(count=2))
    seen = view(cam, scene, above(count=2), 0)
    eye, ray = world_rays(cam, above()[0])
    at = (eye + (1.0 - eye[:, 2:]) / ray[:, 2:] * ray)[:, :2]
    # positive inside the card
    inside = (f64([0.15, 0.1]) - (at - offsets[:, None, :2]).abs()).amin(2)
    clear = (inside.abs() > 1e-5).all(0) & seen.valid.reshape(-1)
    truth = (inside[0] < 0) & (inside[1] > 0)
    assert clear.sum() >= 1500
    assert 100 < truth.sum() < 1000
    assert torch.equal(found.occluded.reshape(-1)[clear], truth[clear])
    assert torch.equal(seen.object_id.reshape(-1)[clear], (inside[0] > 0).long()[clear])
    assert not bool((found.occluded & ~found.valid).any())
    still = (seen.object_id == 0) & seen.valid
    # the ground does not move
    assert found.flow_px[0][:, still].detach().abs().max() <= 1e-9


def test_points_of_a_ball_that_turns_are_hidden_when_they_face_away():
    """A point is hidden by its own ball when its normal points away from the eye."""
    cam = Camera(lens.Pinhole(8.0), 64, 48, 0.1, 1)
    objects = se3_exp(f64([[0.0] * 6, [0, 0, 0, 0, 0.9, 0]]))
    scene = MovingScene(plane(2, -1.0), {"ball": (sphere(0.4), objects)})
    found = flow_and_occlusion(cam, scene, above(count=2))
    seen = view(cam, scene, above(count=2), 0)
    later = apply(objects[1], seen.points_world_m.reshape(-1, 3))
    back = above()[0, :3, 3] - later
    facing = (back * later / 0.4).sum(1) / back.norm(dim=1)
    ball = seen.object_id.reshape(-1) == 1
    # the tolerance is 2e-6 x 2 m over the cosine, the ball's own depth behind the surface 0.8 m x
    # cosine: they part at cosines of 3e-3
    clear = ball & (facing.abs() > 5e-3)
    assert clear.sum() > 700
    assert (facing[clear] < 0).sum() > 100
    assert torch.equal(found.occluded.reshape(-1)[clear], facing[clear] < 0)
    assert not bool(found.occluded.reshape(-1)[~ball].any())


@pytest.mark.parametrize("world", ["room", "corridor", "outdoor"])
def test_a_pinhole_that_turns_about_itself_uncovers_nothing(world, generator):
    # what is in front of what along a ray through one point depends on that point alone; the rays
    # are other ones to float32, so rounding gets its chance
    cam = Camera(lens.Pinhole(3.0), 160, 120, 0.03, 1)
    turns = torch.zeros(3, 2, 6, dtype=D)
    turns[..., 3:] = 0.3 * randn64(generator, 3, 2, 3)
    poses = look_at(*worlds.VIEWS[world]) @ se3_exp(turns)
    found = flow_and_occlusion(cam, worlds.WORLDS[world](), poses)
    assert not bool(found.occluded.any())
    assert found.valid.sum() > 20_000


def test_gradients_of_flow_and_points_to_object_poses_camera_poses_and_lens(generator):
    geo = lens.load("cooke-triplet").scaled(0.2)
    weights = randn64(generator, 1, 2, 4, 5)
    cloud = randn64(generator, 4, 5, 4)

    def loss(twists, moved, curvature, thickness):
        optics = geo.replace(curvature_per_mm=curvature, thickness_mm=thickness)
        cam = Camera(optics, 5, 4, 0.8, 1)
        scene = MovingScene(plane(2, -3.0), {"card": (plane(), motion(2) @ se3_exp(twists))})
        poses = path(2) @ se3_exp(moved)
        found = view(cam, scene, poses, 1)
        flow, _ = true_flow(cam, scene, poses)
        points = (found.points_world_m * cloud[..., :3]).sum() + (
            found.depth_m * cloud[..., 3]
        ).sum()
        return (flow * weights).sum() + points

    twists = f64([[0.01, 0, 0, 0, 0.01, 0], [0.03, -0.02, 0.05, 0.01, -0.02, 0.03]])
    at = (
        twists,
        torch.zeros(2, 6, dtype=D),
        geo.curvature_per_mm.detach(),
        geo.thickness_mm.detach(),
    )
    # rounding: 1e-11 px over 1e-5; the projection's Jacobian is good to 1e-7
    assert_gradients(loss, at, (1e-5, 1e-5, 1e-6, 1e-4), 1e-6)
