"""What a lens and its figures refuse: the call, and part of the sentence."""

import math

import numpy as np
import pytest
import torch

from codesign import lens
from codesign.errors import CodesignError
from codesign.lens import (
    GeoLens,
    Glass,
    Phase,
    Spectrum,
    Surface,
    ThinLens,
    analysis,
    design,
    diffraction,
)
from codesign.lens.design import Limits, Tolerances, moved_element
from codesign.lens.design.constraints import rows
from codesign.lens.design.hits import traced_semi_aperture_mm
from codesign.lens.design.precision import cheapest
from codesign.lens.design.tolerance import Error, Forecast, compare, errors_of, monte_carlo, perturbed
from codesign.lens.diffraction import GridPlate, ZernikePlate
from codesign.lens.paraxial import cardinal_points, paraxial_rays
from codesign.lens.seidel import seidel_sums
from codesign.lens.solves import focus_paraxial, focus_rays, hold_efl, holding_surface
from codesign.lens.spectrum import blackbody, silicon_response
from tests.lens.systems import PLANE, glass, paraboloid

NAN, INF = math.nan, math.inf
D = torch.float64
CROWN = glass(1.5)
SINGLET = [Surface(50.0, 5.0, CROWN, 5.0), Surface(-50.0, 5.0, None, 5.0)]
WINDOW = GeoLens([Surface(PLANE, 5.0, CROWN, 5.0), Surface(PLANE, 5.0, None, 5.0)], 3.0)
BUILDS = {
    "no surface": (lambda: GeoLens([], 3.0), "at least one surface"),
    "two stops": (
        lambda: GeoLens([Surface(50.0, 5.0, CROWN, 5.0, is_stop=True)] * 2, 3.0),
        r"surfaces \[1, 2\] are all marked as the stop",
    ),
    "a name for a glass": (lambda: GeoLens([Surface(20.0, 2.0, "N-BK7", 5.0)], 4.0), "give Glass.named"),
}
SURFACES = [
    ({"inner_semi_aperture_mm": 6.0}, "central obstruction of 6.0 mm"),
    ({"tilt_deg": (95.0, 0.0)}, "must stay below 90"),
    ({"phase": Phase(())}, "needs finite coefficients"),
    ({"phase": Phase((1.0,), 1, -0.5)}, "blaze_um must be .* got -0.5"),
    ({"mirror": True, "phase": Phase((1.0,))}, "phase on a mirror is not traced"),
    ({"decentre_mm": (NAN, 0.0)}, "must be finite"),
]


def check(call, said):
    with pytest.raises(CodesignError, match=said) as caught:
        call()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("what", BUILDS)
def test_lenses_that_cannot_be(what):
    check(*BUILDS[what])


@pytest.mark.parametrize(("part", "said"), SURFACES)
def test_surfaces_that_cannot_be(part, said):
    check(lambda: GeoLens([Surface(50.0, 5.0, None, 5.0, **part)], 4.0), said)


