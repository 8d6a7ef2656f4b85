"""Ground truth through the lens: closed-form flow, points under pixels, gradients, and where there
is no truth."""

from dataclasses import replace

import torch

from codesign import backend, lens
from codesign.pose import apply, inverse, look_at, se3_exp
from codesign.render import Camera, MitsubaScene, TexturedPlane, true_flow
from codesign.render.truth import flow_and_occlusion, view
from scenes import textures
from tests.numbers import D, close, f64
from tests.render.differences import assert_gradients


def start():
    return look_at((0.2, -2.0, 0.3), (0.0, 0.0, 0.1))


def motions(*twists):
    return start() @ se3_exp(f64(twists))


def upright_plane(normal_distance_m=0.0):
    """The plane y = 0 of the world, as worlds.wall has it."""
    T = torch.eye(4, dtype=D)
    T[:3, :3] = f64([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    T[1, 3] = normal_distance_m
    return TexturedPlane(*textures.waves(0), T_world_plane=T)


def test_what_leaves_the_field_or_meets_nothing_is_invalid_zero_and_without_gradient():
    geo = lens.load("cooke-triplet").scaled(0.2)
    away = look_at((0.0, -2.0, 0.0), (0.0, -4.0, 0.0))
    # turned by 69 degrees, far beyond the 20 of the lens; and before nothing
    for poses in (motions([0] * 6, [0, 0, 0, 0, 1.2, 0]), away.repeat(2, 1, 1)):
        flow, valid = true_flow(Camera(geo, 12, 10, 0.2, 1), upright_plane(), poses)
        assert not valid.any()
        assert not flow.any()
    poses = motions([0] * 6, [0, 0, 0, 0, 0.3, 0])

    def loss(twist, curvature, thickness):
        changed = geo.replace(curvature_per_mm=curvature, thickness_mm=thickness)
        # 17 degrees either side, turned by as much again
        flow, valid = true_flow(
            Camera(changed, 12, 10, 0.5, 1), upright_plane(), poses @ se3_exp(twist)
        )
        assert 0 < valid.sum() < valid.numel()
        return flow.square().sum()

    at = [torch.zeros(2, 6, dtype=D), geo.curvature_per_mm.detach(), geo.thickness_mm.detach()]
    # the points that leave the field carry no gradient, and the steps are too short to change which
    # they are
    assert_gradients(loss, at, (1e-6, 1e-7, 1e-5), 1e-5)


def test_points_of_one_flat_ground_never_hide_each_other():
    """Seen from 2 cm above it, out to cosines of incidence of a few thousandths, where single
    precision moves the point that a ray meets along the ground by its rounding over that cosine;
    the ground lies askew, so that all its coordinates round."""
    mi = backend.mitsuba()
    T_world_ground = se3_exp(f64([3.0, -2.0, 1.5, 0.5, 0.3, -0.4]))
    to_world = mi.ScalarTransform4f(T_world_ground.numpy()).scale([200, 200, 1])
    scene = MitsubaScene({"ground": {"type": "rectangle", "to_world": to_world}}, emissive=False)
    poses = torch.stack(
        [look_at((0.03 * k, 0.01 * k, 0.02), (8.0, 0.3 * k, 0.0)) for k in range(4)]
    )
    camera = Camera(lens.Pinhole(8.0), 48, 40, 0.1, 1)
    for stride in (1, 3):
        truth = flow_and_occlusion(camera, scene, T_world_ground @ poses, stride)
        assert truth.valid.sum() > 0.3 * truth.valid.numel()
        assert not truth.occluded.any()


def test_depth_is_measured_from_the_origin_of_the_camera_wherever_rays_start():
    class LongHood(lens.Pinhole):
        """Its rays start 5 cm before the pinhole."""

        def camera_rays(self, *args, **options):
            rays = super().camera_rays(*args, **options)
            return replace(
                rays, origin_m=rays.origin_m + 0.05 * rays.direction / rays.direction[:, 2:]
            )

    poses = motions([0.1, 0.0, 0.2, 0.0, 0.3, 0.1])
    plain, hooded = (
        view(Camera(kind(8.0), 12, 10, 0.5, 1), upright_plane(), poses, 0)
        for kind in (lens.Pinhole, LongHood)
    )
    truth = apply(inverse(poses[0]), hooded.points_world_m[hooded.valid])[:, 2]
    assert hooded.valid.sum() > 60
    close(hooded.depth_m[hooded.valid], truth, rtol=1e-12)
    close(hooded.depth_m, plain.depth_m, rtol=1e-12)
