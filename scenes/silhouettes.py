"""Scenes with occluders over a textured wall, for gradients at silhouettes. Textures are smooth at the scale
of a pixel, so that the silhouettes are what is tested."""

import numpy as np

from codesign import backend
from codesign.render import MitsubaScene

NAMES = ("cubes", "spheres", "poles", "fence", "wall")


def smooth(seed, size=64, cycles=4, darkest=20.0, brightest=220.0, rows_only=False):
    """Random texture [size, size, 1] of at most some ``cycles`` periods, periodic in both directions;
    constant along rows when ``rows_only``."""
    frequency = np.fft.fftfreq(size) * size
    noise = np.fft.fft2(np.random.default_rng(seed).standard_normal((size, size)))
    if rows_only:
        noise = noise * (frequency == 0)
    field = np.fft.ifft2(noise * np.exp(-(frequency[:, None] ** 2 + frequency**2) / (cycles**2))).real
    field = (field - field.mean()) / field.std()
    return (darkest + (brightest - darkest) / (1 + np.exp(-1.5 * field))).astype(np.float32)[..., None]


def build(name, device="cpu"):
    """One of NAMES: a wall 2.5 m ahead of the origin with occluders between, for a camera near (0, -1.2, 1)
    that looks along +y."""
    mi = backend.mitsuba(device)
    T = mi.ScalarTransform4f

    def light(seed, **options):
        return {
            "type": "area",
            "radiance": {
                "type": "bitmap",
                "bitmap": mi.Bitmap(smooth(seed, **options)),
                "raw": True,
                "wrap_mode": "repeat",
            },
        }

    shapes: dict = {
        "back": {
            "type": "cube",
            "to_world": T().translate([0, 2.5, 0.5]).scale([4, 0.1, 4]),
            "emitter": light(1, cycles=6),
        }
    }
    if name == "cubes":
        shapes["a"] = {
            "type": "cube",
            "to_world": T().translate([-0.5, 0.6, 0.95]).rotate([1, 1, 0], 50).scale(0.3),
            "emitter": light(2, cycles=2),
        }
        shapes["b"] = {
            "type": "cube",
            "to_world": T().translate([0.6, 0.9, 0.6]).rotate([0, 1, 1], 50).scale([0.3, 0.5, 0.3]),
            "emitter": light(3, cycles=2),
        }
    if name == "spheres":
        shapes["a"] = {
            "type": "sphere",
            "center": [-0.5, 0.6, 0.9],
            "radius": 0.35,
            "emitter": light(2, cycles=1, darkest=10, brightest=90),
        }
        shapes["b"] = {
            "type": "sphere",
            "center": [0.5, 1.0, 0.5],
            "radius": 0.45,
            "emitter": light(3, cycles=1, darkest=120, brightest=240),
        }
    if name == "poles":
        for k in range(4):
            low = [-1.2 + 0.55 * k, 0.5 + 0.2 * k, -1.5]
            high = [-0.3 + 0.4 * k, 0.7, 2.6]
            shapes[f"pole{k}"] = {
                "type": "cylinder",
                "p0": low,
                "p1": high,
                "radius": 0.05,
                "emitter": light(4 + k, cycles=3, rows_only=True, darkest=5 + 60 * k, brightest=40 + 60 * k),
            }
    if name == "fence":
        for k in range(7):
            lean = (
                7 + 2 * k
                # degrees; an edge along a column of pixels would have a kink wherever it passes from one to the
                # next
            )
            post = (
                T()
                .translate([-1.05 + 0.35 * k, 0.7, 0.8])
                .rotate([0, 1, 0], lean)
                .rotate([0, 0, 1], 12 * k)
                .scale([0.04, 0.04, 0.9])
            )
            shapes[f"post{k}"] = {
                "type": "cube",
                "to_world": post,
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 30.0 + 25.0 * k}},
            }
    return MitsubaScene(shapes, device)


def room(seed=0, device="cpu"):
    """A room of 5 x 6 x 3 m with two leaning boxes that touch nothing, for a camera near (0, -1.2, 1) that looks
    along +y."""
    mi = backend.mitsuba(device)
    T = mi.ScalarTransform4f

    def light(number, **options):
        bitmap = mi.Bitmap(smooth(3 * seed + number, **options))
        return {
            "type": "area",
            "radiance": {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "repeat"},
        }

    shapes: dict = {
        "walls": {
            "type": "cube",
            "flip_normals": True,
            "to_world": T().translate([0, 0, 1]).scale([2.5, 3.0, 1.5]),
            "emitter": light(1000, cycles=6, darkest=50, brightest=200),
        },
        "near": {
            "type": "cube",
            "to_world": T().translate([-0.5, 0.6, 0.95]).rotate([1, 1, 0], 50).scale(0.3),
            "emitter": light(1001, cycles=2, darkest=40, brightest=110),
        },
        "far": {
            "type": "cube",
            "to_world": T().translate([0.6, 0.9, 0.6]).rotate([0, 1, 1], 50).scale([0.3, 0.5, 0.3]),
            "emitter": light(1002, cycles=2, darkest=110, brightest=240),
        },
    }
    return MitsubaScene(shapes, device)


def ball(device="cpu"):
    """A ball of 0.35 m about the origin, to be moved before another scene."""
    mi = backend.mitsuba(device)
    radiance = {"type": "bitmap", "bitmap": mi.Bitmap(smooth(5, cycles=8)), "raw": True}
    shape = {"type": "sphere", "radius": 0.35, "emitter": {"type": "area", "radiance": radiance}}
    return MitsubaScene({"ball": shape}, device)


def robot(device="cpu"):
    """A robot's deck and mast in the axes of the camera's mount (x right, y ahead, z up), so near that they cross the
    border of its view."""
    mi = backend.mitsuba(device)
    T = mi.ScalarTransform4f

    def light(seed, **options):
        picture = mi.Bitmap(smooth(seed, cycles=2, **options))
        return {"type": "area", "radiance": {"type": "bitmap", "bitmap": picture, "raw": True}}

    deck = T().translate([0.0, 0.15, -0.12]).rotate([1, 0.3, 0.2], 9).scale([0.11, 0.22, 0.03])
    mast = {"type": "cylinder", "p0": [0.08, 0.5, -0.06], "p1": [0.1, 0.47, 0.25], "radius": 0.015}
    return MitsubaScene(
        {
            "deck": {"type": "cube", "to_world": deck, "emitter": light(7, darkest=120)},
            "mast": {**mast, "emitter": light(8, brightest=90)},
        },
        device,
    )
