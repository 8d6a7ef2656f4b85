"""Edges of meshes: which of them may part two radiances, however the mesh is written; and what
coincides."""

import math

import numpy as np
import pytest
import torch

from codesign import backend
from codesign.render import MitsubaScene
from codesign.render.charts import emissive_mesh
from codesign.render.silhouettes import Circles, Segments, mesh_edges
from codesign.render.silhouettes.edges import edges_once, rims_once, segments
from scenes.build import pole
from tests.numbers import D, f64
from tests.render import solids
from tests.render.solids import CUBE, area

CORNERS = (solids.CORNERS + 1) / 2
LIGHT = area(1.0)


def tube(sides=64):
    """Vertices and faces of an open prism about the z axis."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.concatenate(
        [np.stack([np.cos(angle), np.sin(angle), 0 * angle + z], 1) for z in (0.0, 1.0)]
    )
    return ring, solids.squares(2, sides, around=True)


def silhouettes(edges, eye):
    """Edges of a list that are outlines from the eye and not from every side."""
    curve = Segments.of(edges)
    index, _ = curve.pieces(f64(eye), 10.0)
    return int((~curve.always[index]).sum())


def test_flat_diagonals_are_no_edges_and_inner_edges_count_at_silhouettes_only():
    edges = mesh_edges(CORNERS, CUBE)
    assert len(edges) == 12
    assert edges.always.all()
    edges = mesh_edges(*tube())
    assert edges.always.sum() == 128  # the open ends
    # of 64 inner edges, the two where the tube turns away
    assert silhouettes(edges, (5.0, 0.1, 0.5)) == 2


def test_faces_wound_against_their_neighbour_part_light_from_black():
    """Light leaves a face on one side, so a flat diagonal counts where its two triangles are wound
    differently."""
    some = np.random.default_rng(3).random(len(CUBE)) < 0.5
    edges = mesh_edges(CORNERS, np.where(some[:, None], CUBE[:, ::-1], CUBE))
    assert len(edges) == 12 + int((some[::2] != some[1::2]).sum())
    assert edges.always.all()


def test_edges_whose_faces_both_turn_away_are_black_on_both_sides():
    edges = mesh_edges(CORNERS, CUBE)
    curve = Segments.of(edges)
    index, _ = curve.pieces(f64([3.0, 4.0, 5.0]), 10.0)
    assert len(index) == 9  # the three that meet in the far corner are not seen
    middle = (curve.start[index] + curve.end[index]) / 2
    assert (middle.sum(1) > 0.75).all()
    facing = ((middle - 0.5).abs() < 0.25).any(1) & (middle > 0.75).sum(1).eq(2)
    eye = f64([[3.0, 4, 5]])
    # where two seen sides meet
    assert torch.equal(curve.face_slope(index, middle, eye).isfinite(), facing)
    # a square at x = 0, its normal along -x: black from here, and in the way
    edges = mesh_edges(CORNERS, CUBE[:2])
    index, _ = Segments.of(edges).pieces(f64([3.0, 4, 5]), 10.0)
    assert len(index) == 4


def test_one_vertex_per_corner_of_every_face_is_the_same_mesh():
    """As an STL file has it, with vertices rounded apart by a unit in the last place of float32."""
    ring, sides = tube()
    corners = ring[sides.reshape(-1)] * (
        1 + 1e-7 * np.random.default_rng(0).choice([-1, 0, 1], (sides.size, 1))
    )
    edges = mesh_edges(corners, np.arange(sides.size).reshape(-1, 3))
    assert len(edges) == 128 + 64
    assert edges.always.sum() == 128
    assert silhouettes(edges, (5.0, 0.1, 0.5)) == 2


def test_faces_without_area_are_left_out():
    nothing = np.array([[0, 0, 1], [2, 2, 2], [0, 3, 0]])
    assert len(mesh_edges(CORNERS, np.concatenate([CUBE, nothing]))) == 12
    middle = np.concatenate([CORNERS, [[0.0, 0.5, 0.5]]])  # on the diagonal of the first side
    assert len(mesh_edges(middle, np.concatenate([CUBE, [[0, 8, 3]]]))) >= 12
    assert len(mesh_edges(CORNERS, np.zeros((0, 3), dtype=int))) == 0
    assert len(mesh_edges(np.zeros((4, 3)), CUBE[:1])) == 0


def test_an_edge_of_three_faces_counts_from_every_side():
    """A fin on a flat sheet: its foot is no crease of the sheet, and an edge all the same."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]])
    edges = mesh_edges(vertices, np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]]))
    assert len(edges) == 7
    assert edges.always.all()
    foot = (np.abs(edges.start[:, 1:]).max(1) == 0) & (np.abs(edges.end[:, 1:]).max(1) == 0)
    assert foot.sum() == 1


def test_edges_between_faces_of_unequal_radiance_count_even_where_flat():
    """A flat grid of n x n squares in rows of one radiance: n - 1 lines of n edges between rows,
    and the rim."""
    n = 7
    vertices = np.stack([*np.mgrid[: n + 1, : n + 1], np.zeros((n + 1, n + 1))], 2).reshape(-1, 3)
    faces = solids.squares(n + 1, n + 1)
    row = np.arange(n * n) // n
    light = np.repeat(np.random.default_rng(1).random(n)[row], 2)
    values = np.repeat(light[:, None, None], 3, 1)
    assert len(mesh_edges(vertices, faces)) == 4 * n
    edges = mesh_edges(vertices, faces, values)
    assert len(edges) == 4 * n + (n - 1) * n
    assert edges.always.all()
    mi = backend.mitsuba()
    (curve,) = MitsubaScene({"grid": emissive_mesh(mi, vertices, faces, light)}).outline()
    assert isinstance(curve, Segments)
    assert curve.start.shape[0] == 4 * n + (n - 1) * n


