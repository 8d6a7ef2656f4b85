"""Views, flow and occlusion with moving objects against closed forms, and the checks of a view."""

import numpy as np
import pytest
import torch

from codesign import backend, lens, render
from codesign.errors import ShapeError
from codesign.pose import apply, inverse, look_at, se3_exp
from codesign.render import (
    Camera,
    MitsubaScene,
    MovingScene,
    TexturedPlane,
    check_view,
    flow_and_occlusion,
    project,
    true_flow,
    view,
)
from scenes import textures, worlds
from tests.render.differences import assert_gradients
from tests.render.fitted_lenses import OPTICS, PITCH_MM, SENSOR_PX

D = torch.float64


def plane(seed=1, height_m=0.0):
    T = torch.eye(4, dtype=D)
    T[2, 3] = height_m
    return TexturedPlane(*textures.waves(seed, finest_period_m=0.2), T_world_plane=T)


def emitting(radiance=100.0, **description):
    bitmap = backend.mitsuba().Bitmap(np.full((2, 2, 1), radiance, dtype=np.float32))
    return MitsubaScene(
        {
            "shape": {
                **description,
                "emitter": {"type": "area", "radiance": {"type": "bitmap", "bitmap": bitmap, "raw": True}},
            }
        }
    )


def rectangle(half_width_m, half_height_m):
    """A rectangle in z = 0 that faces +z."""
    return emitting(
        type="rectangle",
        to_world=backend.mitsuba().ScalarTransform4f().scale([half_width_m, half_height_m, 1]),
    )


def shifted(*offsets):
    T = torch.eye(4, dtype=D).repeat(len(offsets), 1, 1)
    T[:, :3, 3] = torch.tensor(offsets, dtype=D)
    return T


def above(height_m=2.0, count=1):
    """A camera over the origin that looks down, the world's +y downwards in its image."""
    return look_at((0, 0, height_m), (0, 0, 0), down=(0, 1, 0)).repeat(count, 1, 1)


def path(count=3):
    turn = torch.tensor([0.05, -0.03, 0.08, 0.02, -0.03, 0.05], dtype=D)
    return above()[0] @ se3_exp(torch.linspace(0, 1, count, dtype=D)[:, None] * turn)


def motion(count=3, height_m=0.4):
    turn = torch.tensor([-0.1, 0.06, 0.04, 0.05, 0.03, -0.1], dtype=D)
    pose = se3_exp(torch.linspace(0, 1, count, dtype=D)[:, None] * turn).clone()
    pose[:, 2, 3] += height_m
    return pose


# ---- views


def test_points_depth_normals_and_objects_of_a_view_by_hand():
    # a ball of 0.25 m at (0.1, 0, 0.5) over the ground, seen from 2 m: rays by similar triangles, the ball by
    # its quadratic
    cam = Camera(lens.Pinhole(8.0), 61, 41, 0.1, 1)
    centre = torch.tensor([0.1, 0.0, 0.5], dtype=D)
    scene = MovingScene(
        plane(), {"ball": (emitting(type="sphere", radius=0.25), shifted((3.0, 0, 0.5), centre.tolist()))}
    )
    found = view(cam, scene, above(count=2), 1)
    slope = (cam.film.pixels() - cam.film.middle_px) * 0.1 / 8.0
    ray = torch.cat([slope, torch.ones(slope.shape[0], 1, dtype=D)], 1) @ above()[0, :3, :3].T
    ray = ray / ray.norm(dim=1, keepdim=True)
    off = torch.tensor([0.0, 0.0, 2.0], dtype=D) - centre
    b = ray @ off
    root = b.square() - off @ off + 0.25**2
    meets = root > 0
    distance = torch.where(meets, -b - root.clamp_min(0).sqrt(), -2 / ray[:, 2])
    points = torch.tensor([0.0, 0.0, 2.0], dtype=D) + distance[:, None] * ray
    clear = root.abs() > 1e-4  # not along the outline itself
    assert 100 < int(meets.sum()) < 1500
    assert bool(found.valid.all())
    assert torch.equal(found.object_id.reshape(-1)[clear], meets.long()[clear])
    # float32 geometry: 1e-7 of 2 m, divided by the cosine at the ball's rim (0.04 with the limit above)
    assert float((found.points_world_m.reshape(-1, 3) - points)[clear].norm(dim=1).max()) <= 1e-5
    assert float((found.depth_m.reshape(-1) - (2 - points[:, 2]))[clear].abs().max()) <= 1e-5
    normal = torch.where(meets[:, None], (points - centre) / 0.25, torch.tensor([0.0, 0.0, 1.0], dtype=D))
    assert float((found.normal.reshape(-1, 3) - normal)[clear].norm(dim=1).max()) <= 1e-4
    assert torch.equal(
        view(cam, scene, above(count=2), 0).object_id, torch.zeros(41, 61, dtype=torch.long)
    )  # the ball is elsewhere in frame 0