DIVERGING = GeoLens([Surface(-40.0, 2.0, CROWN, 5.0), Surface(40.0, 20.0, None, 5.0)], 4.0)
MIRROR = GeoLens([Surface(-300.0, 30.0, None, 10.0, mirror=True), Surface(PLANE, 5.0, None, 9.0)], 8.0)
MANGIN = GeoLens(
    [
        Surface(-80.0, 4.0, CROWN, 10.0, is_stop=True),
        Surface(-120.0, 4.0, CROWN, 10.0, mirror=True),
        Surface(80.0, 60.0, None, 10.0),
    ],
    10.0,
)
# one surface focuses at n R / (n - 1) = 90 mm inside the glass: a surface there meets the axial ray at
# height 0
AT_IMAGE = GeoLens([Surface(30.0, 90.0, CROWN, 5.0), Surface(-40.0, 10.0, None, 5.0)], 4.0)
BEFORE = r"not lie before the lens; give distances above 0\.01"
NO_NUMBER = r"distances: .* is no real number and no list of them; give numbers"
ONE = "figure of one object distance"
ELSEWHERE = "has no origin|no place|no distance helps, as the lens diverges"
# of the Cooke triplet
LENS = [
    (lambda geo: geo.replace(radius=torch.zeros(2)), "no tensor 'radius'"),
    (lambda geo: geo.replace(thickness_mm=torch.zeros(3)), r"thickness_mm has shape \(6,\), got \(3,\)"),
    (lambda geo: geo.replace(glass=torch.zeros(6)), "replace_glass"),
    (lambda geo: geo.replace(medium=torch.zeros(6)), "replace_glass"),
    (lambda geo: geo.freeze("thicknes_mm"), "no tensor 'thicknes_mm'"),
    (lambda geo: ThinLens(50.0, 10.0).replace(radius=torch.tensor(1.0)), "it has efl_mm, image_distance_mm"),
    (lambda geo: geo.replace_glass(2, "N-BK77"), r"surface 3: glass 'N-BK77' .*; the nearest.* N-BK7"),
    *((lambda geo, at=at: geo.replace_glass(at, "SF2"), f"no surface {at}; it") for at in (6, -7, 1.0, True)),
    (lambda geo: geo.replace_glass(0, 1.5), "float is no medium"),
    (lambda geo: geo.replace_glass(0, Glass("far", "cauchy", (1.5,), (8.0, 12.0))), "587562 um lies outside"),
    (lambda geo: MIRROR.replace_glass(0, "SF2"), "surface 1: it is a mirror"),
    (lambda geo: WINDOW.first_order(), "afocal"),
    (
        lambda geo: WINDOW.replace(curvature_per_mm=torch.full((2,), NAN, dtype=D)).first_order(),
        "no finite power",
    ),
    (lambda geo: cardinal_points(WINDOW), "no cardinal points"),
    (lambda geo: paraxial_rays(geo, math.pi / 2), "at 90 degrees has no slope"),
    (lambda geo: lens.sum_over_chunks(torch.sum, rows=4), "rays hold"),
    (lambda geo: lens.sum_over_chunks(torch.sum, torch.zeros(0, 3), rows=4), "rays hold"),
    (lambda geo: lens.sum_over_chunks(torch.sum, torch.zeros(3), torch.zeros(2)), "rays hold"),
    (lambda geo: lens.sum_over_chunks(torch.sum, torch.zeros(()), rows=4), "rays hold"),
    (lambda geo: lens.sum_over_chunks(torch.sum, torch.zeros(3, 3), rows=0), "rows"),
]
DISTANCES = [
    *(
        (lambda geo, at=at: lens.rms_spot_mm(geo, [0.0], at_m=at), BEFORE)
        for at in (-1.0, 0.0, NAN, 0.004, -INF)
    ),
    (lambda geo: focus_rays(geo, [0.0], at_m=(1.0, -2.0)), BEFORE),
    (lambda geo: analysis.wavefront(geo, 0.1, at_m=0.01), BEFORE),
    (lambda geo: analysis.ray_fan(geo, 0.1, at_m=0.01), BEFORE),
    (lambda geo: analysis.diffraction_psf(geo, 0.1, at_m=0.01), BEFORE),
    (lambda geo: lens.spots(geo, [0.0], at_m=[[1.0]]), "one number or a list"),
    *(
        (lambda geo, at=at: lens.rms_spot_mm(geo, [0.0], at_m=at), NO_NUMBER)
        for at in ("0.5", None, 1j, [0.5, "a"])
    ),
    (lambda geo: geo.focus_at("0.5"), NO_NUMBER),
    (lambda geo: geo.variables("curvature", focus_at_m="a"), NO_NUMBER),
    (lambda geo: analysis.wavefront(geo, 0.1, at_m=(0.5, 1.0)), ONE),
    (lambda geo: analysis.polychromatic_spot(geo, 0.1, 0.58, at_m=(0.5, 1.0)), ONE),
    (lambda geo: analysis.through_focus_spot_mm(geo, [0.1], [0.0], at_m=(0.5, 1.0)), ONE),
    (lambda geo: analysis.diffraction_mtf(geo, 0.1, [10.0], at_m=(0.5, 1.0)), ONE),
    (lambda geo: seidel_sums(geo, 0.1, at_m=(0.5, 1.0)), ONE),
    (lambda geo: focus_paraxial(geo, at_m=(0.5, 1.0)), ONE),
    (lambda geo: ThinLens(50.0, 10.0).focus_at(0.05), "inside the focal length"),
    (lambda geo: ThinLens(50.0, 10.0).focus_at(NAN), "inside the focal length"),
    (lambda geo: geo.focus_at(0.03), "does not converge.*it needs more than 0.0[0-9]+ m"),
    (lambda geo: geo.focus_at(1.0, spot_grid=1), "1 rays of a pupil of 1 samples across do not converge"),
    (lambda geo: geo.focus_at(1.0, spot_grid=-1), "samples across a pupil grid must be .* got -1"),
    (lambda geo: DIVERGING.focus_at(1.0), "no distance helps, as the lens diverges"),
    (lambda geo: focus_rays(geo, [0.0], wavelengths_um=()), "no wavelength was given"),
    (lambda geo: focus_rays(geo, [0.0], grid=0), "samples across a pupil grid must be .* got 0"),
    (
        lambda geo: focus_rays(GeoLens([*WINDOW.surfaces, Surface(1e9, 1.0, CROWN, 5.0)], 4.0), [0.0]),
        "parallel",
    ),
    (
        lambda geo: holding_surface(GeoLens([Surface(PLANE, 3.0, None, 5.0)], 4.0)),
        "no surface changes the index",
    ),
    (lambda geo: hold_efl(AT_IMAGE, 50.0), "surface 2 cannot hold"),
    (lambda geo: hold_efl(WINDOW.replace_glass(1, CROWN), 50.0, surface=1), "index step 0"),
]
FIGURES = [
    (
        lambda geo: lens.rms_spot_mm(geo, [0.0, math.radians(85.0)]),
        "no ray arrives at field 85 degrees",
    ),
    (lambda geo: analysis.wavefront(geo, math.radians(80.0)), "no ray arrives at field 80 degrees"),
    (
        lambda geo: analysis.distortion_percent(geo, [0.1], "fisheye"),
        "mapping must be one of 'f-tan', 'f-theta', got 'fisheye'",
    ),
    (lambda geo: analysis.encircled_radius_mm(geo, 0.0, 1.2), "share of encircled energy must be .* got 1.2"),
    *(
        (lambda geo, blur=blur: analysis.depth_of_field(geo, blur), "give a positive diameter")
        for blur in (0.0, -1.0, NAN, INF)
    ),
    (lambda geo: analysis.depth_of_field(geo, [0.1, 0.2]), "limit of blur: .* is not one finite number"),
    (
        lambda geo: analysis.traced_depth_of_field(geo.focus_at(1.0), 0.005),
        r"above the .* of a disc of 0\.005 mm; allow",
    ),
    (
        lambda geo: analysis.depth_of_field(geo.replace(thickness_mm=geo.thickness_mm * 0.9), 0.02),
        r"no point before the lens has a blur of 0\.02 mm or less",
    ),
    (lambda geo: analysis.diffraction_mtf(geo, 0.0, [-1.0]), "must be at least 0 line pairs"),
    (
        lambda geo: analysis.through_focus_mtf(geo, 0.0, 10.0, [0.0], method="fast"),
        "method must be one of .* got 'fast'",
    ),
    (lambda geo: analysis.spectral_lines([]), "at least one positive wavelength"),
    (lambda geo: analysis.spectral_lines(Dark()), "with a positive sum"),
    (
        lambda geo: analysis.diffraction_psf(lens.load("double-gauss"), math.radians(14.0), grid=32),
        "cells differ by .* waves at field 14 degrees with a grid of 32",
    ),
    (
        lambda geo: analysis.diffraction_psf(geo, 0.0, padding=1),
        "padding must be a whole number >= 2, got 1",
    ),
    (lambda geo: analysis.psf_on_pixels(paraboloid(), 0.0, 0.01, 512, grid=64), "wider than the"),
    *(
        (
            lambda geo, make=make, bad=bad, name=name: make(geo, 0.0, **(PIXELS | {name: bad})),
            f"^{name} must be ",
        )
        for make in (analysis.psf_on_pixels, analysis.geometric_psf)
        for name in ("pixel_mm", "pixels")
        for bad in (-1, 0, NAN, INF, None, "fine")
    ),
]
PIXELS = {"pixel_mm": 0.004, "pixels": 8}


