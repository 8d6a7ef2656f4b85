"""Ground truth through the lens: closed-form flow, points under pixels, gradients, and where there is no
truth."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign import backend, lens, render
from codesign.errors import DomainError, ShapeError
from codesign.pose import apply, inverse, look_at, se3_exp
from codesign.render import Camera, MitsubaScene, TexturedPlane, true_flow
from codesign.render.truth import flow_and_occlusion, view, world_points
from scenes import textures, worlds
from scenes.build import GAP_M

D = torch.float64
WALL = np.full((8, 8), 50.0, dtype=np.float32)


def start():
    return look_at((0.2, -2.0, 0.3), (0.0, 0.0, 0.1))


def motions(*twists):
    return start() @ se3_exp(torch.tensor(twists, dtype=D))


def upright_plane(normal_distance_m=0.0):
    """The plane y = 0 of the world, as worlds.wall has it."""
    T = torch.eye(4, dtype=D)
    T[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=D)
    T[1, 3] = normal_distance_m
    return TexturedPlane(*textures.waves(0), T_world_plane=T)


def wall_homography(now, later, K):
    """Pixels of one view to pixels of another, for the plane y = 0: K (R - t n^T / d) K^-1 (Hartley and
    Zisserman, 13.1)."""
    relative = np.linalg.inv(later.numpy()) @ now.numpy()
    normal = now.numpy()[:3, :3].T @ np.array(
        [0.0, 1.0, 0.0]
    )  # n . X = d for points of the wall, in the first camera's axes
    distance = -now.numpy()[1, 3]
    return K @ (relative[:3, :3] + np.outer(relative[:3, 3], normal) / distance) @ np.linalg.inv(K)


@pytest.mark.parametrize(
    ("scene", "tolerance_px"), [(upright_plane, 1e-9), (lambda: worlds.wall(WALL), 1e-4)]
)
def test_pinhole_flow_of_a_wall_is_its_homography(scene, tolerance_px):
    # Mitsuba's geometry is float32: 2e-7 of 2 m moves a point along its ray only, and so shifts the flow by
    # less than 1e-5 px
    poses = motions([0] * 6, [0.03, -0.02, 0.05, 0.01, -0.02, 0.03], [0.05, 0.02, 0.08, 0.03, -0.01, 0.05])
    camera = Camera(lens.Pinhole(8.0), 20, 14, 0.1, 1)
    flow, valid = true_flow(camera, scene(), poses)
    assert bool(valid.all())
    K = np.array([[80.0, 0, 9.5], [0, 80.0, 6.5], [0, 0, 1]])
    pixels = camera.film.pixels().numpy()
    for k in range(2):
        h = (
            np.concatenate([pixels, np.ones_like(pixels[:, :1])], 1)
            @ wall_homography(poses[k], poses[k + 1], K).T
        )
        truth = (h[:, :2] / h[:, 2:] - pixels).T.reshape(2, 14, 20)
        np.testing.assert_allclose(flow[k].numpy(), truth, rtol=0, atol=tolerance_px)


def test_flow_points_right_and_down():
    # the camera moves left: the world moves right; it moves up: the world moves down
    camera = Camera(lens.Pinhole(8.0), 9, 7, 0.1, 1)
    left, _ = true_flow(camera, upright_plane(), motions([0] * 6, [-0.025, 0, 0, 0, 0, 0]))
    up, _ = true_flow(camera, upright_plane(), motions([0] * 6, [0, -0.025, 0, 0, 0, 0]))
    # 8 mm, 2 m, 0.025 m, 0.1 mm: 1 px straight ahead of a wall that is nearly square to the view
    assert float(left[0, 0, 3, 4]) == pytest.approx(1.0, abs=0.02)
    assert float(up[0, 1, 3, 4]) == pytest.approx(1.0, abs=0.02)
    assert abs(float(left[0, 1, 3, 4])) < 0.02


@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss"])
def test_flow_through_a_traced_lens_leads_to_the_same_point_of_the_wall(name):
    camera = Camera(lens.load(name).scaled(0.2), 12, 10, 0.2, 1)
    poses = motions([0] * 6, [0.03, -0.02, 0.05, 0.01, -0.02, 0.03])
    flow, valid = true_flow(camera, upright_plane(), poses)
    assert int(valid.sum()) >= 110
    pixels = camera.film.pixels()
    ends = pixels + flow[0].detach().reshape(2, -1).T
    meet = []
    for at, pose in ((pixels, poses[0]), (ends, poses[1])):  # by hand: where the chief ray crosses y = 0
        rays = camera.chief_rays(at)
        origin = apply(pose, rays.origin_m)
        direction = rays.direction @ pose[:3, :3].T
        meet.append((origin - direction * (origin[:, 1:2] / direction[:, 1:2])).detach())
    pixel_m = 0.2 / float(camera.lens.first_order().efl_mm.detach()) * 2.0
    miss_px = (meet[0] - meet[1]).norm(dim=1)[valid.reshape(-1)] / pixel_m
    assert float(miss_px.max()) <= 1e-9


def test_ignoring_the_distortion_of_the_lens_would_show():
    # the fisheye-like error of a pinhole of the same focal length, so that the test above means something
    camera = Camera(lens.load("cooke-triplet").scaled(0.2), 12, 10, 0.6, 1)
    poses = motions([0] * 6, [0.2, 0.0, 0.0, 0, 0, 0])
    traced, seen = true_flow(camera, upright_plane(), poses)
    pinhole, _ = true_flow(
        camera.with_lens(lens.Pinhole(camera.lens.first_order().efl_mm.detach())), upright_plane(), poses
    )
    assert float((traced - pinhole).detach().abs().amax(1)[seen].max()) > 0.02


def test_points_and_depths_under_pixels():
    camera = Camera(lens.Pinhole(8.0), 5, 5, 0.1, 1)
    pose = look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0))
    points, depth, valid = world_points(camera.chief_rays(camera.film.pixels()), upright_plane(0.5), pose)
    assert bool(valid.all())
    torch.testing.assert_close(depth, torch.full((25,), 2.5, dtype=D), rtol=1e-14, atol=0)
    offset = (camera.film.pixels() - 2) * 0.1 / 8.0 * 2.5
    truth = torch.stack([offset[:, 0], torch.full((25,), 0.5, dtype=D), -offset[:, 1]], 1)
    torch.testing.assert_close(points, truth, rtol=0, atol=1e-14)


def test_depth_of_a_sphere_in_the_room_by_hand():
    # the ball of the room, of radius 0.25 at (0.1, 0.5), rests just over the floor; seen from 1.5 m along -y
    # at its height the depth is 1.25 m
    height = 0.25 + GAP_M
    camera = Camera(lens.Pinhole(8.0), 1, 1, 0.1, 1)
    pose = look_at((0.1, -1.0, height), (0.1, 0.5, height))
    points, depth, valid = world_points(camera.chief_rays(camera.film.pixels()), worlds.room(), pose)
    assert valid.tolist() == [True]
    assert depth.item() == pytest.approx(1.25, abs=1e-6)  # float32 geometry
    assert points[0].tolist() == pytest.approx([0.1, 0.25, height], abs=1e-6)


def test_gradients_of_flow_to_lens_and_poses(generator):
    geo = lens.load("cooke-triplet").scaled(0.2)
    scene = upright_plane()
    base = start()
    weights = torch.randn(1, 2, 4, 5, generator=generator, dtype=D)

    def loss(curvature, thickness, twists):
        camera = Camera(geo.replace(curvature_per_mm=curvature, thickness_mm=thickness), 5, 4, 0.8, 1)
        return (true_flow(camera, scene, base @ se3_exp(twists))[0] * weights).sum()

    inputs = [
        geo.curvature_per_mm.detach(),
        geo.thickness_mm.detach(),
        torch.tensor([[0.01, 0, 0, 0, 0.01, 0], [0.03, -0.02, 0.05, 0.01, -0.02, 0.03]], dtype=D),
    ]
    leaves = [v.clone().requires_grad_() for v in inputs]
    found = torch.autograd.grad(loss(*leaves), leaves)
    for k, step in enumerate((1e-6, 1e-4, 1e-5)):
        truth = torch.zeros(inputs[k].numel(), dtype=D)
        for i in range(truth.numel()):
            shift = torch.zeros(inputs[k].numel(), dtype=D)
            shift[i] = step
            ahead, behind = (
                [v + s * shift.reshape(v.shape) if j == k else v for j, v in enumerate(inputs)]
                for s in (1, -1)
            )
            truth[i] = float((loss(*ahead) - loss(*behind)).detach()) / (2 * step)
        # rounding: 1e-11 px over 1e-5; the projection's Jacobian is good to 1e-7
        assert float((found[k].reshape(-1) - truth).norm() / truth.norm()) <= 1e-6


def test_what_leaves_the_field_or_meets_nothing_is_invalid_zero_and_without_gradient():
    geo = lens.load("cooke-triplet").scaled(0.2)
    camera = Camera(geo, 12, 10, 0.2, 1)
    turned = start() @ se3_exp(
        torch.tensor([0, 0, 0, 0, 1.2, 0], dtype=D)
    )  # by 69 degrees, far beyond the 20 of the lens
    flow, valid = true_flow(camera, upright_plane(), torch.stack([start(), turned]))
    assert not valid.any()
    assert not flow.any()
    away = look_at((0.0, -2.0, 0.0), (0.0, -4.0, 0.0))
    flow, valid = true_flow(camera, upright_plane(), torch.stack([away, away]))
    assert not valid.any()
    poses = torch.stack([start(), start() @ se3_exp(torch.tensor([0, 0, 0, 0, 0.3, 0], dtype=D))])

    def loss(twist, curvature, thickness):
        changed = geo.replace(curvature_per_mm=curvature, thickness_mm=thickness)
        # 17 degrees either side, turned by as much again
        flow, valid = true_flow(Camera(changed, 12, 10, 0.5, 1), upright_plane(), poses @ se3_exp(twist))
        assert 0 < int(valid.sum()) < valid.numel()
        return flow.square().sum()

    at = [torch.zeros(2, 6, dtype=D), geo.curvature_per_mm.detach(), geo.thickness_mm.detach()]
    leaves = [value.clone().requires_grad_() for value in at]
    found = torch.autograd.grad(loss(*leaves), leaves)
    for slot, (value, step) in enumerate(zip(at, (1e-6, 1e-7, 1e-5), strict=True)):
        way = torch.randn(value.shape, generator=torch.Generator().manual_seed(slot), dtype=D)
        ahead, behind = (
            float(loss(*(v + s * step * way if k == slot else v for k, v in enumerate(at))).detach())
            for s in (1, -1)
        )
        # the points that leave the field carry no gradient, and the steps are too short to change which they are
        assert float((found[slot] * way).sum()) == pytest.approx((ahead - behind) / (2 * step), rel=1e-5)


def test_static_cameras_have_no_flow():
    camera = Camera(lens.load("double-gauss").scaled(0.2), 6, 5, 0.2, 1)
    flow, valid = true_flow(camera, worlds.room(), start()[None].expand(3, 4, 4))
    assert bool(valid.all())
    assert float(flow.detach().abs().max()) <= 1e-9


@pytest.mark.parametrize("stride", [0, -1, 2, 5, 1.5, float("nan")])
def test_strides_without_a_later_pose_are_refused(stride):
    with pytest.raises(ShapeError, match="whole stride of at least 1"):
        true_flow(
            Camera(lens.Pinhole(8.0), 4, 4, 0.1, 1),
            upright_plane(),
            motions([0] * 6, [0.1] * 6),
            stride=stride,
        )


def test_poses_that_are_not_rigid_are_refused():
    with pytest.raises(DomainError, match="not rigid"):
        true_flow(Camera(lens.Pinhole(8.0), 4, 4, 0.1, 1), upright_plane(), 2 * motions([0] * 6, [0.1] * 6))


def test_windows_have_the_flow_of_the_full_frame():
    corners = ((0, 0), (13, 8))
    windows = render.Film(20, 14, 6, 5, 0.1, corners)
    poses = motions([0] * 6, [0.03, -0.02, 0.05, 0.01, -0.02, 0.03])
    full, _ = true_flow(Camera(lens.Pinhole(8.0), 20, 14, 0.1, 1), upright_plane(), poses)
    part, valid = true_flow(Camera(lens.Pinhole(8.0), 6, 5, 0.1, 1, film=windows), upright_plane(), poses)
    assert part.shape == (1, 2, 2, 5, 6)
    assert valid.shape == (1, 2, 5, 6)
    for k, (left, top) in enumerate(corners):
        torch.testing.assert_close(
            part[0, :, k], full[0, :, top : top + 5, left : left + 6], rtol=0, atol=1e-10
        )


def test_angles_of_the_field_survive_the_world(generator):
    # distances between points under pixels do not depend on where the camera stands
    camera = Camera(lens.Pinhole(8.0), 6, 6, 0.1, 1)
    pose = se3_exp(torch.randn(6, generator=generator, dtype=D))
    plane = upright_plane()
    moved = TexturedPlane(
        plane.frequency, plane.amplitude, plane.phase, T_world_plane=pose @ plane.T_world_plane
    )
    rays = camera.chief_rays(camera.film.pixels())
    a, _, _ = world_points(rays, plane, start())
    b, _, _ = world_points(rays, moved, pose @ start())
    torch.testing.assert_close(apply(inverse(pose), b), a, rtol=0, atol=1e-13)


def test_points_of_one_flat_ground_never_hide_each_other():
    """Seen from 2 cm above it, out to cosines of incidence of a few thousandths, where single precision moves the
    point that a ray meets along the ground by its rounding over that cosine; the ground lies askew, so that all its
    coordinates round."""
    mi = backend.mitsuba()
    T_world_ground = se3_exp(torch.tensor([3.0, -2.0, 1.5, 0.5, 0.3, -0.4], dtype=D))
    to_world = mi.ScalarTransform4f(T_world_ground.numpy()).scale([200, 200, 1])
    scene = MitsubaScene({"ground": {"type": "rectangle", "to_world": to_world}}, emissive=False)
    poses = torch.stack([look_at((0.03 * k, 0.01 * k, 0.02), (8.0, 0.3 * k, 0.0)) for k in range(4)])
    camera = Camera(lens.Pinhole(8.0), 48, 40, 0.1, 1)
    for stride in (1, 3):
        truth = flow_and_occlusion(camera, scene, T_world_ground @ poses, stride)
        assert int(truth.valid.sum()) > 0.3 * truth.valid.numel()
        assert not truth.occluded.any()


def test_nothing_is_seen_where_an_aperture_lets_no_light_through():
    """The chief ray of film height h crosses the last surface at 2 h / 97 mm (tests/render/test_camera.py)."""
    glass = lens.Glass.from_indices(1.5, 1.5, 1.5)
    front = lens.Surface(50.0, 3.0, glass, 9.0, is_stop=True)
    back = lens.Surface(math.inf, 95.0, None, 0.02)
    camera = Camera(lens.GeoLens([front, back], 4.0, soft_edge_mm=1e-6), 33, 25, 0.1, 1)
    path = torch.stack(
        [look_at((0.01 * k, 0.0, 2.0), (0.01 * k, 0.0, 0.0), down=(0, 1, 0)) for k in range(2)]
    )
    height_mm = camera.film_mm(camera.film.pixels()).norm(dim=1).reshape(25, 33)
    lit = 2 * height_mm / 97 < 0.02
    assert 0 < int(lit.sum()) < lit.numel()
    scene = TexturedPlane([[1.0, 0.0]], [0.0], [0.0])
    assert torch.equal(view(camera, scene, path[:1], 0).valid, lit)


def test_depth_is_measured_from_the_origin_of_the_camera_wherever_rays_start():
    class LongHood(lens.Pinhole):
        """Its rays start 5 cm before the pinhole."""

        def camera_rays(self, *args, **options):
            rays = super().camera_rays(*args, **options)
            return replace(rays, origin_m=rays.origin_m + 0.05 * rays.direction / rays.direction[:, 2:])

    poses = motions([0.1, 0.0, 0.2, 0.0, 0.3, 0.1])
    plain, hooded = (
        view(Camera(kind(8.0), 12, 10, 0.5, 1), upright_plane(), poses, 0)
        for kind in (lens.Pinhole, LongHood)
    )
    truth = apply(inverse(poses[0]), hooded.points_world_m[hooded.valid])[:, 2]
    assert int(hooded.valid.sum()) > 60
    torch.testing.assert_close(hooded.depth_m[hooded.valid], truth, rtol=1e-12, atol=0)
    torch.testing.assert_close(hooded.depth_m, plain.depth_m, rtol=1e-12, atol=0)
