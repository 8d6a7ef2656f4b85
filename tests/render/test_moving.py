"""Moving objects: the same world seen from the object's own axes, what is nearest by hand, gradients to
object poses, and what is refused."""

import math

import numpy as np
import pytest
import torch

from codesign import backend, lens, render
from codesign.pose import inverse, look_at, se3_exp
from codesign.render import Camera, MitsubaScene, MovingScene, TexturedPlane
from scenes import textures
from tests.render.differences import assert_gradients

D = torch.float64
FOCAL_MM = 8.0
PITCH_MM = 0.1


def camera(width=24, height=16, samples=1, optics=None):
    return Camera(optics or lens.Pinhole(FOCAL_MM), width, height, PITCH_MM, samples)


def start():
    return look_at((0.2, 0.1, 2.0), (0.0, 0.0, 0.0), down=(0, 1, 0))


def path(count=3, scale=1.0):
    """A camera that moves in all six components."""
    return start() @ se3_exp(
        scale
        * torch.linspace(0, 1, count, dtype=D)[:, None]
        * torch.tensor([0.05, -0.03, 0.08, 0.02, -0.03, 0.05], dtype=D)
    )


def motion(count=3, height_m=0.0):
    """An object that moves in all six components about the point (0, 0, height)."""
    pose = se3_exp(
        torch.linspace(0, 1, count, dtype=D)[:, None]
        * torch.tensor([-0.1, 0.06, 0.04, 0.05, 0.03, -0.1], dtype=D)
    ).clone()
    pose[:, 2, 3] += height_m
    return pose


def plane(seed, height_m=0.0, dtype=D):
    T = torch.eye(4, dtype=D)
    T[2, 3] = height_m
    return TexturedPlane(*textures.waves(seed, finest_period_m=0.2), T_world_plane=T, dtype=dtype)


def shape(radiance, **description):
    """A Mitsuba scene of one shape with a constant radiance."""
    mi = backend.mitsuba()
    bitmap = mi.Bitmap(np.full((2, 2, 1), radiance, dtype=np.float32))
    return {
        **description,
        "emitter": {"type": "area", "radiance": {"type": "bitmap", "bitmap": bitmap, "raw": True}},
    }


def test_an_object_is_seen_as_from_its_own_axes():
    # only relative motion is seen: the card before the wall through the moving camera is the still card
    # through the camera in the card's axes
    card = plane(1)
    objects = motion()
    scene = MovingScene(plane(2, -3.0), {"card": (card, objects)})
    geo = lens.load("cooke-triplet").scaled(0.08)
    for optics in (None, geo):
        found = render.frames(camera(12, 8, 4, optics), scene, path())
        truth = render.frames(camera(12, 8, 4, optics), card, inverse(objects) @ path())
        torch.testing.assert_close(
            found, truth, rtol=1e-12, atol=0
        )  # the poses are multiplied in another order: rounding times the phase gradient
    assert not torch.allclose(found[0], found[2], rtol=1e-2)


@pytest.mark.parametrize(("dtype", "tolerance", "spared"), [(D, 1e-11, 0), (torch.float32, 5e-4, 2)])
def test_of_two_planes_that_cross_the_nearer_is_seen(dtype, tolerance, spared):
    # float32: phases round by 1e-7 of some 2 m at 30 rad/m; pixels whose ray passes the crossing line itself
    # may go either way
    lying = plane(1, 0.0, dtype)
    standing = plane(2, 0.0, dtype)
    tilt = se3_exp(torch.tensor([[0, 0, 0.02, 0.3, 0.9, 0.1], [0.1, 0, 0.05, 0.3, 1.1, 0.1]], dtype=D))
    poses = path(2)
    cam = camera(40, 30)
    found = render.frames(cam, MovingScene(lying, {"standing": (standing, tilt)}), poses).double()
    rays = cam.chief_rays(cam.film.pixels())
    for t in range(2):
        light = []
        distance = []
        for own, texture in ((torch.eye(4, dtype=D), lying), (tilt[t], standing)):
            view = np.linalg.inv(own.numpy()) @ poses[t].numpy()
            origin = view[:3, 3]
            direction = rays.direction.numpy() @ view[:3, :3].T
            s = -origin[2] / direction[:, 2]
            x = origin[:2] + s[:, None] * direction[:, :2]
            light.append(
                100
                * np.exp(
                    np.cos(2 * math.pi * x @ texture.frequency.numpy().T + texture.phase.numpy())
                    @ texture.amplitude.numpy()
                )
            )
            distance.append(np.where(s > 0, s, np.inf))
        truth = np.where(distance[0] <= distance[1], light[0], light[1])
        assert 0.2 < (distance[1] < distance[0]).mean() < 0.8  # both are in the picture
        wrong = np.abs(found[t].numpy().ravel() / truth - 1) > tolerance
        assert wrong.sum() <= spared


