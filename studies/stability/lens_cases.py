"""Hard cases of rays through lenses: lost, far, large, small, mirrored."""

import math

import torch

from codesign import lens
from studies.stability.case import Case, Span, spoilt

INDEX = 1.5
GLASS = lens.Glass.from_indices(INDEX, INDEX, INDEX)
FOCUS = 1.5  # of a ball over its radius, from its centre: n / (2 (n - 1)); Hecht, Optics, ch. 6


def along_axis(height, distance=5.0):
    """Rays parallel to the axis at heights [K]."""
    origin = torch.stack([height, 0 * height, 0 * height - distance], -1)
    return origin, torch.tensor([0.0, 0.0, 1.0]).to(height).expand_as(origin)


def traced(height, front, back):
    """They pass 5 mm of glass and 10 mm of air; status, light and deficit of each, and landing."""
    surfaces = [lens.Surface(math.inf, 5.0, GLASS, 9.9), lens.Surface(math.inf, 10.0, None, 9.9)]
    geo = lens.GeoLens(surfaces, 4.0, height.dtype)
    out = geo.replace(curvature_per_mm=torch.stack([front, back])).trace(*along_axis(height))
    return torch.stack([out.status.to(height), out.weight, out.deficit]), out.position_mm[:, 0]


def reflected(height, curvature):
    return traced(height, 0 * curvature, curvature)[0]


def reflection(height, curvature):
    """The sine n h c exceeds 1: no light, and its square says by how much."""
    deficit = (INDEX * height * curvature) ** 2 - 1
    return torch.stack([0 * deficit + int(lens.Status.TOTAL_REFLECTION), 0 * deficit, deficit])


def missed(height, curvature):
    return traced(height, curvature, 0 * curvature)[0]


def miss(height, curvature):
    """Heights beyond the radius: no light, (h c)^2 says by how much."""
    deficit = (height * curvature) ** 2 - 1
    return torch.stack([0 * deficit + int(lens.Status.MISS), 0 * deficit, deficit])


def through_nothing(height):
    """A camera of which no ray arrives is refused."""
    stop = lens.Surface(5.0, 10.0, GLASS, 4.99, is_stop=True)
    geo = lens.GeoLens([stop, lens.Surface(-5.0, 8.0, None, 4.99)], 8.0, height.dtype)
    film = torch.stack([height, 0 * height], -1)
    return geo.camera_rays(film, torch.tensor([[-1.0, 0.0]]).to(film)).weight


def through_ball(height, distance, scale):
    """Where rays meet the paraxial focal plane; all lengths in radii."""
    radius = 5.0 * float(scale)
    front = lens.Surface(radius, 2 * radius, GLASS, 0.998 * radius)
    back = lens.Surface(-radius, (FOCUS - 1) * radius, None, 0.998 * radius)
    ball = lens.GeoLens([front, back], 0.4 * radius, height.dtype)
    out = ball.trace(*along_axis(height * radius, float(distance) * radius))
    return out.position_mm[:, 0] / radius


def ball_landing(height, **_):
    """A ball, whose second half is met beyond its centre: sin i = h, bent by 2 (i - i') in all."""
    bend = 2 * (height.asin() - (height / INDEX).asin())
    return bend.tan() * (height / bend.sin() - FOCUS)


def nearly_flat(height, curvature):
    return traced(height, curvature, 0 * curvature)[1]


def slightly_bent(height, curvature):
    """A plane with its slope: h c (n - 1) / n in glass and n times that in air."""
    return height - height * curvature * (1 - 1 / INDEX) * (5 + 10 * INDEX)


def spoilt_ray(place):
    """NaN anywhere in the origins is refused."""
    origin, ahead = along_axis(place.new_ones(4))
    return lens.load("cooke-triplet", place.dtype).trace(spoilt(origin, place), ahead).weight


BENT = {"height": Span(7.5, 9.0, (1,)), "curvature": Span(-0.11, -0.095)}
WIDE = {"height": Span(11, 40, (3,)), "curvature": Span(0.095, 0.2)}
FLAT = {"height": Span(-3, 3, (2,)), "curvature": Span(1e-320, 1e-39, log=True)}
LOST, BALL = ({"height": span} for span in (Span(7.5, 9, (2,)), Span(0.05, 0.9, (3,))))
# from where the light comes, and the ball's size
FAR = BALL | {"distance": Span(1, 2e6, log=True), "scale": Span(1, 1)}
SCALED = BALL | {"distance": Span(1, 2), "scale": Span(1e-3, 1e3, log=True)}
DEFICIT = (1e-7, 1e-9, 1e-5)  # counts from the grazing limit of 1e-8
OF_FAR = (1e-9, 1e-8, 1e-4)  # origins of 1e7 mm are exact to 1e-9 mm of 5
OF_NEAR = (1e-12, 1e-9, 1e-5)
CASES = [
    Case("total reflection", "lens", BENT, reflected, reflection, DEFICIT),
    Case("all rays lost", "lens", WIDE, missed, miss, DEFICIT),
    Case("all rays lost", "render", LOST, through_nothing, "every ray fails"),
    Case("object 10 km away", "lens", FAR, through_ball, ball_landing, OF_FAR, ("height",)),
    Case(
        "huge, tiny coordinates", "lens", SCALED, through_ball, ball_landing, OF_NEAR, ("height",)
    ),
    Case("denormals", "lens", FLAT, nearly_flat, slightly_bent),
    Case("NaN or infinity", "lens", {"place": Span(0, 1)}, spoilt_ray, "origin_mm must be finite"),
]
