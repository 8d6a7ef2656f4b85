"""Elements moved as rigid bodies against a tracer that knows spheres by their centres, and closed forms."""

import math

import numpy as np
import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.design import groups, moved_element
from codesign.lens.design.hits import rim_rays
from tests.lens.systems import PLANE, check_gradient, glass

D = torch.float64
real = np.longdouble
AXIS = torch.tensor([[0.0, 0.0, -1.0]], dtype=D), torch.tensor([[0.0, 0.0, 1.0]], dtype=D)


def turned(point, pivot, tilt):
    """A point turned about x by the first angle, then about the turned y axis by the second, around a
    pivot."""
    a, b = (real(angle) for angle in tilt)
    x, y, z = np.asarray(point, real) - pivot
    x, z = x * np.cos(b) + z * np.sin(b), z * np.cos(b) - x * np.sin(b)
    y, z = y * np.cos(a) - z * np.sin(a), y * np.sin(a) + z * np.cos(a)
    return np.array([x, y, z], real) + pivot


class Bodies:
    """A lens in space: of every surface a vertex and a centre of curvature (for a plane a point on its
    normal)."""

    def __init__(self, geo):
        z = np.concatenate([[0], np.cumsum(np.array(geo.thickness_mm.tolist(), real))])
        self.film = z[-1]
        self.radius = [1 / real(c) if c else None for c in geo.curvature_per_mm.tolist()]
        self.vertex = [np.array([0, 0, v], real) for v in z[:-1]]
        pairs = zip(self.vertex, self.radius, strict=True)
        self.centre = [v + np.array([0, 0, r or 1], real) for v, r in pairs]
        self.index = [real(n) for n in geo.index().tolist()]

    def move(self, first, last, decentre, tilt, wedge):
        """Turn the last face about its vertex, the body about the first vertex, and shift it."""
        self.centre[last] = turned(self.centre[last], self.vertex[last], wedge)
        pivot = self.vertex[first].copy()
        shift = np.array([*decentre, 0], real)
        for points in (self.vertex, self.centre):
            for i in range(first, last + 1):
                points[i] = turned(points[i], pivot, tilt) + shift

    def trace(self, origin, direction):
        """Point on the film and direction: nearest crossing to the vertex, vector form of Snell's law."""
        o, d = np.array(origin, real), np.array(direction, real)
        for i, r in enumerate(self.radius):
            if r is None:
                normal = self.centre[i] - self.vertex[i]
                step = (self.vertex[i] - o) @ normal / (d @ normal)
            else:
                away = o - self.centre[i]
                b = d @ away
                root = np.sqrt(b * b - away @ away + r * r)
                step = min((-b - root, -b + root), key=lambda s: np.linalg.norm(o + s * d - self.vertex[i]))
                normal = (self.centre[i] - (o + step * d)) / r
            o = o + step * d
            mu = self.index[i] / self.index[i + 1]
            cosine = d @ normal
            normal, cosine = (normal, cosine) if cosine > 0 else (-normal, -cosine)
            d = mu * d + (np.sqrt(1 - mu * mu * (1 - cosine * cosine)) - mu * cosine) * normal
        o = o + (self.film - o[2]) / d[2] * d
        return o[:2].astype(float), d.astype(float)


@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss"])
def test_moved_elements_are_rigid_bodies(name, generator):
    """Three elements one after another, with errors a hundred times those of a workshop."""
    geo = lens.load(name).freeze()
    bodies = Bodies(geo)
    moved = geo
    for faces in groups(geo)[:3]:
        errors = torch.randn(3, 2, dtype=D, generator=generator) * torch.tensor([[0.3], [0.03], [0.02]])
        moved = moved_element(moved, faces, *errors)
        bodies.move(*faces, *errors.tolist())
    starts = torch.tensor([(0.0, 0.0, -5.0), (2.5, -1.5, -5.0), (-1.0, 3.0, -5.0)], dtype=D)
    towards = torch.nn.functional.normalize(torch.tensor([[0.02, 0.1, 1.0]] * 3, dtype=D), dim=1)
    out = moved.trace(starts, towards)
    for i in range(3):
        position, leaving = bodies.trace(starts[i].tolist(), towards[i].tolist())
        # both programs agree to some 1e-13 mm on the lens at rest
        assert out.position_mm[i, :2].tolist() == pytest.approx(position.tolist(), abs=2e-12)
        assert out.direction[i].tolist() == pytest.approx(leaving.tolist(), abs=2e-14)
    assert float((out.position_mm - geo.trace(starts, towards).position_mm).abs().max()) > 0.05


