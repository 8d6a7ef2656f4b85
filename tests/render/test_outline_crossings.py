"""Curves along which shapes pass through each other: closed forms, and gradients against
differences."""

import itertools
import math

import numpy as np
import pytest
import torch

from codesign import backend, pose, render
from codesign.errors import DomainError
from codesign.lens import Pinhole
from codesign.render import MitsubaScene
from codesign.render.silhouettes import Segments, outlines
from codesign.render.silhouettes.crossings import Overlaps, find_crossings, overlaps
from codesign.render.silhouettes.intersections import Intersections
from codesign.render.silhouettes.shapes import Mesh, read
from tests.numbers import D, close, f64, rand64
from tests.render.solids import CORNERS, CUBE, area, squares

EYE = f64([0.3, -4.0, 2.0])


def place():
    return backend.mitsuba().ScalarTransform4f()


def curves(**shapes):
    mi = backend.mitsuba()
    scene = mi.load_dict({"type": "scene", **shapes}, optimize=False)
    return outlines([read(mi, shape) for shape in scene.shapes()])


def intersection(**shapes):
    """Points [n, 3] along the one curve on round shapes, in order of pieces, and its length."""
    (found,) = [curve for curve in curves(**shapes) if isinstance(curve, Intersections)]
    index, bounds = found.pieces(EYE, 0.05)
    s = bounds[:, :1] + torch.linspace(0, 1, 9, dtype=D) * (bounds[:, 1:] - bounds[:, :1])
    y = found.points(index[:, None].expand(s.shape).reshape(-1), s.reshape(-1), EYE).reshape(
        *s.shape, 3
    )
    assert (found.aside_rad(index, EYE) > 0.9e-5).all()
    return y.reshape(-1, 3), float((y[:, 1:] - y[:, :-1]).norm(dim=2).sum())


def total_length(found):
    (edges,) = [curve for curve in found if isinstance(curve, Segments)]
    return float((edges.end - edges.start).norm(dim=1).sum())


def test_a_box_through_a_floor_and_through_a_box():
    floor = {"type": "rectangle", "to_world": place().scale(3)}
    box = {
        "type": "cube",
        "to_world": place().translate([0.2, 0.1, 0.3]).rotate([0, 0, 1], 20).scale([0.4, 0.6, 0.5]),
    }
    assert total_length(curves(box=box, floor=floor)) == pytest.approx(
        24 + 8 * 1.5 + 4 * 1.0, abs=1e-4
    )
    other = {"type": "cube", "to_world": place().translate([0.9, 0.8, 0.7])}
    # cubes of side 2 whose corners overlap by 1.1 x 1.2 x 1.3 m: three pairs of faces cross along
    # each of these
    assert total_length(curves(a={"type": "cube"}, b=other)) == pytest.approx(
        48 + 2 * (1.1 + 1.2 + 1.3), abs=1e-4
    )


@pytest.mark.parametrize("sunk_m", [0.0, 1e-7, -1e-7, 5e-5])
def test_what_stands_on_a_floor_has_its_edges_once(sunk_m):
    """A box and a pole that touch the floor, to rounding or to a hair: no curve beside the box's
    edges and the rim, which are read from beyond the hair."""
    floor = {"type": "rectangle", "to_world": place().scale(3)}
    box = {
        "type": "cube",
        "to_world": place().translate([0.5, 0.1, 0.5 - sunk_m]).scale([0.2, 0.3, 0.5]),
    }
    pole = {"type": "cylinder", "p0": [-0.5, 0.0, -sunk_m], "p1": [-0.5, 0.0, 1.0], "radius": 0.1}
    found = curves(floor=floor, box=box, pole=pole)
    assert total_length(found) == pytest.approx(24 + 4 * (0.4 + 0.6 + 1.0), abs=1e-3)
    assert not any(isinstance(curve, Intersections) for curve in found)
    widest = max(float(curve.width_m.max()) for curve in found if hasattr(curve, "width_m"))
    assert widest == pytest.approx(abs(sunk_m), abs=3e-7)


