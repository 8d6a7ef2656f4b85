"""Frames of this package against Mitsuba's own sensors: the same scene through a pinhole, a thin
lens and a traced lens, within Monte Carlo error.

Statistic: Mitsuba renders K independent images with a box filter; z = (ours - their mean) /
  standard error of the difference, per pixel, where ours is the mean of K images with independent
  sample seeds. With K = 16 on each side z follows Student's t to a good approximation (Welch, 15 to
  30 degrees of freedom), whose mean square is d / (d - 2), 1.07 to 1.15. Over n pixels the mean of
  z^2 has a standard deviation of about 1.9 / sqrt(n); five of those are allowed around 1.1, and
  five standard errors for the mean of the whole image. A turn by a quarter pixel breaks the first,
  which the last test shows.
"""

import math

import numpy as np
import pytest
import torch

from codesign import backend, lens, render
from codesign.pose import look_at, se3_exp
from codesign.render import Camera
from scenes import textures, worlds
from tests.numbers import f64

K = 16
WIDTH = 32
HEIGHT = 24
PITCH_MM = 0.1
EFL_MM = 5.0
POSE = look_at((0.35, -1.3, 1.2), (0.0, 0.9, 0.5))


@pytest.fixture(scope="module")
def room():
    return worlds.room()


def mitsuba_images(
    scene, kind, aperture_mm=0.0, focus_m=None, samples=64, pose=POSE, efl_mm=EFL_MM
):
    """[K, H, W] images of Mitsuba's own sensor; it looks along its +z with x to the left and y
    up."""
    mi = backend.mitsuba()
    pose = pose.numpy().copy()
    pose[:3, :2] *= -1
    sensor = {
        "type": kind,
        "to_world": mi.ScalarTransform4f(pose),
        "fov_axis": "x",
        "fov": math.degrees(2 * math.atan(WIDTH * PITCH_MM / 2 / efl_mm)),
        "film": {
            "type": "hdrfilm",
            "width": WIDTH,
            "height": HEIGHT,
            "pixel_format": "luminance",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "independent"},
    }
    if kind == "thinlens":
        sensor |= {"aperture_radius": aperture_mm / 2 * 1e-3, "focus_distance": focus_m}
    sensor = mi.load_dict(sensor)
    integrator = mi.load_dict({"type": "direct"})
    images = [
        np.array(
            mi.render(scene.scene, sensor=sensor, integrator=integrator, spp=samples, seed=100 + k)
        )
        for k in range(K)
    ]
    return torch.from_numpy(np.stack(images)).double().reshape(K, HEIGHT, WIDTH)


def own_images(scene, optics, samples=64, pose=POSE):
    with torch.no_grad():
        return torch.cat(
            [
                render.frames(
                    Camera(optics, WIDTH, HEIGHT, PITCH_MM, samples, seed=k), scene, pose[None]
                )
                for k in range(K)
            ]
        ).double()


def z_scores(ours, theirs):
    """Difference of means over its standard error, per pixel that varies; float32 rounding of the
    images counts as error too."""
    error = ((ours.var(0) + theirs.var(0)) / K + (1e-5 * ours.mean(0)).square()).sqrt()
    return ((ours.mean(0) - theirs.mean(0)) / error).reshape(-1)


def moments(ours, theirs):
    """Difference of the whole images' means, and mean square of z, each in units of its allowed
    five standard deviations.

    All pixels of ours share one sample pattern, so the noise of the images' means is taken from the
    seeds, not from the pixels.
    """
    square = z_scores(ours, theirs).square()
    means = [images.mean((1, 2)) for images in (ours, theirs)]
    spread = float(((means[0].var() + means[1].var()) / K).sqrt()) + 1e-5 * float(ours.mean())
    return abs(float(means[0].mean() - means[1].mean())) / (5 * spread), (
        float(square.mean()) - 1.1
    ) / (5 * 1.9 / square.numel() ** 0.5)


def assert_the_same(ours, theirs):
    level, square = moments(ours, theirs)
    assert level < 1
    assert abs(square) < 1


def test_pinhole_against_perspective(room):
    assert_the_same(own_images(room, lens.Pinhole(EFL_MM)), mitsuba_images(room, "perspective"))


@pytest.mark.parametrize(("aperture_mm", "focus_m"), [(20.0, 2.0), (60.0, 1.2)])
def test_thin_lens_against_thinlens(room, aperture_mm, focus_m):
    # Mitsuba keeps the field of view whatever the focus: its film lies at 1, ours at the image
    # distance. A focal length f with image distance EFL focuses at 1 / focus = 1 / f - 1 / EFL.
    optics = lens.ThinLens(1 / (1 / EFL_MM + 1 / (1e3 * focus_m)), aperture_mm, EFL_MM)
    assert_the_same(
        own_images(room, optics), mitsuba_images(room, "thinlens", aperture_mm, focus_m)
    )


def test_a_traced_lens_stopped_down_against_perspective():
    # Focused at infinity (last thickness = back focal length) a triplet's chief rays near the axis
    # are those of a pinhole of its focal length: the corner of this film is 2.3 degrees off axis,
    # where third-order distortion (about 1 % at 20 degrees) is 1e-4 of the height, 0.003 pixels.
    geo = lens.load("cooke-triplet")
    first = geo.first_order()
    thickness = geo.thickness_mm.detach().clone()
    thickness[-1] = first.bfl_mm.detach()
    stopped = lens.GeoLens(
        geo.replace(thickness_mm=thickness).to_surfaces(), entrance_pupil_diameter_mm=1e-3
    )
    wall = worlds.wall(textures.softened(textures.photo("brick"), 2.0), texel_m=0.0005)
    pose = look_at((0.05, -2.0, 0.03), (0.05, 0.0, 0.03))
    theirs = mitsuba_images(wall, "perspective", pose=pose, efl_mm=float(first.efl_mm.detach()))
    assert_the_same(own_images(wall, stopped, pose=pose), theirs)


def test_the_statistic_sees_a_quarter_of_a_pixel(room):
    turn = f64([0, 0, 0, 0, 0.25 * PITCH_MM / EFL_MM, 0])
    ours = own_images(room, lens.Pinhole(EFL_MM), pose=POSE @ se3_exp(turn))
    assert moments(ours, mitsuba_images(room, "perspective"))[1] > 1
