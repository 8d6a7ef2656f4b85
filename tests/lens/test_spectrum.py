"""Spectra against closed forms: strata of simple curves, Wien's and Planck's laws, the white point
of D65, absorption of silicon."""

import numpy as np
import pytest

from codesign.lens.spectrum import LINE_UM, Spectrum, daylight_d65, silicon_response
from tests.lens.systems import close

FLAT = (np.array([0.4, 0.7]), np.array([1.0, 1.0]))


def test_lines_are_where_they_are():
    assert Spectrum.line("d") == Spectrum((0.5875618,), (1.0,)) == Spectrum.monochromatic(0.5875618)
    visible = Spectrum.visible_FdC((1, 2, 1))
    assert visible.wavelengths_um == (0.4861327, 0.5875618, 0.6562725)
    assert visible.weights == (0.25, 0.5, 0.25)
    close(Spectrum.visible_FdC().weights, [1 / 3] * 3, atol=1e-16)
    assert list(LINE_UM.values()) == sorted(LINE_UM.values())


@pytest.mark.parametrize("count", [1, 2, 3, 7, 1000])
def test_a_flat_spectrum_gives_midpoints(count):
    spectrum = Spectrum.from_curves(FLAT, FLAT, count)
    assert spectrum.weights == (1 / count,) * count
    # a difference of moments near 0.2 over an energy of 0.3 / count keeps 1e-16 * count
    close(
        spectrum.wavelengths_um,
        0.4 + 0.3 * (np.arange(count) + 0.5) / count,
        atol=1e-15 * (10 + count),
    )


@pytest.mark.parametrize("split", [False, True])
@pytest.mark.parametrize("swapped", [False, True])
def test_a_ramp_gives_the_square_roots(swapped, split):
    # energy below w is (w - a)^2, so the strata end at a + width sqrt(k/N) and their means are 2/3
    # of cube over square differences
    ramp = (
        (np.array([0.4, 0.5, 0.7]), np.array([0.0, 1.0, 3.0]))
        if split
        else (np.array([0.4, 0.7]), np.array([0.0, 9.0]))
    )
    found = Spectrum.from_curves(*((FLAT, ramp) if swapped else (ramp, FLAT)), 5).wavelengths_um
    u = 0.3 * np.sqrt(np.arange(6) / 5)
    close(found, 0.4 + 2 / 3 * np.diff(u**3) / np.diff(u**2), atol=1e-14)


def test_the_product_of_two_ramps_is_integrated_exactly():
    up = (np.array([0.0, 1.0]) + 0.4, np.array([0.0, 1.0]))
    down = (np.array([0.0, 1.0]) + 0.4, np.array([1.0, 0.0]))
    # t (1 - t): mean 1/2; first half has mean 5/16 (integrals 1/12 and 5/192)
    close(Spectrum.from_curves(up, down, 1).wavelengths_um, (0.9,), atol=1e-14)
    close(
        Spectrum.from_curves(up, down, 2).wavelengths_um, (0.4 + 5 / 16, 0.4 + 11 / 16), atol=1e-14
    )


@pytest.mark.parametrize("count", [2, 5, 24])
def test_the_mean_wavelength_does_not_depend_on_the_number_of_strata(count):
    curves = silicon_response(), daylight_d65()
    spectrum = Spectrum.from_curves(*curves, count)
    one = Spectrum.from_curves(*curves, 1).wavelengths_um[0]
    close(np.dot(spectrum.weights, spectrum.wavelengths_um), one, atol=1e-13)
    # and it is the mean of a fine midpoint sum, whose error is of order h^2 = 1e-11
    w = 0.36 + 0.47 * (np.arange(200_000) + 0.5) / 200_000
    signal = np.interp(w, *curves[0]) * np.interp(w, *curves[1])
    close(one, (signal * w).sum() / signal.sum(), atol=1e-9)
    assert list(spectrum.wavelengths_um) == sorted(spectrum.wavelengths_um)


def test_strata_skip_a_gap():
    gap = (np.array([0.4, 0.45, 0.5, 0.6, 0.65, 0.7]), np.array([0.0, 1, 0, 0, 1, 0]))
    close(Spectrum.from_curves(gap, FLAT, 2).wavelengths_um, (0.45, 0.65), atol=1e-14)
    tiny = (gap[0], gap[1] * 1e-300)
    huge = (FLAT[0], FLAT[1] * 1e300)
    assert Spectrum.from_curves(tiny, huge, 2) == Spectrum.from_curves(gap, FLAT, 2)


def test_d65_is_white():
    def lobe(mean, below, above):
        return np.exp(-0.5 * ((nm - mean) / np.where(nm < mean, below, above)) ** 2)

    nm = np.arange(380.0, 781.0)
    # colour matching functions of 1931 as sums of lobes: Wyman, Sloan and Shirley, JCGT 2 (2013),
    # good to about 0.001 in x and y for white
    x = (
        1.056 * lobe(599.8, 37.9, 31.0)
        + 0.362 * lobe(442.0, 16.0, 26.7)
        - 0.065 * lobe(501.1, 20.4, 26.2)
    )
    y = 0.821 * lobe(568.8, 46.9, 40.5) + 0.286 * lobe(530.9, 16.3, 31.1)
    z = 1.217 * lobe(437.0, 11.8, 36.0) + 0.681 * lobe(459.0, 26.0, 13.8)
    X, Y, Z = (float((np.interp(nm / 1000, *daylight_d65()) * curve).sum()) for curve in (x, y, z))
    white = (X / (X + Y + Z), Y / (X + Y + Z))
    close(white, (0.31272, 0.32903), atol=1e-3)


@pytest.mark.parametrize(
    ("wavelength_um", "absorption_per_cm"),
    [(0.5, 1.11e4), (0.6, 4.18e3), (0.7, 1.89e3), (0.8, 8.5e2), (0.9, 3.03e2), (1.0, 6.4e1)],
)
def test_a_thin_layer_of_silicon_absorbs_by_its_coefficient(wavelength_um, absorption_per_cm):
    # so thin that response / w is proportional to the coefficient (0.5 % at 0.5 um); coefficients
    # as Green, 2008, tabulates them
    w, value = silicon_response(0.01)
    per_photon = (
        np.interp(wavelength_um, w, value) / wavelength_um / (np.interp(0.5, w, value) / 0.5)
    )
    close(per_photon, absorption_per_cm / 1.11e4, 0.015)


def test_a_thick_layer_counts_every_visible_photon():
    w, value = silicon_response(1000)
    visible = (w > 0.37) & (w < 0.9)
    assert value.max() == 1
    # 30 absorption lengths at 0.9 um: the response in A/W is proportional to w
    close(
        value[visible] / w[visible],
        np.full(visible.sum(), value[visible][0] / w[visible][0]),
        1e-12,
    )