def test_half_a_ball_of_triangles_sunk_to_its_very_equator_has_it_as_an_edge():
    """A smooth mesh with a ring of vertices in the floor's plane: its edges there are no creases,
    and count."""
    n = 24
    turn = 2 * np.pi * np.arange(n) / n
    rings = [
        np.stack([r * np.cos(turn), r * np.sin(turn), 0 * turn + z], 1)
        for r, z in ((0.9, -0.5), (1, 0), (0.9, 0.5))
    ]
    drum = Mesh("drum", np.concatenate(rings), squares(3, n, around=True), None)
    floor = Mesh("floor", 3 * CORNERS[::2] * [1, 1, 0], np.array([[0, 2, 3], [0, 3, 1]]), None)
    found, _ = find_crossings([drum, floor])
    length = np.linalg.norm(found.end - found.start, axis=1).sum()
    assert length == pytest.approx(n * 2 * math.sin(math.pi / n), rel=1e-9)


def test_meshes_that_do_not_cross_themselves_have_no_crossing():
    """A bumpy sheet: neighbours touch along edges and at corners only; and a cube inside
    another."""
    n = 30
    x, y = np.mgrid[:n, :n]
    vertices = np.stack([x, y, np.random.default_rng(0).normal(size=(n, n))], 2).reshape(-1, 3)
    sheet = Mesh("sheet", vertices, squares(n, n), None)
    assert len(find_crossings([sheet])[0].start) == 0
    nested = Mesh(
        "nested", np.concatenate([CORNERS, 0.5 * CORNERS]), np.concatenate([CUBE, CUBE + 8]), None
    )
    assert len(find_crossings([nested])[0].start) == 0


@pytest.mark.parametrize("shift", [0.0, 1e-7])
def test_faces_in_one_plane_are_refused_where_they_are_seen(shift):
    """A picture hung into the plane of its wall; not where both show one radiance, or are tiles
    side by side, or seen from behind, or out of view."""
    T = place()

    def tile(x, value, half=0.5, height=0.0):
        to_world = T.translate([x, 0.2, height]).rotate([0, 0, 1], 20).scale([half, half, 1])
        light = area(value)
        return {"type": "rectangle", "to_world": to_world, "emitter": light}

    def seen(picture, eye):
        over = [c for c in curves(wall=tile(0.0, 1.0), picture=picture) if isinstance(c, Overlaps)]
        index = [curve.pieces(f64(eye), 0.1)[0] for curve in over]
        return bool(index) and index[0].numel() > 0

    assert seen(tile(0.1, 2.0, 0.1, shift), [0.0, 0.0, 3.0])
    assert not seen(tile(0.1, 2.0, 0.1, shift), [0.0, 0.0, -3.0])
    assert not seen(tile(0.1, 1.0, 0.1, shift), [0.0, 0.0, 3.0])
    assert not seen(tile(0.1, 2.0, 0.1, 1e-3), [0.0, 0.0, 3.0])
    beside = tile(0.0, 2.0)
    beside["to_world"] = (
        T.translate([0.0, 0.2, shift])
        .rotate([0, 0, 1], 20)
        .translate([1.0, 0.3, 0])
        .scale([0.5, 0.5, 1])
    )
    assert not seen(beside, [0.0, 0.0, 3.0])
    scene = MitsubaScene(
        {"wall": tile(0.0, 1.0), "picture": tile(0.1, 2.0, 0.1, shift)}, merge=False
    )
    camera = render.Camera(Pinhole(11.0), 16, 16, 0.5, 4)
    above = pose.look_at((0.0, -0.3, 2.0), (0.0, 0.2, 0.0))[None].requires_grad_(True)
    with pytest.raises(
        DomainError,
        match=r"faces of shapes '(wall|picture)' and '(wall|picture)' lie in one plane near",
    ):
        render.frames(camera, scene, above, gradient="boundary")
    away = pose.look_at((0.0, -0.3, 2.0), (0.0, -9.0, 2.0))[None].requires_grad_(True)
    assert (
        torch.autograd.grad(render.frames(camera, scene, away, gradient="boundary").sum(), away)[0]
        .abs()
        .sum()
        == 0
    )


