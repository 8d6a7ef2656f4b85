"""Single edges of the boundary term against closed forms: edges that recede, light that an aperture
takes away, the tangent on the film, the rims of a cylinder."""

import math

import numpy as np
import pytest

from codesign import backend, pose, render
from codesign.lens import GeoLens, Glass, Pinhole, Surface
from codesign.render import MitsubaScene
from codesign.render.charts import emissive_mesh
from tests.render.differences import to_twist
from tests.render.solids import CORNERS, CUBE, area

RADIANCE = 100.0


def card(right_m, distance_m, tilt_deg=0.0, half_height_m=0.3):
    """A bright rectangle that reaches far to the left, its right edge at x = right_m, turned about
    the x axis."""
    T = backend.mitsuba().ScalarTransform4f
    place = (
        T()
        .translate([right_m - 5.0, 0, distance_m])
        .rotate([1, 0, 0], tilt_deg)
        .rotate([0, 1, 0], 180)
    )
    emitter = area(RADIANCE)
    return MitsubaScene(
        {
            "card": {
                "type": "rectangle",
                "to_world": place.scale([5.0, half_height_m, 1.0]),
                "emitter": emitter,
            }
        }
    )


def sideways(camera, scene):
    """Derivative of the sum of all pixels to the motion of the camera along +x, per metre."""
    return float(moved(camera, scene)[0])


def moved(camera, scene, **more):
    """Derivatives [6] of the sum of all pixels to the motion of the camera."""
    return to_twist(
        lambda t: render.frames(camera, scene, pose.se3_exp(t), "boundary", **more).double().sum()
    )


def test_edges_that_are_all_hidden_change_nothing():
    T = backend.mitsuba().ScalarTransform4f
    scene = MitsubaScene(
        {
            name: {
                "type": "rectangle",
                "to_world": T().translate([0, 0, z]).rotate([0, 1, 0], 180).scale([half, half, 1]),
                "emitter": area(RADIANCE),
            }
            for name, z, half in (("near", 1.0, 5.0), ("far", 2.0, 0.05))
        }
    )
    assert sideways(render.Camera(Pinhole(11.0), 8, 8, 0.25, 1), scene) == 0.0


@pytest.mark.parametrize("tilt_deg", [0.0, 50.0, -65.0])
def test_an_edge_that_recedes_sweeps_by_its_depth_at_every_point(tilt_deg):
    """Seen at x_f = f X / Z, y_f = f Y / Z, a point of the edge moves by -f / Z per metre; what the
    card loses is the integral of that over y_f. The other edges are level, or out of the
    picture."""
    focal_px = 11.0 / 0.25
    camera = render.Camera(Pinhole(11.0), 40, 40, 0.25, 1)
    half = 0.3
    s = np.linspace(-half, half, 20001)
    y, z = s * math.cos(math.radians(tilt_deg)), 2.0 + s * math.sin(math.radians(tilt_deg))
    y_film = focal_px * y / z
    assert np.abs(y_film).max() < 19.0
    truth = -RADIANCE * np.sum((focal_px / z)[:-1] * np.diff(y_film))
    # two to three points per pixel of edge, each in the middle of its part or aside: their errors
    # are independent
    assert sideways(camera, card(0.35, 2.0, tilt_deg, half)) == pytest.approx(truth, rel=3e-3)


def test_an_edge_counts_with_the_light_that_passes_the_apertures():
    """A small stop 3 mm before a plane that clips the field softly: the chief ray of film height h
    crosses it at 2 h / 97 (tests/render/test_camera.py), where the aperture passes 3 u^2 - 2
    u^3."""
    glass = Glass.from_indices(1.5, 1.5, 1.5)
    semi, edge = 0.08, 0.07
    front = Surface(math.inf, 3.0, glass, 9.0, is_stop=True)
    back = Surface(400.0, 95.0, None, semi)
    geo = GeoLens([front, back], 1e-3, soft_edge_mm=edge)
    camera = render.Camera(geo, 120, 120, 0.1, 1)
    slope_per_px = camera.slope_per_px()
    distance = 4.0
    x = 0.02
    rows = np.linspace(-40.0, 40.0, 4001)
    scene = card(x * distance, distance, 0.0, 40.0 * slope_per_px * distance)
    height_mm = 0.1 * np.hypot(rows, x / slope_per_px)
    u = 0.5 + (semi**2 - (2 * height_mm / 97) ** 2) / (2 * edge * semi)
    passed = np.where(u > 0, 3 * u**2 - 2 * u**3, 0) * (u < 1) + (u >= 1)
    assert 0.05 < passed.min() < 0.3 < 0.8 < passed.max() < 1
    truth = -RADIANCE * passed.mean() * 80.0 / (slope_per_px * distance)
    assert sideways(camera, scene) == pytest.approx(truth, rel=1e-2)