def lines(*ends):
    ends = np.array(ends, dtype=float)
    return segments(ends[:, 0], ends[:, 1])


@pytest.mark.parametrize("shift", [0.0, 3e-5, 0.49999e-4, 0.5e-4])
def test_where_edges_overlap_does_not_hang_on_rounding(shift):
    """Stretches of a slanted line from many intervals, moved about by less than the tolerance:
    their union, once."""
    rng = np.random.default_rng(5)
    along = np.array([0.36, 0.48, 0.8])
    begin = rng.uniform(0, 3, 12)
    end = begin + rng.uniform(0.05, 0.6, 12)
    place = np.array([shift, -1.3, 0.4]) + np.stack([begin, end], 1)[..., None] * along
    place += rng.uniform(-1e-6, 1e-6, place.shape)
    edges = edges_once([lines(pair) for pair in place], 1e-4)
    order = np.argsort(begin)
    union, reached = 0.0, -math.inf
    for k in order:
        union += max(0.0, end[k] - max(begin[k], reached))
        reached = max(reached, end[k])
    assert float(edges.length_m.sum()) == pytest.approx(union, abs=1e-4)
    assert edges.width_m.max() < 4e-6


def test_edges_that_count_as_one_are_read_from_beyond_both():
    edges = edges_once([lines([(0, 0, 0), (1, 0, 0)]), lines([(0, 6e-5, 0), (1, 6e-5, 0)])], 1e-4)
    assert len(edges) == 1
    assert float(edges.width_m[0]) == pytest.approx(6e-5, rel=1e-6)
    curve = Segments.of(edges)
    eye = f64([0.5, 0.0, 2.0])
    assert curve.aside_rad(torch.zeros(1).long(), eye) > 1e-5 + 6e-5 / 2


def test_boxes_of_different_sizes_that_touch_share_their_edges():
    """Two boxes side by side, fronts and floors flush: along the lower's edges every stretch once.
    Total length by hand: two boxes' edges less what both have."""
    mi = backend.mitsuba()
    T = mi.ScalarTransform4f
    low = {
        "type": "cube",
        "to_world": T().translate([0.5, 0.5, 0.25]).scale([0.5, 0.5, 0.25]),
        "emitter": LIGHT,
    }
    tall = {
        "type": "cube",
        "to_world": T().translate([1.5, 0.25, 0.5]).scale([0.5, 0.25, 0.5]),
        "emitter": LIGHT,
    }
    curves = MitsubaScene({"low": low, "tall": tall}, merge=False).outline()
    (edges,) = [curve for curve in curves if isinstance(curve, Segments)]
    length = (edges.end - edges.start).norm(dim=1)
    # edges of 1 x 1 x 0.5 and of 1 x 0.5 x 1 m; at x = 1 they share 0.5 m of the floor's and 0.5 m
    # of the front's
    assert float(length.sum()) == pytest.approx(4 * 2.5 + 4 * 2.5 - 0.5 - 0.5, abs=1e-5)


def test_a_pole_and_its_lid_have_one_rim():
    mi = backend.mitsuba()
    tube_of, lid = pole(mi, (0.1, 0.2, 0.0), (0.4, 0.1, 1.3), 0.05)
    curves = MitsubaScene(
        {"tube": {**tube_of, "emitter": LIGHT}, "lid": {**lid, "emitter": LIGHT}}
    ).outline()
    (rims,) = [curve for curve in curves if isinstance(curve, Circles)]
    assert rims.centre.shape[0] == 2
    turned = np.array([[0.0, 0.0, 1.0]] * 3)
    u = np.array([[1.0, 0, 0], [0.6, 0.8, 0], [0.5, 0, 0]])
    v = np.array([[0.0, 1, 0], [0.8, -0.6, 0], [0.0, 0.5, 0]])
    # the same circle turned and mirrored, and a smaller one
    assert len(rims_once(turned, u, v, 0 * u, np.zeros(3), 1e-4)[0]) == 2


def test_the_far_end_of_a_tube_is_hidden_by_its_near_wall():
    """Seen from above and aside: all of the upper rim, and of the lower one what faces the eye."""
    tube_of = {
        "type": "cylinder",
        "p0": [0, 0, 0],
        "p1": [0, 0, 1],
        "radius": 0.1,
        "emitter": LIGHT,
    }
    curves = MitsubaScene({"tube": tube_of}).outline()
    (rims,) = [curve for curve in curves if isinstance(curve, Circles)]
    index = torch.arange(2).repeat_interleave(50)
    eye = f64([[0.0, -3.0, 3.0]])
    y = rims.points(index, torch.arange(100, dtype=D) / 50, eye)
    assert torch.equal(rims.counts(index, y, eye), (y[:, 2] > 0.5) | (y[:, 1] < -0.1 * 0.1 / 3))