def test_what_two_triangles_in_a_plane_share_has_its_middle_where_its_corners_say(generator):
    """Corners: where lines of two of the six sides meet that lie within all six."""
    p, q = (rand64(generator, 60, 3, 2).numpy() for _ in range(2))
    normal = np.tile([0.0, 0.0, 1.0], (60, 1))
    rows, middle, end = overlaps(
        *(np.pad(v, ((0, 0), (0, 0), (0, 1))) for v in (p, q)), normal, 1e-6
    )
    for k in range(60):
        corners = np.array(list(shared(p[k], q[k])))
        assert (k in rows) == (len(corners) > 2)
        if k in rows:
            at = int(np.nonzero(rows == k)[0][0])
            np.testing.assert_allclose(middle[at, :2], corners.mean(0), atol=1e-6)
            assert np.linalg.norm(corners - end[at, :2], axis=1).min() < 1e-6


def shared(*triangles):
    """Corners of what two triangles [3, 2] share."""
    begin = np.concatenate(triangles)
    along = np.concatenate([np.roll(t, -1, axis=0) - t for t in triangles])
    out = np.stack([along[:, 1], -along[:, 0]], 1)
    out *= np.sign([np.linalg.det(np.diff(t, axis=0)) for t in triangles]).repeat(3)[:, None]
    level = (out * begin).sum(1)
    for pair in itertools.combinations(range(6), 2):
        at = np.linalg.solve(out[list(pair)], level[list(pair)])
        if (out @ at <= level + 1e-12).all():
            yield at


def circle(radius):
    """Length of a circle."""
    return 2 * math.pi * radius


def ellipse(a, b):
    """Circumference by quadrature."""
    t = (np.arange(10000) + 0.5) / 10000 * 2 * np.pi
    return np.hypot(a * np.sin(t), b * np.cos(t)).mean() * 2 * np.pi


def sphere(*centre, radius):
    return {"type": "sphere", "center": list(centre), "radius": radius}


def cylinder(end, radius):
    return {"type": "cylinder", "p0": [-v for v in end], "p1": list(end), "radius": radius}


LEAN = math.radians(35)
MEET = (0.6**2 + 0.5**2 - 0.4**2) / (2 * 0.6)  # of two spheres, from the first one's centre


@pytest.mark.parametrize(
    ("one", "other", "off", "length", "rel"),
    [
        *(
            (
                sphere(0.1, 0.2, height, radius=0.8),
                None,
                lambda x, y, z: z,
                circle(math.sqrt(0.8**2 - height**2)),
                1e-4,
            )
            for height in (0.0, 0.3, -0.77)
        ),
        (
            sphere(0, 0, 0, radius=0.5),
            sphere(0.0, 0.6, 0.0, radius=0.4),
            lambda x, y, z: y - MEET,
            circle(math.sqrt(0.5**2 - MEET**2)),
            1e-4,
        ),
        # half axes r and r / cos of the lean
        (
            cylinder((math.sin(LEAN), 0.0, math.cos(LEAN)), 0.2),
            None,
            lambda x, y, z: torch.hypot(x * math.cos(LEAN), y) - 0.2,
            ellipse(0.2 / math.cos(LEAN), 0.2),
            1e-4,
        ),
        # two ellipses in the planes x = +z and x = -z, half axes r and r sqrt(2); they cross where
        # surfaces touch
        (
            cylinder((1.0, 0, 0), 0.3),
            cylinder((0, 0, 1.0), 0.3),
            lambda x, y, z: 1e-3 * (x.abs() - z.abs()),
            2 * ellipse(0.3 * math.sqrt(2), 0.3),
            0.01,
        ),
    ],
    ids=["equator", "above", "below", "spheres", "leaning pole", "Steinmetz"],
)
def test_round_shapes_meet_others_in_curves_of_closed_form(one, other, off, length, rel):
    """off: how far a point is from the curve, m. A floor where there is no other shape."""
    floor = {"type": "rectangle", "to_world": place().scale(3)}
    y, found = intersection(one=one, other=other or floor)
    away = off(*y.unbind(1))
    close(away, torch.zeros_like(away), atol=1.1e-7)
    assert found == pytest.approx(length, rel=rel)