@pytest.mark.parametrize("name", OPTICS)
def test_points_of_a_view_project_to_their_pixels(name):
    cam = Camera(
        OPTICS[name](),
        *SENSOR_PX,
        PITCH_MM,
        1,
        film=render.Film(*SENSOR_PX, 9, 7, PITCH_MM, ((0, 0), (168, 126), (300, 40))),
    )
    radius = 0.016 if name == "la1509" else 0.1  # a field of 2 degrees, or 20
    scene = MovingScene(
        plane(2, -0.5),
        {"ball": (emitting(type="sphere", radius=radius), path(2)[1:] @ shifted((0.0, 0.0, 1.6)))},
    )
    found = view(cam, scene, path(2)[1:], 0)
    assert found.depth_m.shape == (3, 7, 9)
    assert set(found.object_id[found.valid].unique().tolist()) == {0, 1}
    back = project(cam, apply(inverse(path(2)[1]), found.points_world_m[found.valid]))
    assert int(found.valid.sum()) >= 120
    assert (
        float((back - cam.film.pixels()[found.valid.reshape(-1)]).detach().abs().max()) <= 1e-9
    )  # the point is on the ray to rounding, wherever float32 put the surface


def test_pixels_that_meet_nothing_are_zero_and_without_object():
    found = view(Camera(lens.Pinhole(8.0), 33, 21, 0.1, 1), emitting(type="sphere", radius=0.2), above(), 0)
    assert 0 < int(found.valid.sum()) < 33 * 21
    assert torch.equal(found.object_id, torch.where(found.valid, 0, -1))
    for field in (found.points_world_m, found.depth_m, found.normal):
        assert not field[~found.valid].any()
    with pytest.raises(ShapeError, match="frame 1 of a sequence of 1"):
        view(Camera(lens.Pinhole(8.0), 4, 4, 0.1, 1), plane(), above(), 1)


# ---- flow


def pixel_homography(camera_pose, plane_pose, K):
    """Plane coordinates (X, Y, 1) to pixels (Hartley and Zisserman, 8.1)."""
    T = np.linalg.inv(camera_pose.numpy()) @ plane_pose.numpy()
    return K @ T[:3, [0, 1, 3]]


@pytest.mark.parametrize(("card", "tolerance_px"), [(plane, 1e-9), (lambda: rectangle(3.0, 3.0), 1e-4)])
def test_flow_of_a_moving_plane_is_its_homography(card, tolerance_px):
    # asked for: 1e-3. Float32 geometry shifts a point along its ray by 2e-7 of 2 m, which shows as less than
    # 1e-5 px of flow
    cam = Camera(lens.Pinhole(8.0), 24, 16, 0.1, 1)
    poses = path()
    objects = motion()
    flow, valid = true_flow(cam, MovingScene(plane(2, -3.0), {"card": (card(), objects)}), poses)
    assert bool(valid.all())
    K = np.array([[80.0, 0, 11.5], [0, 80.0, 7.5], [0, 0, 1]])
    pixels = cam.film.pixels().numpy()
    for k in range(2):
        H = pixel_homography(poses[k + 1], objects[k + 1], K) @ np.linalg.inv(
            pixel_homography(poses[k], objects[k], K)
        )
        h = np.concatenate([pixels, np.ones_like(pixels[:, :1])], 1) @ H.T
        np.testing.assert_allclose(
            flow[k].numpy(), (h[:, :2] / h[:, 2:] - pixels).T.reshape(2, 16, 24), rtol=0, atol=tolerance_px
        )


# ---- occlusion