def test_a_ball_moved_by_its_poses_is_the_ball_built_there():
    centres = torch.tensor([[-0.3, 0.0, 0.4], [0.1, 0.1, 0.5], [0.4, -0.2, 0.3]], dtype=D)
    ground = {"type": "rectangle", "to_world": backend.mitsuba().ScalarTransform4f().scale([3, 3, 1])}
    poses = torch.eye(4, dtype=D).repeat(3, 1, 1)
    poses[:, :3, 3] = centres
    ball = MitsubaScene({"ball": shape(200.0, type="sphere", radius=0.25)})
    scene = MovingScene(MitsubaScene({"ground": shape(50.0, **ground)}), {"ball": (ball, poses)})
    cam = camera(64, 48, 4)
    found = render.frames(cam, scene, path())
    assert found.dtype == torch.float32
    for t, centre in enumerate(centres.tolist()):
        whole = MitsubaScene(
            {"ground": shape(50.0, **ground), "ball": shape(200.0, type="sphere", center=centre, radius=0.25)}
        )
        truth = render.frames(cam, whole, path()[[t]])[0]
        assert 100 < int((truth > 199).sum()) < 2000  # the ball is in the picture, with ground about it
        # rays along the outline round by 1e-7 of 2 m, 1e-5 px: of some 150 x 4 samples there one may change
        # side
        assert int(((found[t] - truth).abs() > 0.01).sum()) <= 1


@pytest.mark.bits
def test_nearest_of_several_objects_and_the_background_where_nothing_is_met():
    away = look_at((0, 0, 2.0), (0, 0, 5.0), down=(0, 1, 0))[None]

    def ball(radiance):
        return MitsubaScene({"ball": shape(radiance, type="sphere", radius=0.2)})

    def at(x, z):
        return torch.eye(4, dtype=D)[None] + torch.tensor(
            [[0, 0, 0, x], [0, 0, 0, 0], [0, 0, 0, z], [0, 0, 0, 0]], dtype=D
        )

    scene = MovingScene(
        TexturedPlane([[1.0, 0.0]], [0.0], [0.0], mean=70.0),
        {"far": (ball(10.0), at(0.0, 5.0)), "near": (ball(20.0), at(0.1, 4.0))},
    )
    middle = render.frames(camera(33, 3), scene, away)[
        0, 1
    ]  # 0.025 m per pixel at the near ball, whose middle is 4 pixels to one side
    values = [round(v, 3) for v in middle.tolist()]
    assert set(values) == {10.0, 20.0, 70.0}
    assert (
        values.count(20.0) == 17
    )  # 0.2 m at 2 m under 8 mm: tan of the cone 0.2 / sqrt(4 - 0.04) = 8.04 px each way
    assert values[0] == values[-1] == 70.0
    assert MovingScene(plane(1), {}).names == ()
    assert torch.equal(
        render.frames(camera(), MovingScene(plane(1), {}), path()), render.frames(camera(), plane(1), path())
    )


@pytest.mark.parametrize("order", [(2.0, 3.0, 2.5), (3.0, 2.0, 2.5), (2.5, 3.0, 2.0), (3.0, 2.5, 2.0)])
def test_the_nearest_of_many_is_seen_whatever_their_order(order):
    still = torch.eye(4, dtype=D)[None]
    cards = {}
    for number, distance_m in enumerate(order):
        pose = still.clone()
        pose[0, 2, 3] = distance_m
        flat = TexturedPlane([[1.0, 0.0]], [0.0], [0.0], mean=100.0 * distance_m)
        cards[str(number)] = (flat, pose)
    wall = torch.eye(4, dtype=D)
    wall[2, 3] = 9.0
    scene = MovingScene(TexturedPlane([[1.0, 0.0]], [0.0], [0.0], mean=1.0, T_world_plane=wall), cards)
    image = render.frames(camera(5, 4), scene, still)
    torch.testing.assert_close(image, torch.full_like(image, 200.0), rtol=1e-12, atol=0)


def test_gradients_to_the_pose_of_a_textured_mesh_object(generator):
    # one per cent is asked of float32 scenes; bilinear texels have kinks, which the softened picture keeps
    # small; silhouettes lie outside the view
    mi = backend.mitsuba()
    cam = camera(32, 24, 16)
    picture = textures.softened(textures.photo("brick", 256), 3.0)
    bitmap = mi.Bitmap(np.ascontiguousarray(picture[:, :, None]))
    card = MitsubaScene(
        {
            "card": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale([1.5, 1.5, 1]),
                "emitter": {"type": "area", "radiance": {"type": "bitmap", "bitmap": bitmap, "raw": True}},
            }
        }
    )
    weights = torch.randn(2, 24, 32, generator=generator, dtype=D)
    objects = motion(2)
    poses = path(2)

    def loss(twist):
        scene = MovingScene(plane(2, -3.0), {"card": (card, objects @ se3_exp(twist))})
        return (render.frames(cam, scene, poses).double() * weights).sum()

    assert_gradients(loss, (torch.zeros(6, dtype=D),), (2e-4,), 0.01)


def test_gradients_to_object_poses_camera_poses_and_lens_in_double_precision(generator):
    geo = lens.load("cooke-triplet").scaled(0.08)
    weights = torch.randn(2, 8, 12, generator=generator, dtype=D)
    wall, card = plane(2, -3.0), plane(1)

    def loss(object_twist, twist, curvature):
        scene = MovingScene(wall, {"card": (card, motion(2) @ se3_exp(object_twist))})
        changed = geo.replace(curvature_per_mm=geo.curvature_per_mm.detach() * (1 + curvature))
        return (render.frames(camera(12, 8, 4, changed), scene, path(2) @ se3_exp(twist)) * weights).sum()

    # smooth textures: rounding of 1e-13 over 1e-6, as in test_gradients
    assert_gradients(loss, [torch.zeros(6, dtype=D)] * 3, [1e-6] * 3, 1e-7)
