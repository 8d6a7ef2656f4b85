"""Point spread functions of a camera, and frames by them, against closed forms and
traced frames."""

import math

import pytest
import torch

from codesign import lens, render
from codesign.lens import diffraction
from codesign.pose import look_at, se3_exp
from codesign.render.moving import views_of
from codesign.render.wavefront import light_and_nearness
from scenes import textures, worlds
from tests.numbers import D, close, f64, randn64
from tests.render.differences import assert_gradients
from tests.render.solids import area

PITCH_MM = 0.02
THIN = lens.ThinLens(10.0, 2.0).focus_at(1.0)
FRONT = look_at((0.0, 0.0, 2.0), (0, 0, 0), down=(0, 1, 0))  # of planes in z = 0


def triplet():
    return lens.load("cooke-triplet").scaled(0.22)


def camera(optics, width=48, height=40, samples=256, pitch_mm=PITCH_MM, **more):
    return render.Camera(optics, width, height, pitch_mm, samples, **more)


def waves(seed=0, finest_period_m=0.02, **more):
    return render.TexturedPlane(
        *textures.waves(seed, finest_period_m=finest_period_m, coarsest_period_m=0.2), **more
    )


def rms_share(found, truth):
    """RMS difference over the RMS contrast of the truth."""
    return float(((found - truth).square().mean().sqrt() / truth.std()).detach())


def test_blur_of_a_thin_lens_is_the_circle_of_confusion():
    psf = render.psf_map(camera(THIN), nearest_m=0.4)
    distance_m = f64([0.4, 0.5, 1.0, 3.0, math.inf])
    behind_mm = 1 / (1 / 10.0 - 1 / 1000.0)
    radius_px = 1.0 * behind_mm * (1 / (1e3 * distance_m) - 1 / 1000.0).abs() / PITCH_MM
    offsets = psf.offsets_px(1 / distance_m)
    # points in the middle of 16 x 16 equal parts of a disc: the outermost lie at 15/16 of its
    # radius
    torch.testing.assert_close(
        offsets.norm(dim=-1).amax(2), (radius_px * 15 / 16)[:, None].expand(5, 4)
    )
    # the second moment of a disc is its radius squared over 4; the parts' middles have 2 / 16^2
    # less of it
    second = radius_px**2 / 4 * (1 - 2 / 256)
    close(offsets.square().mean(2), second[:, None, None].expand(5, 4, 2), rtol=1e-6, atol=1e-9)
    energy = psf.energy(distance_m)
    at = torch.arange(energy.shape[-1], dtype=D) - energy.shape[-1] // 2
    found = (energy.sum(-1) * at**2).sum(-1)
    # a bilinear share adds the mean of f (1 - f), which is at most 1/4
    assert ((found >= second[:, None] - 1e-9) & (found <= second[:, None] + 0.25)).all()
    torch.testing.assert_close(energy.sum((-2, -1)), torch.ones(5, 4, dtype=D))


@pytest.mark.parametrize("optics", [triplet().focus_at(0.7), THIN, lens.Pinhole(10.0)])
def test_a_constant_stays_constant_whatever_the_depths(optics):
    even = worlds.blank_room(60.0)
    cam = camera(optics, 150, 100, pitch_mm=0.04)
    found = render.psf_frames(cam, even, look_at((0.5, -1, 1), (0, 2, 1))[None])
    close(found, torch.full_like(found, 60.0), rtol=1e-5)


def test_vignetting_is_that_of_traced_frames():
    even = render.TexturedPlane([[1.0, 0.0]], [0.0], [0.0])
    optics = lens.load("double-gauss").scaled(0.11)
    cam = camera(optics, 60, 45, 256, pitch_mm=0.1)
    traced = render.frames(cam, even, FRONT[None]).detach()
    assert traced.min() < 0.7 * traced.max()
    found = render.psf_frames(cam, even, FRONT[None]).detach()
    # an aperture's hard edge passes over the 16 x 16 points of the pupil up to a row at a time,
    # 1/16 of the light
    away = (found - traced).abs() / traced.max()
    assert away.max() < 1 / 16
    assert away.square().mean().sqrt() < 0.01


def plated():
    """Behind a plate of coma and trefoil, which has no symmetry that could hide a sign."""
    plate = diffraction.ZernikePlate({4: 0.3, 7: 0.8, 8: 0.9, 9: -0.6, 10: 0.6}, 0.9)
    return diffraction.with_plate(triplet().focus_at(0.56), plate, z_mm=0.3)


@pytest.mark.parametrize(
    "optics",
    [triplet(), triplet().focus_at(0.4), plated(), THIN],
    ids=["sharp", "blurred", "plated", "thin"],
)
def test_a_wall_is_as_traced(optics):
    cam = camera(optics)
    pose = (FRONT @ se3_exp(f64([0.1, 0.05, 0, 0.1, 0.05, 0.2])))[None]
    found = render.psf_frames(cam, waves(), pose)
    # 2 % are asked where blur changes slowly
    assert rms_share(found, render.frames(cam, waves(), pose)) < 0.005


def test_windows_colours_trajectories_and_lists_of_scenes_are_as_traced():
    film = render.Film(120, 80, 24, 20, PITCH_MM, ((0, 0), (90, 55)))
    lines = lens.Spectrum((0.4861327, 0.6562725), (0.5, 0.5))
    cam = camera(triplet().focus_at(0.7), 24, 20, film=film, spectrum=lines)
    poses = FRONT @ se3_exp(0.02 * torch.arange(36, dtype=D).reshape(2, 3, 6) / 36)
    scenes = [waves(0), waves(1)]
    found = render.psf_frames(cam, scenes, poses)
    assert found.shape == (2, 3, 2, 20, 24)
    assert rms_share(found, render.frames(cam, scenes, poses)) < 0.005