@pytest.mark.parametrize(
    ("sliver_rad", "until_m"), [(1e-7, 2.01), (1e-6, 2.01), (1e-5, 2.01), (1e-5, 2.5), (1e-4, 2.5)]
)
def test_edges_of_a_face_seen_nearly_edge_on_tell_of_one_jump_together(sliver_rad, until_m):
    """A card on whose right edge a brighter face goes on into the depth, so that all but nothing is
    seen of
    it: where its two edges lie side by side on the film they move by their own depths."""
    corners = np.array([[-5.0, -0.3, 2], [0.2, -0.3, 2], [0.2, 0.3, 2], [-5, 0.3, 2]])
    deeper = corners[1:3] * until_m / 2 + np.array([until_m * sliver_rad, 0, 0])
    vertices = np.concatenate([corners, deeper])
    faces = np.array([[0, 2, 1], [0, 3, 2], [1, 2, 5], [1, 5, 4]])
    light = np.array([RADIANCE, RADIANCE, 240.0, 240.0])
    scene = MitsubaScene(
        {"card": emissive_mesh(backend.mitsuba(), vertices, faces, light)}, merge=False
    )
    camera = render.Camera(Pinhole(11.0), 40, 40, 0.25, 1)
    truth = -((RADIANCE - 240.0) * 44 / 2 + 240.0 * 44 / until_m) * 0.6 * 44 / 2
    assert sideways(camera, scene) == pytest.approx(truth, rel=1e-3)


@pytest.mark.parametrize("thick_m", [1e-7, 1e-6])
def test_a_plate_narrower_than_a_reading_changes_nothing_before_a_picture(thick_m):
    """Its two sides tell of faces of their own, whose jumps would not cancel."""
    mi = backend.mitsuba()
    picture = mi.Bitmap(np.linspace(40, 60, 64 * 64 * 3).reshape(64, 64, 3).astype("f"))
    radiance = {"type": "bitmap", "bitmap": picture, "raw": True, "wrap_mode": "clamp"}
    place = mi.ScalarTransform4f().translate([0, 0, 4]).rotate([0, 1, 0], 180).scale(5)
    wall = {
        "type": "rectangle",
        "to_world": place,
        "emitter": {"type": "area", "radiance": radiance},
    }
    vertices = CORNERS * [thick_m / 2, 0.3, 0.3] + [0, 0, 2.3]
    plate = emissive_mesh(mi, vertices, CUBE, np.linspace(20, 200, len(CUBE)))
    camera = render.Camera(Pinhole(11.0), 40, 40, 0.25, 4)
    found, bare = (
        sideways(camera, MitsubaScene({"wall": wall, **more}, merge=False))
        for more in ({"plate": plate}, {})
    )
    assert found == pytest.approx(bare, rel=1e-3)


def test_a_face_narrower_than_a_reading_is_no_second_edge():
    """Of a card with a lip that recedes steeply at its right side, 2 mm before a wall that shines
    half as bright."""
    corners = [[x, y, z] for x, z in ((-9, 4), (0.08, 4), (0.08001, 4.001)) for y in (-9.0, 9.0)]
    faces = [[0, 1, 3], [0, 3, 2], [2, 3, 5], [2, 5, 4]]
    wall = [[-9, -9, 4.003], [-9, 9, 4.003], [9, -9, 4.003], [9, 9, 4.003]]
    light = np.repeat([RADIANCE, RADIANCE / 2], [4, 2])
    both = np.concatenate([faces, 6 + np.array([[0, 1, 3], [0, 3, 2]])])
    scene = MitsubaScene(
        {"mesh": emissive_mesh(backend.mitsuba(), np.array(corners + wall), both, light)}
    )
    camera = render.Camera(Pinhole(11.0), 60, 60, 0.05, 4)
    truth = -RADIANCE / 2 * 60 / (camera.slope_per_px() * 4.001)
    assert sideways(camera, scene) == pytest.approx(truth, rel=3e-3)


def test_light_of_a_small_far_tube_grows_as_the_camera_comes_nearer():
    """An open tube 580 radii away, seen nearly from its end, black inside: of its light 2 r times
    its length across the view is seen, which falls with the square of the distance."""
    radius, across = 0.8 / 580, math.hypot(5e-4, 7e-4)
    tube = {"type": "cylinder", "p0": [0, 0, 0.8], "p1": [5e-4, 7e-4, 0.805], "radius": radius}
    emitter = area(RADIANCE)
    scene = MitsubaScene({"tube": {**tube, "emitter": emitter}})
    camera = render.Camera(Pinhole(11.0), 16, 16, 0.0168, 4)
    found = moved(camera, scene, per_px=24.0)
    light = RADIANCE * 2 * radius * across / (0.8025 * camera.slope_per_px()) ** 2
    assert float(found[2]) == pytest.approx(2 / 0.8025 * light, rel=0.05)