@pytest.mark.parametrize("optics", ["pinhole", "cooke-triplet"])
def test_a_card_that_moves_hides_what_it_comes_to_cover(optics):
    # a card 0.3 x 0.2 m at half height, 0.25 m to the right and 0.06 m up between the frames; ground points
    # are hidden where they lie in its later shadow
    cam = Camera(
        lens.Pinhole(8.0) if optics == "pinhole" else lens.load(optics).scaled(0.16), 48, 40, 0.05, 1
    )
    offsets = torch.tensor([[-0.1, 0.02, 1.0], [0.15, -0.04, 1.0]], dtype=D)
    scene = MovingScene(
        worlds.ground(np.full((8, 8), 50.0, dtype=np.float32)),
        {"card": (rectangle(0.15, 0.1), shifted(*offsets.tolist()))},
    )
    found = flow_and_occlusion(cam, scene, above(count=2))
    seen = view(cam, scene, above(count=2), 0)
    rays = cam.chief_rays(cam.film.pixels())  # by hand, in world axes, for the ground's points
    R = above()[0, :3, :3]
    eye = apply(above()[0], rays.origin_m).detach()
    ray = (rays.direction @ R.T).detach()
    inside = []
    for offset in offsets:
        at = (eye + (1.0 - eye[:, 2:]) / ray[:, 2:] * ray)[:, :2] - offset[:2]
        inside.append((torch.tensor([0.15, 0.1], dtype=D) - at.abs()).amin(1))  # positive inside the card
    clear = (inside[0].abs() > 1e-5) & (inside[1].abs() > 1e-5) & seen.valid.reshape(-1)
    truth = (inside[0] < 0) & (inside[1] > 0)
    assert int(clear.sum()) >= 1500
    assert 100 < int(truth.sum()) < 1000
    assert torch.equal(found.occluded.reshape(-1)[clear], truth[clear])
    assert torch.equal(seen.object_id.reshape(-1)[clear], (inside[0] > 0).long()[clear])
    assert not bool((found.occluded & ~found.valid).any())
    assert (
        float(found.flow_px[0][:, (seen.object_id == 0) & seen.valid].detach().abs().max()) <= 1e-9
    )  # the ground does not move


def test_points_of_a_ball_that_turns_are_hidden_when_they_face_away():
    # a point is hidden by its own ball when its normal points away from the eye: closed form, with no other
    # surface nearer
    cam = Camera(lens.Pinhole(8.0), 64, 48, 0.1, 1)
    poses = above(count=2)
    objects = torch.stack([torch.eye(4, dtype=D), se3_exp(torch.tensor([0, 0, 0, 0, 0.9, 0], dtype=D))])
    scene = MovingScene(plane(2, -1.0), {"ball": (emitting(type="sphere", radius=0.4), objects)})
    found = flow_and_occlusion(cam, scene, poses)
    seen = view(cam, scene, poses, 0)
    local = seen.points_world_m.reshape(-1, 3)
    later = apply(objects[1], local)
    facing = ((poses[1, :3, 3] - later) * later / 0.4).sum(1) / (poses[1, :3, 3] - later).norm(dim=1)
    ball = seen.object_id.reshape(-1) == 1
    # the tolerance is 2e-6 x 2 m over the cosine, the ball's own depth behind the surface 0.8 m x cosine:
    # they part at cosines of 3e-3
    clear = ball & (facing.abs() > 5e-3)
    assert int(clear.sum()) > 700
    assert torch.equal(found.occluded.reshape(-1)[clear], facing[clear] < 0)
    assert int((facing[clear] < 0).sum()) > 100
    assert not bool(found.occluded.reshape(-1)[~ball].any())


@pytest.mark.parametrize("world", ["room", "corridor", "outdoor"])
def test_a_pinhole_that_turns_about_itself_uncovers_nothing(world, generator):
    # what is in front of what along a ray through one point depends on that point alone; the rays are other
    # ones to float32, so rounding gets its chance
    cam = Camera(lens.Pinhole(3.0), 160, 120, 0.03, 1)
    scene = worlds.WORLDS[world]()
    n = 0
    for _ in range(3):
        turns = 0.3 * torch.randn(2, 3, generator=generator, dtype=D)
        found = flow_and_occlusion(
            cam,
            scene,
            look_at(*worlds.VIEWS[world]) @ se3_exp(torch.cat([torch.zeros_like(turns), turns], 1)),
        )
        assert not bool(found.occluded.any())
        n += int(found.valid.sum())
    assert n > 20_000


# ---- checks of a view


