"""Wavelengths and their shares of the signal: spectral lines, and what a sensor sees of an
illuminant."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from codesign.checks import check_number, check_whole
from codesign.errors import DomainError, ShapeError

Curve = tuple[NDArray[np.float64], NDArray[np.float64]]  # wavelengths in um, values

# Fraunhofer's letters, wavelengths in air. Source: ISO 7944 and Schott TIE-29
LINE_UM = {
    "i": 0.365014,
    "h": 0.4046561,
    "g": 0.4358343,
    "F'": 0.4799914,
    "F": 0.4861327,
    "e": 0.5460740,
    "d": 0.5875618,
    "D": 0.5892938,
    "C'": 0.6438469,
    "C": 0.6562725,
    "r": 0.7065188,
    "s": 0.85211,
    "t": 1.01398,
}
MOST_WAVELENGTHS = 1000
ROUNDING = 4 * np.finfo(float).eps  # to which the ends of strata are found

# CIE standard illuminant D65, 300 to 830 nm in steps of 10 nm, linear between them by definition.
# Source: CIE S 014-2 / ISO 11664-2
_D65 = """
0.0341 3.2945 20.236 37.0535 39.9488 44.9117 46.6383 52.0891 49.9755 54.6482 82.7549 91.486 93.4318
86.6823 104.865 117.008 117.812 114.861 115.923 108.811 109.354 107.802 104.79 107.689 104.405
104.046 100.0 96.3342 95.788 88.6856 90.0062 89.5991 87.6987 83.2886 83.6992 80.0268 80.2146 82.2778
78.2842 69.7213 71.6091 74.349 61.604 69.8856 75.087 63.5927 46.4182 66.8054 63.3828 64.304 59.4519
51.959 57.4406 60.3125
"""
# extinction coefficient of silicon at 300 K, 360 to 1100 nm in steps of 20 nm. Source: Green, Sol.
# Energ. Mat. Sol. Cells 92, 1305 (2008)
_SILICON_K = """
2.966 0.946 0.296 0.176 0.107 0.071381 0.055004 0.044165 0.036415 0.030295 0.025758 0.022524
0.019934 0.017367 0.015432 0.013498 0.011905 0.010528 0.0096257 0.008362 0.007197 0.0063933
0.0054113 0.0046134 0.0039439 0.0032781 0.0026821 0.0021701 0.0017571 0.0013689 0.0010237 0.00074866
0.0005093 0.00032386 0.00018704 9.3631e-05 5.3285e-05 3.0637e-05
"""


@dataclass(frozen=True)
class Spectrum:
    """Wavelengths (um) and weights (shares of the signal, at least 0, sum 1); both become tuples of
    floats.

    Raises: ShapeError when the two differ in number; DomainError for what cannot be.

    Example:
    >>> from codesign import lens
    >>> light = lens.Spectrum.visible_FdC((1.0, 2.0, 1.0))
    >>> light.weights
    (0.25, 0.5, 0.25)
    >>> positions, weights = lens.analysis.polychromatic_spot(lens.load("cooke-triplet"), 0.1, light)
    """

    wavelengths_um: tuple[float, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        wavelengths = _floats(self.wavelengths_um)
        weights = _floats(self.weights)
        if len(wavelengths) != len(weights) or not 0 < len(wavelengths) <= MOST_WAVELENGTHS:
            raise ShapeError(
                f"a spectrum has 1 to {MOST_WAVELENGTHS} wavelengths and one weight each; "
                f"{len(wavelengths)} wavelengths and {len(weights)} weights were given."
            )
        for wavelength_um in wavelengths:
            check_number(wavelength_um, "wavelength_um", 0.1, 100, remedy="give micrometres")
        if not (min(weights) >= 0 and abs(math.fsum(weights) - 1) <= 1e-9):
            raise DomainError(
                "weights of a spectrum must be at least 0 and sum to 1; they sum to "
                f"{math.fsum(weights):.6g}. Spectrum.weighted divides by their sum."
            )
        object.__setattr__(self, "wavelengths_um", wavelengths)
        object.__setattr__(self, "weights", weights)

    @staticmethod
    def weighted(wavelengths_um: Iterable[float], weights: Iterable[float]) -> "Spectrum":
        """Spectrum from weights of any positive sum, for example those of a lens file."""
        weights = _floats(weights)
        total = math.fsum(weights) if all(map(math.isfinite, weights)) else math.nan
        if not 0 < total < math.inf:
            raise DomainError(
                f"weights of a spectrum must be finite, at least 0 and not all 0; their sum is {total:g}."
            )
        return Spectrum(_floats(wavelengths_um), tuple(w / total for w in weights))

    @staticmethod
    def monochromatic(wavelength_um: float) -> "Spectrum":
        """One wavelength with all the weight."""
        return Spectrum((wavelength_um,), (1.0,))

    @staticmethod
    def line(letter: str) -> "Spectrum":
        """One spectral line by its letter (``LINE_UM``)."""
        if letter not in LINE_UM:
            raise DomainError(
                f"spectral line {str(letter)[:20]!r} is not known; known lines: {', '.join(LINE_UM)}."
            )
        return Spectrum.monochromatic(LINE_UM[letter])

    @staticmethod
    def visible_FdC(weights: Iterable[float] = (1.0, 1.0, 1.0)) -> "Spectrum":
        """The F, d and C lines, the classical visible spectrum of lens design, equally weighted
        unless ``weights`` says otherwise."""
        return Spectrum.weighted(tuple(LINE_UM[letter] for letter in "FdC"), weights)

    @staticmethod
    def from_curves(
        response: tuple[ArrayLike, ArrayLike], illuminant: tuple[ArrayLike, ArrayLike], count: int
    ) -> "Spectrum":
        """``count`` wavelengths of equal weight for what a sensor sees of an illuminant.

        The product of the curves (linear between their points, over the range they share) is cut
        into ``count`` strata of equal signal; each is represented by its signal-weighted mean
        wavelength, so the mean wavelength of the whole is exact. Args:
          response, illuminant: pairs (wavelength_um [N], value [N]), increasing wavelengths, values
            >= 0 of any scale; the response per unit of radiant energy (A/W) when the illuminant is
            in energy.
          count: 1 to 1000.
        Raises: ShapeError, DomainError.
        """
        # they take a second to import, which who traces in given lines need not wait for
        from scipy.interpolate import PPoly
        from scipy.optimize import brentq

        count = check_whole(count, "count", 1, MOST_WAVELENGTHS)
        (w1, v1), (w2, v2) = _curve(response, "response"), _curve(illuminant, "illuminant")
        first = max(w1[0], w2[0])
        last = min(w1[-1], w2[-1])
        if not first < last:
            raise DomainError(
                f"response ({w1[0]:g} to {w1[-1]:g} um) and illuminant ({w2[0]:g} to {w2[-1]:g} um) share "
                "no wavelengths."
            )
        knots = np.union1d(w1, w2)
        knots = knots[(knots >= first) & (knots <= last)]
        # values are scaled so that tiny or huge units neither vanish nor overflow in the product
        (a, da), (b, db) = (_pieces(knots, w, v / v.max()) for w, v in ((w1, v1), (w2, v2)))
        signal = np.stack([da * db, a * db + da * b, a * b])
        none = np.zeros_like(signal[:1])
        energy = PPoly(signal, knots).antiderivative()
        moment = PPoly(
            np.concatenate([signal, none]) + knots[:-1] * np.concatenate([none, signal]), knots
        ).antiderivative()
        whole = float(energy(last))
        if not whole > 0:
            raise DomainError(
                f"response times illuminant is zero everywhere from {first:g} to {last:g} um; give curves "
                "that overlap."
            )
        inner = [
            brentq(
                lambda w, k=k: energy(w) - whole * k / count,
                first,
                last,
                xtol=1e-300,
                rtol=ROUNDING,
            )
            for k in range(1, count)
        ]
        bounds = np.array([first, *inner, last])
        means = np.diff(moment(bounds)) / np.diff(energy(bounds))
        return Spectrum(tuple(means.tolist()), (1.0 / count,) * count)


def _pieces(knots, wavelength_um, value):
    """Value at the start of each segment between the knots, and its slope there."""
    at = np.interp(knots, wavelength_um, value)
    return at[:-1], np.diff(at) / np.diff(knots)


def _floats(values):
    try:
        return tuple(map(float, values))
    except (TypeError, ValueError, OverflowError) as error:
        raise ShapeError(
            f"wavelengths and weights of a spectrum must be sequences of numbers ({str(error)[:80]})."
        ) from error


def _curve(curve, name):
    try:
        wavelength_um, value = (np.asarray(x, dtype=np.float64) for x in curve)
    except (TypeError, ValueError, OverflowError) as error:
        raise ShapeError(
            f"{name} must be a pair (wavelength_um [N], value [N]) of numbers ({str(error)[:80]})."
        ) from error
    if (
        wavelength_um.ndim != 1
        or wavelength_um.shape != value.shape
        or not 2 <= len(value) <= 10_000
    ):
        raise ShapeError(
            f"{name} must be a pair (wavelength_um [N], value [N]) with 2 <= N <= 10000, got "
            f"{wavelength_um.shape} and {value.shape}."
        )
    increase = (np.diff(wavelength_um) > 0).all()
    if not (increase and wavelength_um[0] >= 0.1 and wavelength_um[-1] <= 100):
        raise DomainError(
            f"{name}: wavelengths must increase and lie in 0.1 to 100; give micrometres."
        )
    if not (value >= 0).all() or not 0 < value.max() < math.inf:
        raise DomainError(f"{name}: values must be finite, at least 0 and not all 0.")
    return wavelength_um, value


def daylight_d65() -> Curve:
    """CIE standard illuminant D65 (radiant energy, 100 at 560 nm), 0.30 to 0.83 um: (wavelength_um,
    value)."""
    values = np.array(_D65.split(), dtype=float)
    return np.linspace(0.30, 0.83, len(values)), values


def silicon_response(depth_um: float = 5.0) -> Curve:
    """Response of a generic monochrome silicon sensor per unit of radiant energy, 0.36 to 1.10 um,
    largest value 1: (wavelength_um, value).

    An approximation: every photon absorbed within ``depth_um`` counts, w (1 -
    exp(-4 pi k depth / w)); reflection, the cover glass and losses at the surface are left out, so
    a real sensor falls faster in the blue. Five micrometres is a usual epitaxial layer.
    Args: depth_um from 0.01 to 1000.
    Raises: DomainError.
    Source: Beer and Lambert's law with the extinction coefficient of Green, 2008.
    """
    check_number(depth_um, "depth_um", 0.01, 1000, remedy="sensors have about 2 to 10 um")
    extinction = np.array(_SILICON_K.split(), dtype=float)
    wavelength_um = np.linspace(0.36, 1.10, len(extinction))
    value = -wavelength_um * np.expm1(-4 * np.pi * extinction * depth_um / wavelength_um)
    return wavelength_um, value / value.max()
