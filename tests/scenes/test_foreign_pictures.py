"""Scenes as others write them: worlds made of them against mi.render, baked light against paths,
gradients."""

import math
from itertools import combinations, product

import numpy as np
import pytest
import torch

from codesign import backend, render
from codesign.render import light
from scenes import foreign, worlds
from tests.scenes.foreign_examples import FOREIGN

WIDTH_PX = 32
PATHS = 16
PICTURES = 4
MATTE = ("mirrors", "market")  # what one sees in them moves with the eye
# RMS of baked light after one brightness, with 8 paths per texel of a 20,000th of the surface
BAKED = {"cornell": 0.2, "terrace": 0.08, "cellar": 0.25, "mirrors": 0.6, "market": 0.15}


def frame(camera, scene, poses):
    with torch.no_grad():
        return render.frames(camera, scene, poses)[0].double().reshape(camera.film.shape[-2:])


def rms(image):
    return float(image.square().mean().sqrt())


def references(scene, view, camera):
    """Pictures [PICTURES, H, W] of mi.render through the sensor of the scene, with the camera's
    film."""
    mi = backend.mitsuba()
    film = camera.film
    own = mi.traverse(scene.sensors()[0])
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": math.degrees(view.field_of_view_rad),
            "fov_axis": "x",
            "near_clip": float(own["near_clip"]),
            "far_clip": float(own["far_clip"]),
            "to_world": mi.ScalarTransform4f(np.array(own["to_world"].matrix)[..., 0]),
            "film": {
                "type": "hdrfilm",
                "width": film.sensor_width_px,
                "height": film.sensor_height_px,
                "pixel_format": "luminance",
                "rfilter": {"type": "box"},
            },
        }
    )
    integrator = scene.integrator() or mi.load_dict({"type": "path"})
    images = [
        np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=PATHS, seed=100 + k))[
            ..., 0
        ]
        for k in range(PICTURES)
    ]
    return torch.from_numpy(np.stack(images)).double()


@pytest.mark.parametrize("name", FOREIGN)
def test_a_world_is_the_picture_that_mitsuba_makes_and_baked_light_is_near_it(name):
    scene = foreign.loaded(backend.mitsuba(), FOREIGN[name](), {}, merge=False)
    view = worlds.view_of(scene)
    poses = view.T_world_cam[None]
    camera = view.camera(PATHS, WIDTH_PX)
    paths = worlds.from_mitsuba(scene, "path", samples=1)
    theirs = references(scene, view, camera)
    ours = torch.stack([frame(camera, paths.with_seed(k), poses) for k in range(PICTURES)])
    means = [images.mean((1, 2)) for images in (ours, theirs)]
    noise = float((means[0].var() + means[1].var()).sqrt()) / 2
    assert abs(ours.mean() - theirs.mean()) <= 5 * noise < 0.1 * theirs.mean()
    # 16 pairs of pictures that share four: the ratio of two RMS is good to 5 %
    among = np.mean([rms(a - b) for a, b in combinations(theirs, 2)])
    assert np.mean([rms(a - b) for a, b in product(ours, theirs)]) <= 1.1 * among
    area_m2 = sum(float(shape.surface_area()[0]) for shape in scene.shapes())
    options = {"samples": 8, "texel_m": math.sqrt(area_m2 / 20_000), "matte": name in MATTE}
    baked = worlds.from_mitsuba(scene, "baked", **options)
    error = light.level_error(baked, worlds.from_mitsuba(scene, "path", samples=16), camera, poses)
    assert error.rms_after_gain.max() <= BAKED[name]