class Dark:
    wavelengths_um = (0.5,)
    weights = (0.0,)


LEAST = "at least 0"
DESIGN = [
    (lambda geo: rows([]), "no constraints"),
    (lambda geo: traced_semi_aperture_mm(geo, (1.2,)), "rim rays fail, so its apertures cannot be sized"),
    *(
        (
            lambda geo, bad=bad: design.fit_apertures(geo, (0.1,), margin=bad),
            "margin must be a finite number >= 0",
        )
        for bad in (-2.0, NAN, INF)
    ),
    (lambda geo: Limits(incidence_deg=50.0), "fields_rad"),
    (lambda geo: Limits(rays=True), "fields_rad"),
    (lambda geo: Limits(scale_mm=0.0), "positive"),
    (lambda geo: moved_element(geo, (2, 6)), "surfaces 2 to 6 are no element"),
    (lambda geo: moved_element(geo, (2, 3), tilt_rad=torch.zeros(3)), r"tilt_rad is \[2\]"),
    (lambda geo: moved_element(geo, (2, 3), 0.1), r"decentre_mm is \[2\]"),
    (lambda geo: moved_element(geo, (2, 3), tilt_rad=[INF, 0.0]), "NaN or infinity in 1 of 2 values"),
    *(
        (lambda geo, f=f: moved_element(geo, f), "must be two whole numbers")
        for f in ((0,), (0, 1.5), (0, 1, 2))
    ),
    (lambda geo: design.without_element(geo, 3), "there is no element 3; it has 0 to 2"),
    (lambda geo: design.without_element(geo, 0.5), "there is no element 0.5"),
    (lambda geo: design.without_element(lens.load("la1509"), 0), "its only one"),
    (lambda geo: design.without_element(MANGIN, 0), "touches a mirror"),
    # the last radius would have to hold the focal length against the flint that went
    (
        lambda geo: design.without_element(lens.load("double-gauss"), 2),
        r"the image lies 28\.6 mm before the last surface; flatten",
    ),
    (
        lambda geo: design.with_glass(geo, 1, "F2"),
        "no glass behind surface 1 to exchange; there is behind 0, 2, 4",
    ),
    (lambda geo: design.with_glass(geo, 0, "air"), "air is no glass; .*without_element"),
    (lambda geo: design.with_glass(geo, 0, None), "None is no glass"),
    (
        lambda geo: design.neighbour_glasses("N-BK77"),
        "'N-BK77' is not in the catalogue; the nearest names are",
    ),
    (lambda geo: design.neighbour_glasses(CROWN), "no dispersion"),
    (lambda geo: design.neighbour_glasses("F2", 0), "neighbours must be .* got 0"),
    (
        lambda geo: design.detune(
            design.make_design(geo, [0.0], 0.01), [0.0], 500.0, torch.Generator().manual_seed(0)
        ),
        "never reaches an RMS spot of 500",
    ),
    (lambda geo: geo.variables(), "name the numbers that become variables, of curvature, thickness"),
    (lambda geo: geo.variables("radius"), "variables 'radius'.*of curvature, thickness, focus"),
    (lambda geo: geo.variables("focus", "focus"), "name each once"),
    (lambda geo: geo.variables("focus", bounds={"conic": (0, 1)}), "bounds of 'conic'"),
    (lambda geo: geo.variables("focus", focus_at_m=2.0), "no focus moves a ray"),
    (lambda geo: geo.variables("asphere"), "no asphere moves a ray"),
    (lambda geo: geo.variables("curvature", mask={"curvature": [False] * 6}), "all are masked"),
    (lambda geo: geo.variables("curvature", mask={"curvature": [True]}), "needs 6 entries"),
    (lambda geo: geo.variables("focus", bounds={"focus": (50.0, 60.0)}), "not strictly inside"),
    (lambda geo: geo.variables("focus", bounds={"focus": (1.0, 2.0, 3.0)}), "are .low, high."),
    (lambda geo: geo.variables("focus", bounds={"focus": ([1.0, 2.0], 90.0)}), "a number or 1"),
    (lambda geo: geo.variables("focus", step_mm=0.0), "natural step, mm, must be a finite number > 0"),
    # no blur and a film of its own: nothing depends on it
    (lambda geo: ThinLens(5.0, 0.0, 5.0).variables("efl"), "no efl moves a ray"),
]


