"""Hard cases of pictures and of their true flow: flat, black, turned, huge, nested, at the border."""

import math
from functools import cache, partial

import torch

from codesign import backend, lens, pose, render
from studies.stability.case import Case, Span, spoilt
from studies.stability.motion import FREQUENCY, MEAN, PHASE, plane_light, rigid, rodrigues, small

FOCAL_MM, PITCH_MM = 20.0, 0.5
SLOPE_PX = FOCAL_MM / PITCH_MM  # pixels per unit of slope
LIGHT = 200.0
BALL_M = 0.1
SAMPLES = 1024


def camera(size_px=4, samples=2):
    return render.Camera(lens.Pinhole(FOCAL_MM), size_px, size_px, PITCH_MM, samples, 0)


def plane(distance, amplitude, mean=MEAN):
    """Waves across a wall at z = distance, their lengths in proportion to it."""
    away = distance.detach().double()
    frequency = torch.tensor(FREQUENCY, dtype=torch.float64) / away
    stand = rigid(torch.eye(3, dtype=torch.float64), torch.stack([0 * away, 0 * away, away]))
    return render.TexturedPlane(frequency, [amplitude] * 2, PHASE, mean, stand, distance.dtype)


def picture(twist, distance, amplitude=0.3, mean=MEAN):
    """The wall from a pose that is ``twist`` away, lengths in units of its distance."""
    there = pose.se3_exp(_stretched(twist, distance))[None]
    return render.frames(camera(), plane(distance, amplitude, mean), there)


def _stretched(twist, distance):
    return torch.cat([twist[:3] * distance, twist[3:]])


def one_light(twist, distance, light=MEAN):
    """One radiance, or none, everywhere, whatever the pose."""
    return light


def expected_picture(twist, distance, motion=rodrigues):
    """The texture under every ray, with lengths from 0.1 mm to 10 km."""
    there = motion(_stretched(twist, distance))
    light = plane_light(there, camera().rays().direction, distance, 0.3)
    return light.reshape(1, 4, 4, -1).mean(-1)


def near_picture(twist, distance):
    """The texture under every ray, at the identity and twists of 1e-320 to 1e-39."""
    return expected_picture(twist, distance, motion=small)


def spoilt_poses(place):
    """NaN anywhere in the poses is refused."""
    poses = spoilt(torch.eye(4).to(place).repeat(3, 1, 1), place)
    return render.frames(camera(), plane(place.new_ones(()), 0.3), poses)


def flow_of(path, distance):
    """Flow from the first of some poses to the last, [2, H, W] px."""
    poses = torch.stack([pose.se3_exp(twist) for twist in path])
    return render.true_flow(camera(), plane(distance, 0.3), poses, stride=len(path) - 1)[0][0]


def ahead(zoom, distance):
    return flow_of(_along(2, 0 * zoom, zoom / (1 + zoom) * distance), distance)


def expected_zoom(zoom, distance):
    """Off the middle by the zoom times the distance from it."""
    return zoom * (camera().film.pixels() - 1.5).mT.reshape(2, 4, 4)


def out_and_back(shift_px, distance):
    move = -shift_px / SLOPE_PX * distance
    return flow_of(_along(0, 0 * move, move, move / 2), distance)


def half_shifted(shift_px, distance):
    """A camera that goes sideways and half back: half of the shift, everywhere."""
    return torch.stack([shift_px / 2, 0 * shift_px])[:, None, None]


def _along(axis, *ways):
    return [torch.stack([way if k == axis else 0 * way for k in range(6)]) for way in ways]


@cache
def scene(kind):
    """Glowing shapes: a ball in a ball, a mirrored ball, or a wall that ends at the border of the
    film, 1 m away."""
    T = backend.mitsuba("cpu").ScalarTransform4f
    ball = {"type": "sphere", "radius": BALL_M}
    inner = {"type": "sphere", "center": [0, 0, 0.1 * BALL_M], "radius": 0.8 * BALL_M}
    mirrored = {"type": "sphere", "to_world": T().scale([-BALL_M, BALL_M, BALL_M])}
    edge = T().translate([4 / SLOPE_PX + 1, 0, 1]).rotate([0, 1, 0], 180)
    shapes = {
        "nested": {"ball": ball, "inner": inner},
        "mirrored": {"ball": mirrored},
        "two-sided": {"ball": mirrored},
        "card": {"card": {"type": "rectangle", "to_world": edge}},
    }[kind]
    light = {"type": "area", "radiance": {"type": "rgb", "value": LIGHT}}
    lit = {name: {**shape, "emitter": light} for name, shape in shapes.items()}
    found = render.MitsubaScene(lit, merge=False)
    return found.two_sided() if kind == "two-sided" else found