def test_good_views_pass():
    cam = Camera(lens.load("cooke-triplet").scaled(0.1), 32, 24, 0.1, 4)
    check_view(
        cam,
        worlds.room(),
        torch.stack([look_at((0.5, -1.2, 1.4), (0, 1, 0.8)), look_at((-0.5, -1.0, 1.0), (0, 1, 0.8))]),
    )
    check_view(
        cam, MovingScene(plane(2, -1.0), {"ball": (emitting(type="sphere", radius=0.2), motion())}), path()
    )
    below = look_at((0, 0, -2.0), (0, 0, 0), down=(0, 1, 0))
    check_view(cam, plane(), below[None])  # planes shine to both sides
    dome = emitting(type="sphere", radius=5.0, flip_normals=True)
    check_view(cam, dome, above())  # a ball that shines inwards may hold the camera


def test_gradients_of_flow_and_points_to_object_poses_camera_poses_and_lens(generator):
    geo = lens.load("cooke-triplet").scaled(0.2)
    weights = torch.randn(1, 2, 4, 5, generator=generator, dtype=D)
    cloud = torch.randn(4, 5, 4, generator=generator, dtype=D)

    def loss(twists, moved, curvature, thickness):
        optics = geo.replace(curvature_per_mm=curvature, thickness_mm=thickness)
        cam = Camera(optics, 5, 4, 0.8, 1)
        scene = MovingScene(plane(2, -3.0), {"card": (plane(), motion(2) @ se3_exp(twists))})
        poses = path(2) @ se3_exp(moved)
        found = view(cam, scene, poses, 1)
        flow, _ = true_flow(cam, scene, poses)
        points = (found.points_world_m * cloud[..., :3]).sum() + (found.depth_m * cloud[..., 3]).sum()
        return (flow * weights).sum() + points

    twists = torch.tensor([[0.01, 0, 0, 0, 0.01, 0], [0.03, -0.02, 0.05, 0.01, -0.02, 0.03]], dtype=D)
    at = (twists, torch.zeros(2, 6, dtype=D), geo.curvature_per_mm.detach(), geo.thickness_mm.detach())
    # rounding: 1e-11 px over 1e-5; the projection's Jacobian is good to 1e-7
    assert_gradients(loss, at, (1e-5, 1e-5, 1e-6, 1e-4), 1e-6)


def test_flow_of_a_moving_ball_and_of_the_ground_behind_it():
    cam = Camera(lens.Pinhole(8.0), 48, 32, 0.1, 1)
    poses = path(2)
    objects = shifted((0.0, 0.0, 0.5), (0.0, 0.0, 0.5)) @ se3_exp(
        torch.tensor([[0.0] * 6, [0.06, -0.04, 0.05, 0.1, -0.2, 0.3]], dtype=D)
    )
    scene = MovingScene(plane(), {"ball": (emitting(type="sphere", radius=0.25), objects)})
    flow, valid = true_flow(cam, scene, poses)
    seen = view(cam, scene, poses, 0)
    rays = cam.chief_rays(cam.film.pixels())
    eye = poses[0, :3, 3]
    ray = rays.direction @ poses[0, :3, :3].T
    off = eye - objects[0, :3, 3]
    b = ray @ off
    root = (b.square() - off @ off + 0.25**2).reshape(32, 48)
    # a few pixels from the outline, where the surface is nearly along the ray
    ball = (root > 1e-3) & (seen.object_id == 1)
    assert int(ball.sum()) > 200
    where = eye + (-b - root.reshape(-1).clamp_min(0).sqrt())[:, None] * ray
    later = apply(objects[1] @ inverse(objects[0]), where)
    cam_later = apply(inverse(poses[1]), later)
    to = cam_later[:, :2] / cam_later[:, 2:] * 80.0 + cam.film.middle_px
    truth = (to - cam.film.pixels()).T.reshape(2, 32, 48)
    # asked for; float32 depth over the cosine of 0.1 moves points by 2e-6 m, 1e-5 px
    assert float((flow[0] - truth).abs().amax(0)[ball].max()) <= 1e-3
    still, _ = true_flow(cam, plane(), poses)
    ground = seen.object_id == 0
    # the ground flows as if there were no ball
    torch.testing.assert_close(flow[0][:, ground], still[0][:, ground], rtol=0, atol=1e-12)
    assert bool(valid.all())