def curvatures(count):
    return [Error(f"curvature of surface {i + 1}", "curvature_per_mm", (i,), 0.5) for i in range(count)]


def linear(*slopes):
    return Forecast(3.0, torch.tensor(slopes, dtype=D), torch.zeros(len(slopes), len(slopes), dtype=D))


def trials(geo, count):
    return monte_carlo(geo, Tolerances(index=1e-4), lambda g: g.thickness_mm, count, torch.Generator())


TWO = linear(1.0, 1.0)
TOLERANCES = [
    (lambda geo: Tolerances(index=-1.0), "index must be .* got -1"),
    (lambda geo: Tolerances(), "nothing varies"),
    (lambda geo: trials(geo, 0), "trials must be a whole number >= 1"),
    (lambda geo: compare(torch.zeros(6, 3, dtype=D), trials(geo, 2)), "too few"),
    (lambda geo: perturbed(geo, curvatures(6), torch.zeros(5)), "6 errors"),
    (lambda geo: errors_of(MANGIN, Tolerances(element_tilt_deg=0.1)), "holds a mirror or is passed twice"),
    (lambda geo: cheapest(TWO, curvatures(2), -0.1), "budget must be a positive increase"),
    (lambda geo: cheapest(TWO, curvatures(2), 0.1, share=0.4), r"share lie between 0\.5 and 1"),
    (lambda geo: cheapest(TWO, curvatures(3), 0.1), "of 2 errors, but 3 were given"),
    (lambda geo: cheapest(TWO, curvatures(2), 9.0, most=0.001), r"even at 0\.001 times .* is not spent"),
    (lambda geo: cheapest(TWO, curvatures(2), True), "budget True"),
    (lambda geo: cheapest(linear(), [], 0.3), "no errors were given"),
    (lambda geo: cheapest(linear(0.0, 0.0), curvatures(2), 0.3), "the figure has no slope in any error"),
    (
        lambda geo: cheapest(linear(1.0, NAN), curvatures(2), 0.3),
        "forecast must be finite, got NaN or infinity in 1 of 2 values",
    ),
    (
        lambda geo: cheapest(linear(1.0, 0.0), curvatures(2), 0.2),
        "not grow with curvature of surface 2, so give",
    ),
]
PLATE = ZernikePlate({4: 0.0}, 4.0)
RIPPLE = torch.zeros(121, 121, dtype=D)
# small, but with detail between cells
RIPPLE[::2] = 0.1
LIGHT = [
    (lambda geo: plated(geo, GridPlate(RIPPLE, 0.07), grid=64), r"detail of 0.07 mm"),
    (lambda geo: diffraction.with_plate(geo, PLATE, 0, 1.0), "is not modelled; put it next to the stop"),
    (lambda geo: diffraction.with_plate(geo, PLATE, 7), "from surface 8 is not modelled"),
    (lambda geo: diffraction.with_plate(geo, PLATE, -1, -1.0), "is not modelled"),
    (lambda geo: diffraction.with_plate(geo, PLATE, z_mm=4.9), "meets a surface or the film"),
    (lambda geo: diffraction.with_plate(geo, PLATE, -1, 61.0), "and 42.21 mm there is room"),
    (
        lambda geo: diffraction.with_plate(geo, PLATE, z_mm=-0.5),
        "behind surface 3 is glass; .* side of surface 4",
    ),
    # the stop's own sag
    (lambda geo: diffraction.with_plate(geo, PLATE), r"between 0.6257 and 4.75 mm there is room"),
    (lambda geo: diffraction.with_plate(geo, PLATE, z_mm=1.0).scaled(0.5), "its phase plate is no surface"),
    (
        lambda geo: diffraction.with_plate(geo, PLATE, -1, NAN),
        "distance of a plate, mm, must be a finite number, got nan",
    ),
    (lambda geo: ZernikePlate({0: 1.0}, 4.0), "term must be a whole number >= 1, got 0"),
    (lambda geo: ZernikePlate({}, 4.0), "at least one Zernike term"),
    (
        lambda geo: ZernikePlate({4: 1.0, 5: INF}, 4.0),
        "plate coefficients must be finite, got .* in 1 of 2 values .* give finite radians",
    ),
    (lambda geo: ZernikePlate({4: 1.0}, 4.0, wavelength_um=0), "wavelength_um must be .* got 0"),
    (lambda geo: GridPlate(torch.zeros(3, 4), 1.0), r"\[N, N\] with N of at least 4, got \(3, 4\)"),
    (lambda geo: GridPlate(torch.full((4, 4), NAN), 1.0), "must be finite"),
]