def light_of(kind, twist):
    """Sum of a picture of 8 x 8 pixels, in pixels of full light."""
    poses = pose.se3_exp(twist)[None]
    return render.frames(camera(8, SAMPLES), scene(kind), poses, "boundary").sum() / LIGHT


def ball_light(kind, distance):
    return light_of(kind, *_along(2, -distance))


def card_light(inside_px):
    return light_of("card", *_along(0, inside_px / SLOPE_PX))


def disc_area(distance):
    """A ball, with another in it or mirrored, is a disc of slope r / sqrt(z^2 - r^2)."""
    return math.pi * SLOPE_PX**2 * BALL_M**2 / (distance**2 - BALL_M**2)


def card_area(inside_px):
    """An edge within a pixel of the film's border: light and slope of the rows it crosses."""
    return 8 * inside_px


TWIST, STILL, UNIT_M = Span(0.02, 0.1, (6,)), Span(0, 0, (6,)), Span(1, 1)
DENORMAL = Span(1e-320, 1e-39, (6,), log=True)
# Samples lie in 32 x 32 cells of every pixel, alike in all. A disc's rim of 16 px cuts 500 cells,
# each off by 0.3 of 1/1024 px^2: four standard deviations are 0.03 px^2, alike pixels 0.1, of 15.
# Points on silhouettes see the same light everywhere, so gradients are those of the closed form.
AREA = (0.007, 1e-5, 1e-4)
# points are shared with the hidden outline: one of 28 on the rim of 11 px more or less
NESTED = (0.007, 0.036, 1e-4)
# an edge through 8 pixels alike, 32 cells each: four times 8 x 0.3 x sqrt(32) / 1024 px^2
EDGE = (0.053 / 8, 1e-5, 1e-4)
BALL = {"distance": Span(1.5, 2.2)}
INSIDE_OUT = (
    "Mitsuba turns a mirrored sphere inside out: its outside is dark, in `mi.render` too. "
    "`MitsubaScene.two_sided()` shows it (the case beside this one)."
)
SHIFT = {"shift_px": Span(1e-9, 1e-3, log=True), "distance": UNIT_M}
ZOOM = {"zoom": Span(0.1, 0.3), "distance": UNIT_M}
BACK = {"shift_px": Span(-2, 2), "distance": UNIT_M}
NEAR, FAR = ({"twist": TWIST, "distance": Span(*ends, log=True)} for ends in ((1, 1), (1e-4, 1e4)))
REST, TINY = ({"twist": span, "distance": UNIT_M} for span in (STILL, DENORMAL))
TO_POSE, TO_SHIFT = {"learn": ("twist",)}, {"learn": ("shift_px",)}
OF_SHIFT = TO_SHIFT | {"unit": 1e-3, "allowed": (1e-10, 1e-9, 1e-4)}
BORDER = {"inside_px": Span(0.01, 1)}
nested, mirrored, both_sides = (partial(ball_light, k) for k in ("nested", "mirrored", "two-sided"))
CASES = [
    Case("flat scene", "render", NEAR, partial(picture, amplitude=0.0), one_light),
    Case("black frames", "render", NEAR, partial(picture, mean=0.0), partial(one_light, light=0.0)),
    Case("identity rotation", "render", REST, picture, near_picture, **TO_POSE),
    Case("denormals", "render", TINY, picture, near_picture, **TO_POSE),
    Case("huge, tiny coordinates", "render", FAR, picture, expected_picture, **TO_POSE),
    Case("nested shapes", "render", BALL, nested, disc_area, NESTED, slow=True),
    Case("mirrored shapes", "render", BALL, mirrored, disc_area, AREA, known=INSIDE_OUT),
    Case("mirrored, both sides", "render", BALL, both_sides, disc_area, AREA, slow=True),
    Case("border silhouettes", "render", BORDER, card_light, card_area, EDGE, unit=8.0, slow=True),
    Case("NaN or infinity", "render", {"place": Span(0, 1)}, spoilt_poses, "poses must be finite"),
    Case("flow below 1e-3 px", "true flow", SHIFT, out_and_back, half_shifted, **OF_SHIFT),
    Case("zoom of 0.3", "true flow", ZOOM, ahead, expected_zoom, learn=("zoom",)),
    Case("out and half back", "true flow", BACK, out_and_back, half_shifted, **TO_SHIFT),
]
