"""What a lens, its figures and its design refuse: the calls and sentences of refusals.txt."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign import lens, render
from codesign.errors import CodesignError
from codesign.lens import (
    GeoLens,
    Glass,
    Spectrum,
    Surface,
    analysis,
    design,
    diffraction,
    paraxial,
    solves,
    spectrum,
)
from codesign.lens.design import constraints, hits, precision, tolerance
from tests import refusals
from tests.lens.systems import PLANE, close, glass, paraboloid
from tests.numbers import f64

NAN, INF = math.nan, math.inf
CROWN, FLINT = glass(1.5), Glass.named("F2")
SINGLET = [Surface(50.0, 5.0, CROWN, 5.0), Surface(-50.0, 5.0, None, 5.0)]
WINDOW = GeoLens([Surface(PLANE, 5.0, CROWN, 5.0), Surface(PLANE, 5.0, None, 5.0)], 3.0)
DIVERGING = GeoLens([Surface(-40.0, 2.0, CROWN, 5.0), Surface(40.0, 20.0, None, 5.0)], 4.0)
MIRROR = GeoLens(
    [Surface(-300.0, 30.0, None, 10.0, mirror=True), Surface(PLANE, 5.0, None, 9.0)], 8.0
)
MANGIN_FACES = [Surface(-80.0, 4.0, CROWN, 10.0), Surface(-120.0, 4.0, CROWN, 10.0, mirror=True)]
MANGIN = GeoLens([*MANGIN_FACES, Surface(80.0, 60.0, None, 10.0)], 10.0)
# a plate in front of it, passed on the way there and back
TWICE = GeoLens(
    [
        Surface(-60.0, 3.0, FLINT, 10.0, is_stop=True),
        Surface(-90.0, 5.0, None, 10.0),
        *MANGIN_FACES,
        Surface(80.0, 5.0, None, 10.0),
        Surface(90.0, 3.0, FLINT, 10.0),
        Surface(60.0, 60.0, None, 10.0),
    ],
    10.0,
)
# one surface focuses at n R / (n - 1) = 90 mm inside the glass: a surface there meets the axial ray
# at height 0
AT_IMAGE = GeoLens([Surface(30.0, 90.0, CROWN, 5.0), Surface(-40.0, 10.0, None, 5.0)], 4.0)
# reflects everything that comes from 8 mm off the axis behind it
BALL_FACES = [Surface(5.0, 10.0, CROWN, 4.99, is_stop=True), Surface(-5.0, 8.0, None, 4.99)]
BALL = GeoLens(BALL_FACES, 8.0, name="ball")
NARROW = GeoLens(
    [Surface(50.0, 3.0, CROWN, 5.0, is_stop=True), Surface(-50.0, 40.0, None, 0.01)], 4.0
)
# stop in the front focal plane of a thin plano-convex lens: f = R / (n - 1) = 100
STOP = Surface(PLANE, 100.0, None, 5.0, is_stop=True)
TELECENTRIC = GeoLens([STOP, Surface(50.0, 1.0, CROWN, 9.0), Surface(PLANE, 100.0, None, 9.0)], 3.0)
ORIGIN, AHEAD = f64([[0.0, 0.0, -5.0]]), f64([[0.0, 0.0, 1.0]])
PLATE = diffraction.ZernikePlate({4: 0.0}, 4.0)
# small, but with detail between cells
RIPPLE = diffraction.GridPlate(f64([[0.1 * (row % 2 == 0)] * 121 for row in range(121)]), 0.07)
FLAT = (np.array([0.4, 0.7]), np.array([1.0, 1.0]))


def built(**part):
    return GeoLens([Surface(50.0, 5.0, None, 5.0, **part)], 4.0)


def of_glass(glass):
    return GeoLens([Surface(50.0, 4.0, glass, 5.0), Surface(60.0, 40.0, None, 5.0)], 5.0)


def stopped(at, **options):
    faces = [Surface(50.0 - 130 * i, 5.0, None, 5.0, is_stop=i == at) for i in range(2)]
    return GeoLens(faces, 4.0, **options)


def load_state(lens, saved):
    """A state loaded where it does not belong: no hybrid comes of it, however strict the load."""
    before = {name: value.clone() for name, value in lens.state_dict().items()}
    with pytest.raises(CodesignError):
        lens.load_state_dict(saved.state_dict(), strict=False)
    assert all(torch.equal(value, before[name]) for name, value in lens.state_dict().items())
    lens.load_state_dict(saved.state_dict())


def curvatures(count):
    return [
        tolerance.Error(f"curvature of surface {i + 1}", "curvature_per_mm", (i,), 0.5)
        for i in range(count)
    ]


def linear(*slopes):
    return tolerance.Forecast(3.0, f64(slopes), torch.zeros(len(slopes), len(slopes)).double())


def trials(geo, count):
    varied = tolerance.Tolerances(index=1e-4)
    return tolerance.monte_carlo(geo, varied, lambda g: g.thickness_mm, count, torch.Generator())


def lit(wavelengths, values, count=3, response=FLAT):
    curves = [tuple(map(np.array, curve)) for curve in (response, (wavelengths, values))]
    return Spectrum.from_curves(*curves, count)


def page(**changes):
    whole = {"name": "a", "model": "sellmeier", "coefficients": [1.0, 0.01], "range_um": [0.3, 2.0]}
    return Glass.from_dict(whole | changes)


NAMES = vars(math) | {
    "paraboloid": paraboloid,
    "Camera": render.Camera,
    "Film": render.Film,
    "SimpleNamespace": SimpleNamespace,
}
for module in (lens, analysis, design, diffraction, spectrum, constraints, hits, precision):
    NAMES |= vars(module)
NAMES |= vars(tolerance) | vars(paraxial) | vars(solves) | globals()


@pytest.fixture
def triplet():
    return lens.load("cooke-triplet")


@refusals.table(__file__)
def test_what_cannot_be_gets_a_sentence(row, triplet, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.json").mkdir()
    (tmp_path / "lens.doc").write_text("{}")
    assert len(row.holds(NAMES | {"geo": triplet})) < 500
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder.json", "lens.doc"]


def test_the_limit_that_a_sentence_names_is_the_limit(triplet):
    with pytest.raises(CodesignError) as raised:
        triplet.focus_at(0.03)
    limit = float(str(raised.value).split("more than ")[1].split(" m")[0])
    assert triplet.focus_at(limit + 1e-4).thickness_mm[-1].detach() > 1e3
    with pytest.raises(CodesignError, match="does not converge"):
        triplet.focus_at(limit - 1e-4)


def test_what_variables_make_cannot_be_frozen_alone(triplet):
    triplet.variables("curvature")
    with pytest.raises(CodesignError, match="made from variables"):
        triplet.freeze("curvature_per_mm")
    assert not triplet.freeze().first_order().efl_mm.requires_grad


def test_the_grid_that_a_sentence_asks_for_is_enough():
    stop = Surface(PLANE, 4.0, None, 6.0, is_stop=True)
    geo = GeoLens([stop, SINGLET[0], Surface(-70.0, 60.0, None, 5.0)], 8.0)
    steep = diffraction.with_plate(geo, diffraction.ZernikePlate({11: 60.0}, 4.0), z_mm=1.0)
    with pytest.raises(
        CodesignError, match=r"finer than 64 cells .* give a grid of at least"
    ) as caught:
        analysis.pupil_function(steep, 0.0, grid=64)
    needed = int(str(caught.value).split("at least ")[1].split(",")[0])
    # a phase c Z11 steps by c sqrt(5) (24 - 12) / pi waves per radius at the rim; half a wave from
    # cell to cell
    close(needed, 60 * math.sqrt(5) * 12 / (2 * math.pi) * 2 * 2, 0.02)