def plated(geo, plate, grid):
    return analysis.psf_on_pixels(diffraction.with_plate(geo, plate, z_mm=1.0), 0.0, 0.004, 16, grid=grid)


FLAT = (np.array([0.4, 0.7]), np.array([1.0, 1.0]))
RISING, FALLING = ((np.array([0.4, 0.5, 0.7]), np.array(v)) for v in ([1.0, 0, 0], [0, 0, 1.0]))


def lit(wavelengths, values, count=3, response=FLAT):
    return Spectrum.from_curves(response, (np.array(wavelengths), np.array(values)), count)


SPECTRA = [
    (lambda geo: Spectrum((0.5,), (0.5, 0.5)), "one weight each"),
    (lambda geo: Spectrum((), ()), "1 to 1000 wavelengths"),
    (lambda geo: Spectrum((0.5,) * 1001, (1 / 1001,) * 1001), "1 to 1000 wavelengths"),
    (lambda geo: Spectrum((587.6,), (1.0,)), "give micrometres"),
    (lambda geo: Spectrum((NAN,), (1.0,)), "give micrometres"),
    (lambda geo: Spectrum((0.5, 0.6), (0.5, 0.6)), "sum to 1.1"),
    (lambda geo: Spectrum((0.5, 0.6), (1.5, -0.5)), LEAST),
    (lambda geo: Spectrum((0.5, 0.6), (0.5, NAN)), "sum to nan"),
    (lambda geo: Spectrum(("x",), (1.0,)), "sequences of numbers"),
    *((lambda geo, n=n: lit([0.4, 0.7], [1, 1], n), "whole number from 1 to 1000") for n in (0, 2.5, True)),
    (lambda geo: lit([0.8, 0.9], [1, 1]), "share no wavelengths"),
    (lambda geo: lit([400.0, 700.0], [1, 1]), "give micrometres"),
    (lambda geo: lit([0.7, 0.4], [1, 1]), "must increase"),
    (lambda geo: lit([0.4, NAN], [1, 1]), "must increase"),
    (lambda geo: lit([0.4, 0.7], [1, -1]), LEAST),
    (lambda geo: lit([0.4, 0.7], [1, INF]), "finite"),
    (lambda geo: lit([0.4, 0.7], [0, 0]), "not all 0"),
    (lambda geo: lit([0.4, 0.5, 0.7], [1, 1]), r"got \(3,\) and \(2,\)"),
    (lambda geo: lit([0.4], [1]), "2 <= N"),
    (lambda geo: Spectrum.from_curves(FLAT, 3.0, 3), "must be a pair"),
    (lambda geo: Spectrum.from_curves(FLAT, ("ab", "cd"), 3), "must be a pair"),
    (lambda geo: Spectrum.from_curves(RISING, FALLING, 3), "zero everywhere"),
    *((lambda geo, k=k: blackbody(k), "from 500 to 100000, got") for k in (0, -5, 1e9, NAN)),
    (lambda geo: silicon_response(0), "depth"),
    (lambda geo: Spectrum.line("q"), "known lines: i, h, g"),
    *((lambda geo, w=w: Spectrum.visible_FdC(w), "not all 0") for w in ((0, 0, 0), (1, NAN, 1), (INF, 1, 1))),
]