def test_a_frame_does_not_depend_on_those_beside_it():
    ahead = torch.zeros(3, 6, dtype=D)
    ahead[:, 2] = f64([0.0, 1.55, 0.8])  # metres towards the wall, which is at 2
    cam, poses = camera(THIN), FRONT @ se3_exp(ahead)
    found = render.psf_frames(cam, waves(), poses)
    alone = [render.psf_frames(cam, waves(), pose[None]) for pose in poses]
    close(found, torch.cat(alone), rtol=0, atol=0)
    # noise of the traced rays is ten times less
    assert rms_share(found, render.frames(cam, waves(), poses)) < 5e-4


def half_before(front, behind):
    """A card left of x = 0 at z = 1 before a wall at z = 0, both of one radiance."""
    T = worlds.backend.mitsuba().ScalarTransform4f

    def card(level, place):
        light = area(level)
        return {"type": "rectangle", "to_world": place, "emitter": light}

    near, far = T().translate([-2.0, 0, 1.0]).scale(2.0), T().scale(4.0)
    return render.MitsubaScene({"front": card(front, near), "behind": card(behind, far)})


ABOVE = look_at((0.0, 0.0, 1.5), (0, 0, 0), down=(0, 1, 0))


def test_more_rays_per_pixel_for_hard_edges():
    """The edge of a card before a pinhole: 16 rays per pixel are the means of the parts they lie
    in."""
    seen = (
        half_before(100.0, 50.0),
        (ABOVE @ se3_exp(f64([0, 0, 0, 0, 0, 0.3])))[None],
    )
    cam = camera(lens.Pinhole(10.0), 24, 20)
    few, many = (
        render.psf_frames(cam, *seen, render.psf_map(cam, rays_per_px=n))
        - render.frames(cam, *seen)
        for n in (4, 64)
    )
    # the share of a pixel behind an edge is known to half a row of points, 1 / 16, with 64 in a
    # square
    assert many.abs().max() < 50 / 16 + 0.5
    assert many.norm() < 0.5 * few.norm()


@pytest.mark.parametrize("blurred", ["front", "behind"])
def test_the_edge_of_a_near_card(blurred):
    """A blurred card before a sharp wall: the integral of a disc; a sharp card before a blurred
    wall: a sharp edge, nothing of the wall on the card."""
    cam = camera(lens.ThinLens(10.0, 2.0).focus_at(1.5 if blurred == "front" else 0.5), 41, 8)
    row = render.psf_frames(cam, half_before(100.0, 50.0), ABOVE[None])[0, 4]
    row = row if float(row[0]) > 75 else row.flip(0)
    x = torch.arange(41.0) - 20
    share = (row - 50) / 50
    if blurred == "behind":
        close(share[x < -1], torch.ones(19), atol=0.01)
        close(share[x > 1], torch.zeros(19), atol=0.01)
        return
    behind_mm = 1 / (1 / 10.0 - 1 / 1500.0)
    radius_px = behind_mm * (1 / 500.0 - 1 / 1500.0) / PITCH_MM
    t = (x / radius_px).clamp(-1, 1)
    disc = 0.5 - (t * (1 - t * t).sqrt() + t.asin()) / math.pi
    # a pupil of 64 x 64 points, a pixel of finite size
    close(share, disc, atol=0.02)


def functional(make, weights):
    """Scalar of frames of a slanted plane as a function of relative changes of curvature and
    thickness, and a twist; and its leaves."""
    nominal = triplet().focus_at(0.9)
    c = nominal.curvature_per_mm.detach()
    t = nominal.thickness_mm.detach()
    world = waves(3, 0.05)
    start = FRONT @ se3_exp(f64([0.1, 0, 0.6, 0.4, 0.2, 0.1]))

    def loss(curvature, thickness, twist):
        optics = nominal.replace(
            curvature_per_mm=c * (1 + curvature), thickness_mm=t * (1 + thickness)
        )
        return (make(camera(optics, 24, 20), world, (start @ se3_exp(twist))[None]) * weights).sum()

    return loss, [torch.zeros(6, dtype=D, requires_grad=True) for _ in range(3)]


def test_gradients_are_those_of_differences_and_near_those_of_traced_frames(generator):
    coarse = randn64(generator, 1, 1, 4, 4)
    weights = torch.nn.functional.interpolate(
        coarse, size=(20, 24), mode="bilinear", align_corners=True
    )[0]
    loss, at = functional(lambda *stage: render.psf_frames(*stage), weights)
    assert_gradients(loss, [torch.zeros(6, dtype=D)] * 3, [1e-6] * 3, 1e-5)
    found = torch.autograd.grad(loss(*at), at)
    traced, at = functional(lambda cam, *rest: render.frames(cam, *rest), weights)
    for gradient, other in zip(found, torch.autograd.grad(traced(*at), at), strict=True):
        assert (gradient - other).norm() < 0.02 * other.norm()


def test_depth_of_mitsuba_scenes_has_the_gradient_of_tangent_planes():
    scene = worlds.room()
    cam = camera(THIN, 12, 8, 1, 0.5)
    twist = torch.zeros(6, dtype=D, requires_grad=True)
    poses = (look_at((0.1, -1, 1.1), (0, 0.8, 0.5)) @ se3_exp(twist))[None]
    _, per_m = light_and_nearness(cam.rays(), views_of(scene, poses))
    depth, truth = 1 / per_m[0].double(), render.view(cam, scene, poses, 0).depth_m.reshape(-1)
    close(depth, truth, rtol=1e-5)
    found, truth = (
        torch.autograd.grad(v.sum(), twist, retain_graph=True)[0] for v in (depth, truth)
    )
    close(found, truth, rtol=1e-4, atol=1e-4 * float(truth.norm()))
