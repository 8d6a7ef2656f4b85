"""Scenes with occluders over a textured wall, for gradients at silhouettes. Textures are smooth at
the scale of a pixel, so that the silhouettes are what is tested."""

import numpy as np

from codesign import backend
from codesign.render import MitsubaScene

NAMES = ("cubes", "spheres", "poles", "fence", "wall")


def smooth(seed, size=64, cycles=4, darkest=20.0, brightest=220.0, rows_only=False):
    """Random texture [size, size, 1] of at most some ``cycles`` periods, periodic in both
    directions; constant along rows when ``rows_only``."""
    frequency = np.fft.fftfreq(size) * size
    noise = np.fft.fft2(np.random.default_rng(seed).standard_normal((size, size)))
    if rows_only:
        noise = noise * (frequency == 0)
    field = np.fft.ifft2(
        noise * np.exp(-(frequency[:, None] ** 2 + frequency**2) / (cycles**2))
    ).real
    field = (field - field.mean()) / field.std()
    return (darkest + (brightest - darkest) / (1 + np.exp(-1.5 * field))).astype(np.float32)[
        ..., None
    ]


def _light(mi, seed, **options):
    radiance = {"type": "bitmap", "bitmap": mi.Bitmap(smooth(seed, **options)), "raw": True}
    return {"type": "area", "radiance": radiance}


def _cubes(mi, first, second):
    """Two leaning cubes that touch nothing, with their emitters."""
    T = mi.ScalarTransform4f
    near = T().translate([-0.5, 0.6, 0.95]).rotate([1, 1, 0], 50).scale(0.3)
    far = T().translate([0.6, 0.9, 0.6]).rotate([0, 1, 1], 50).scale([0.3, 0.5, 0.3])
    return [
        {"type": "cube", "to_world": to_world, "emitter": emitter}
        for to_world, emitter in ((near, first), (far, second))
    ]


def _post(mi, k):
    T = mi.ScalarTransform4f
    # an edge along a column of pixels would have a kink wherever it passes from one to the next
    lean_deg = 7 + 2 * k
    upright = T().translate([-1.05 + 0.35 * k, 0.7, 0.8]).rotate([0, 1, 0], lean_deg)
    grey = {"type": "rgb", "value": 30.0 + 25.0 * k}
    return {
        "type": "cube",
        "to_world": upright.rotate([0, 0, 1], 12 * k).scale([0.04, 0.04, 0.9]),
        "emitter": {"type": "area", "radiance": grey},
    }


def _pole(mi, k):
    return {
        "type": "cylinder",
        "p0": [-1.2 + 0.55 * k, 0.5 + 0.2 * k, -1.5],
        "p1": [-0.3 + 0.4 * k, 0.7, 2.6],
        "radius": 0.05,
        "emitter": _light(
            mi, 4 + k, cycles=3, rows_only=True, darkest=5 + 60 * k, brightest=40 + 60 * k
        ),
    }


def build(name, device="cpu"):
    """One of NAMES: a wall 2.5 m ahead of the origin with occluders between, for a camera near
    (0, -1.2, 1) that looks along +y."""
    mi = backend.mitsuba(device)
    wall = mi.ScalarTransform4f().translate([0, 2.5, 0.5]).scale([4, 0.1, 4])
    shapes: dict = {"back": {"type": "cube", "to_world": wall, "emitter": _light(mi, 1, cycles=6)}}
    if name == "cubes":
        shapes["a"], shapes["b"] = _cubes(mi, _light(mi, 2, cycles=2), _light(mi, 3, cycles=2))
    if name == "spheres":
        dark, bright = {"darkest": 10, "brightest": 90}, {"darkest": 120, "brightest": 240}
        for key, seed, at, radius, levels in (
            ("a", 2, [-0.5, 0.6, 0.9], 0.35, dark),
            ("b", 3, [0.5, 1.0, 0.5], 0.45, bright),
        ):
            emitter = _light(mi, seed, cycles=1, **levels)
            shapes[key] = {"type": "sphere", "center": at, "radius": radius, "emitter": emitter}
    if name == "poles":
        shapes |= {f"pole{k}": _pole(mi, k) for k in range(4)}
    if name == "fence":
        shapes |= {f"post{k}": _post(mi, k) for k in range(7)}
    return MitsubaScene(shapes, device)


def room(seed=0, device="cpu"):
    """A room of 5 x 6 x 3 m with two leaning boxes that touch nothing, for a camera near
    (0, -1.2, 1) that looks along +y."""
    mi = backend.mitsuba(device)
    first = 3 * seed + 1000
    walls = {
        "type": "cube",
        "flip_normals": True,
        "to_world": mi.ScalarTransform4f().translate([0, 0, 1]).scale([2.5, 3.0, 1.5]),
        "emitter": _light(mi, first, cycles=6, darkest=50, brightest=200),
    }
    near, far = _cubes(
        mi,
        _light(mi, first + 1, cycles=2, darkest=40, brightest=110),
        _light(mi, first + 2, cycles=2, darkest=110, brightest=240),
    )
    return MitsubaScene({"walls": walls, "near": near, "far": far}, device)


def ball(device="cpu"):
    """A ball of 0.35 m about the origin, to be moved before another scene."""
    emitter = _light(backend.mitsuba(device), 5, cycles=8)
    return MitsubaScene({"ball": {"type": "sphere", "radius": 0.35, "emitter": emitter}}, device)


def robot(device="cpu"):
    """A robot's deck and mast in the axes of the camera's mount (x right, y ahead, z up), so near
    that they cross the border of its view."""
    mi = backend.mitsuba(device)
    turned = mi.ScalarTransform4f().translate([0.0, 0.15, -0.12]).rotate([1, 0.3, 0.2], 9)
    deck = {"type": "cube", "to_world": turned.scale([0.11, 0.22, 0.03])}
    mast = {"type": "cylinder", "p0": [0.08, 0.5, -0.06], "p1": [0.1, 0.47, 0.25], "radius": 0.015}
    deck["emitter"] = _light(mi, 7, cycles=2, darkest=120)
    mast["emitter"] = _light(mi, 8, cycles=2, brightest=90)
    return MitsubaScene({"deck": deck, "mast": mast}, device)