def test_a_tilted_plate_shifts_a_ray_by_the_closed_form():
    """t sin(a) (1 - cos(a) / sqrt(n^2 - sin(a)^2)) along the tilt (Smith, Modern Optical Engineering, ch.
    4)."""
    n, t, a = 1.6, 5.0, 0.4
    front = Surface(90.0, 1e-3, glass(1.5), 9.0, is_stop=True), Surface(-90.0, 50.0, None, 9.0)
    plate = Surface(PLANE, t, glass(n), 9.0), Surface(PLANE, 30.0, None, 9.0)
    # a list is as good as a tensor
    geo = moved_element(GeoLens([*front, *plate], 5.0).freeze(), (2, 3), tilt_rad=[a, 0.0])
    wanted = t * math.sin(a) * (1 - math.cos(a) / math.sqrt(n * n - math.sin(a) ** 2))
    found = geo.trace(*AXIS)
    assert abs(float(found.position_mm[0, 1])) == pytest.approx(wanted, rel=1e-12)
    torch.testing.assert_close(found.direction, AXIS[1], rtol=0, atol=1e-15)
    # where the plate stands does not matter in parallel light
    far = moved_element(geo, (2, 3), decentre_mm=torch.tensor([0.3, 0.2], dtype=D))
    torch.testing.assert_close(far.trace(*AXIS).position_mm, found.position_mm, rtol=0, atol=1e-14)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_wedge_turns_a_ray_like_a_prism(axis):
    """asin(n sin(w)) - w behind a face that the light meets head on."""
    n, w = 1.7, 0.05
    plate = Surface(PLANE, 4.0, glass(n), 9.0, is_stop=True), Surface(PLANE, 10.0, None, 9.0)
    last = Surface(90.0, 1e-9, glass(1.0), 9.0), Surface(PLANE, 10.0, None, 9.0)
    wedge = w * torch.eye(2, dtype=D)[axis]
    out = moved_element(GeoLens([*plate, *last], 5.0).freeze(), (0, 1), wedge_rad=wedge).trace(*AXIS)
    sideways = float(out.direction[0, 1 - axis].abs())
    assert math.asin(sideways) == pytest.approx(math.asin(n * math.sin(w)) - w, rel=1e-12)


def test_a_concentric_shell_turned_about_its_centre_does_nothing():
    """Turning about the first vertex and shifting that vertex back on its circle is turning about the
    centre; the shift along the axis, r (1 - cos), is given to the gap in front."""
    r, t, a = 30.0, 4.0, 0.2
    shell = Surface(r, t, Glass.named("SF6"), 12.0), Surface(r - t, 40.0, None, 12.0)
    geo = GeoLens([Surface(PLANE, 10.0, None, 9.0, is_stop=True), *shell], 6.0).freeze()
    moved = moved_element(geo, (1, 2), [-r * math.sin(a), 0.0], [0.0, a])
    along = r * (1 - math.cos(a)) * torch.tensor([1.0, 0.0, -1.0], dtype=D)
    moved = moved.replace(thickness_mm=moved.thickness_mm + along)
    rays = rim_rays(geo, (0.0, 0.1))
    truth = geo.trace(*rays).position_mm
    torch.testing.assert_close(moved.trace(*rays).position_mm, truth, rtol=0, atol=1e-13)


@pytest.mark.parametrize("size", [0.01, 0.0])
def test_errors_of_an_element_have_gradients(size, generator):
    """At rest too, where the kernel would leave decentres out."""
    geo = lens.load("cooke-triplet").freeze()
    rays = rim_rays(geo, (0.1,), count=5)
    weights = torch.randn(6, 3, dtype=D, generator=generator)
    start = size * torch.randn(3, 2, dtype=D, generator=generator)

    def loss(errors):
        return (moved_element(geo, (2, 3), *errors).trace(*rays).position_mm * weights).sum()

    check_gradient(loss, start, step=1e-4 if size == 0 else 1e-3)