@pytest.fixture
def triplet():
    return lens.load("cooke-triplet")


@pytest.mark.parametrize(("call", "said"), LENS + DISTANCES + FIGURES + DESIGN + TOLERANCES + LIGHT + SPECTRA)
def test_what_cannot_be_gets_a_sentence(call, said, triplet):
    check(lambda: call(triplet), said)


def test_the_limit_that_a_sentence_names_is_the_limit(triplet):
    with pytest.raises(CodesignError) as raised:
        triplet.focus_at(0.03)
    limit = float(str(raised.value).split("more than ")[1].split(" m")[0])
    assert float(triplet.focus_at(limit + 1e-4).thickness_mm[-1].detach()) > 1e3
    check(lambda: triplet.focus_at(limit - 1e-4), "does not converge")


def test_what_variables_make_cannot_be_frozen_alone(triplet):
    triplet.variables("curvature")
    check(lambda: triplet.freeze("curvature_per_mm"), "made from variables")
    assert not triplet.freeze().first_order().efl_mm.requires_grad


def test_the_grid_that_a_sentence_asks_for_is_enough(triplet):
    geo = GeoLens(
        [Surface(PLANE, 4.0, None, 6.0, is_stop=True), *SINGLET[:1], Surface(-70.0, 60.0, None, 5.0)], 8.0
    )
    steep = diffraction.with_plate(geo, ZernikePlate({11: 60.0}, 4.0), z_mm=1.0)
    with pytest.raises(
        CodesignError, match=r"finer than 64 cells .* give a grid of at least (\d+)"
    ) as caught:
        analysis.pupil_function(steep, 0.0, grid=64)
    needed = int(str(caught.value).split("at least ")[1].split(",")[0])
    # a phase c Z11 steps by c sqrt(5) (24 - 12) / pi waves per radius at the rim; half a wave from cell to
    # cell
    assert needed == pytest.approx(60 * math.sqrt(5) * 12 / (2 * math.pi) * 2 * 2, rel=0.02)
