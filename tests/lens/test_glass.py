"""Refractive indices between the three lines, and glasses that cannot be."""

import json
import math

import pytest

from codesign import lens
from codesign.errors import DomainError
from codesign.lens import WAVELENGTH_UM, Glass
from codesign.lens.catalogue import LENSES
from codesign.lens.glass import CATALOGUE

# Schott's dispersion formula, n^2 - 1 = sum B w^2 / (w^2 - C), data sheet of N-BK7
BK7_B, BK7_C = (1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)


def sellmeier(B, C, wavelength_um):
    return math.sqrt(1 + sum(b * wavelength_um**2 / (wavelength_um**2 - c) for b, c in zip(B, C, strict=True)))


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_indices_are_exact_at_the_three_lines(name):
    glass = Glass.named(name)
    for line, value in (("F", glass.index_F), ("d", glass.index_d), ("C", glass.index_C)):
        assert glass.index(WAVELENGTH_UM[line]) == pytest.approx(value, abs=1e-15)


@pytest.mark.parametrize(("wavelength_um", "tolerance"), [(0.4861327, 1e-9), (0.5460740, 3e-6), (0.62, 3e-6), (0.4358343, 5e-5), (0.7065188, 5e-5)])
def test_between_and_beside_the_lines_the_index_follows_the_formula(wavelength_um, tolerance):
    # Conrady's three terms: 3e-6 between the lines and 5e-5 from 436 to 707 nm over the six glasses here (1/w^2 and 1/w^4: ten times worse)
    assert Glass.named("N-BK7").index(wavelength_um) == pytest.approx(sellmeier(BK7_B, BK7_C, wavelength_um), abs=tolerance)


@pytest.mark.parametrize("wavelength_um", [0.2, 1.5, 587.6, math.nan])
def test_wavelengths_outside_the_range_are_refused(wavelength_um):
    with pytest.raises(DomainError, match="give a wavelength in micrometres"):
        Glass.named("N-BK7").index(wavelength_um)


def test_glasses_that_cannot_be_are_refused():
    with pytest.raises(DomainError, match="known names: F2, F5, N-BK7"):
        Glass.named("BK7")
    for bad in (0.99, 5.0, math.nan, math.inf):
        with pytest.raises(DomainError, match=r"must lie in \[1, 5\)"):
            Glass.from_indices(1.5, bad, 1.5)


@pytest.mark.parametrize("name", LENSES)
def test_named_lenses_are_the_published_prescriptions(name, shared):
    page = json.loads(shared(f"refs/lens/{name.replace('-', '_')}.json").read_text())
    geo = lens.load(name)
    assert (geo.stop_index, geo.entrance_pupil_diameter_mm, lens.half_field_deg(name)) == (page["stop_index"], page["epd"], page["half_field_deg"])
    for mine, theirs in zip(geo.to_surfaces(), page["surfaces"], strict=True):
        assert mine.radius_mm == (math.inf if theirs["radius"] is None else theirs["radius"])
        assert (mine.thickness_mm, mine.semi_aperture_mm, mine.conic) == (theirs["thickness"], theirs["semi_aperture"], theirs["conic"])
        for line, wavelength_um in WAVELENGTH_UM.items():
            index = 1.0 if mine.medium is None else mine.medium.index(wavelength_um)
            assert index == pytest.approx(theirs["n"][line], abs=1e-12)
