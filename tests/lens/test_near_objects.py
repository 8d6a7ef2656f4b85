"""Figures of lenses for near objects, against an independent lens in long double: 50 random
systems."""

import dataclasses
import itertools
import math

import numpy as np
import torch

from codesign import lens
from codesign.lens import analysis
from codesign.lens.design import focus_rays
from codesign.lens.design.hits import surface_hits, traced_semi_aperture_mm
from codesign.lens.seidel import seidel_sums
from tests.lens import long_double_lens as ld
from tests.lens.long_double_lens import FIELDS, L

FIELD = FIELDS[1]
LINES = ("d", "F", "C")
LIGHT_UM = [lens.WAVELENGTH_UM[k] for k in LINES]
WAVELENGTH_MM = L(LIGHT_UM[0]) / 1000
GRID = 8  # cells across the pupil
CELLS = 24  # of the pupil that is summed to a point spread and an MTF
CENTRE = np.zeros((1, 2))
# largest relative error; float64 paths of some 100 mm leave 1e-10 of a wavefront
ALLOWED = {
    "spot positions": 1e-14,
    "spots": 1e-12,
    "encircled radius": 1e-12,
    "fans": 1e-12,
    "fan paths": 1e-9,
    "apertures": 1e-14,
    "incidence": 1e-13,
    "Seidel sums": 1e-14,
    "distortion": 2e-11,
    "field curvature": 1e-9,
    "lateral colour": 1e-10,
    "axial colour": 1e-12,
    "wavefront": 1e-9,
    "point spread": 1e-9,
    "MTF": 1e-9,
    "paraxial focus": 1e-14,
    "ray focus": 1e-14,
    "depth of field": 1e-12,
}


@torch.no_grad()
def test_every_figure_of_fifty_random_lenses_against_a_long_double_lens():
    worst = dict.fromkeys(ALLOWED, 0.0)
    for seed in range(50):
        system, at_m = ld.draw(seed)
        for figures in (rays, paraxial, waves, focus):
            for name, value in figures(system, at_m).items():
                worst[name] = max(worst[name], math.inf if math.isnan(value) else value)
    assert {name: value for name, value in worst.items() if value > ALLOWED[name]} == {}
    assert min(worst.values()) > 0


def geolens(system):
    """The GeoLens of a System, to the last bit of its numbers."""
    surfaces = []
    for i, thickness in enumerate(system.thickness):
        n = {k: float(system.index[k][i + 1]) for k in LINES}
        glass = None if n["d"] == 1 else lens.Glass.from_indices(**n)
        stop = i == system.stop
        surfaces.append(
            lens.Surface(math.inf, float(thickness), glass, 1e3, asphere=(0.0,) * 4, is_stop=stop)
        )
    numbers = {
        "curvature_per_mm": system.curvature,
        "conic": system.conic,
        "asphere": system.asphere,
    }
    tensors = {name: torch.from_numpy(value.astype(float)) for name, value in numbers.items()}
    return lens.GeoLens(surfaces, float(system.diameter)).replace(**tensors).requires_grad_(False)


def error(found, truth, size=None):
    """Largest difference, relative to the largest true value (or to ``size``)."""
    truth = np.asarray(truth, dtype=L)
    size = np.abs(truth).max() if size is None else size
    return float(np.abs(np.asarray(found.numpy(), dtype=L) - truth).max() / size)


def rays(system, at_m):
    """Spots, encircled radius, fans, apertures."""
    geo = geolens(system)
    at = 1e3 * L(at_m)
    pupil = analysis.pupil_grid(GRID).numpy()
    spots = np.stack([ld.field_rays(system, "d", f, pupil, at).position for f in FIELDS])
    away = spots - spots.mean(1, keepdims=True)
    sizes = np.sqrt((away**2).sum(2).mean(1))
    ordered = np.sort(np.hypot(*away[1].T))
    share = (int(0.8 * len(ordered)) + 0.5) / len(ordered)  # between two rays
    line = np.linspace(-1, 1, 9)
    chief = ld.field_rays(system, "d", FIELD, CENTRE, at)
    tangential, sagittal = (
        ld.field_rays(system, "d", FIELD, np.outer(line, axis), at) for axis in ((0, 1), (1, 0))
    )
    fan = analysis.ray_fan(geo, FIELD, count=9, at_m=at_m)
    paths = [
        ld.path_differences(system, "d", f, chief)[0] / WAVELENGTH_MM
        for f in (tangential, sagittal)
    ]
    turn = np.arange(16) * (2 * np.pi / 16) + np.pi / 2
    rim = np.concatenate([CENTRE, np.stack([np.cos(turn), np.sin(turn)], 1)])
    heights = np.max([ld.field_rays(system, "d", f, rim, at).heights.max(1) for f in FIELDS], 0)
    bends = np.diff(system.index["d"])[:, None] != 0
    incidence = np.where(bends, ld.field_rays(system, "d", FIELD, pupil, at).cosines, 1)
    hits = surface_hits(geo, *analysis.field_rays(geo, FIELD, analysis.pupil_grid(GRID), at_m=at_m))
    return {
        "spot positions": error(lens.spots(geo, FIELDS, grid=GRID, at_m=at_m)[0], spots),
        "spots": error(
            lens.rms_spot_mm(geo, FIELDS, grid=GRID, at_m=at_m) / torch.tensor(sizes.astype(float)),
            1,
        ),
        "encircled radius": error(
            analysis.encircled_radius_mm(geo, FIELD, share, LIGHT_UM[0], GRID, at_m=at_m),
            ordered[int(0.8 * len(ordered))],
        ),
        "fans": max(
            error(fan.tangential_mm, (tangential.position - chief.position)[:, 1]),
            error(fan.sagittal_mm, (sagittal.position - chief.position)[:, 0]),
        ),
        "fan paths": max(
            error(fan.tangential_waves, paths[0]), error(fan.sagittal_waves, paths[1])
        ),
        "incidence": error(hits.cosine, incidence),
        "apertures": error(traced_semi_aperture_mm(geo, FIELDS, 0.0, at_m=at_m), heights),
    }


def paraxial(system, at_m):
    """Seidel sums, distortion, field curvature, colour."""
    geo = geolens(system)
    at = 1e3 * L(at_m)
    sums = seidel_sums(geo, FIELD, at_m=at_m).per_surface.T
    chief = {
        k: np.array([ld.field_rays(system, k, f, CENTRE, at).position[0, 1] for f in FIELDS])
        for k in LINES
    }
    y, nu = ld.paraxial(system, "d", -ld.entrance_pupil(system), 1)
    ideal = (y[-1] + system.thickness[-1] * nu[-1] / system.index["d"][-1]) * np.tan(L(FIELDS))
    shifts = np.stack([ld.focus_shifts(system, f, at) for f in FIELDS])
    film = {k: ld.crossing(system, k, at) for k in LINES}
    return {
        "Seidel sums": max(
            error(m, t) for m, t in zip(sums, ld.seidel(system, FIELD, at), strict=True)
        ),
        "distortion": error(
            analysis.distortion_percent(geo, FIELDS[1:], at_m=at_m),
            100 * (chief["d"][1:] / ideal[1:] - 1),
        ),
        "field curvature": error(analysis.focus_shift_mm(geo, FIELDS, at_m=at_m), shifts),
        "lateral colour": error(
            analysis.lateral_colour_mm(geo, FIELDS, LIGHT_UM[1:], at_m=at_m),
            np.stack([chief[k] - chief["d"] for k in "FC"], 1),
        ),
        "axial colour": error(
            analysis.chromatic_focus_shift_mm(geo, LIGHT_UM[1:], at_m=at_m),
            [film[k] - film["d"] for k in "FC"],
        ),
    }


def waves(system, at_m):
    """Wavefront, point spread and MTF, of the lens stopped down until the cells resolve its
    wavefront."""
    at = 1e3 * L(at_m)
    line = (np.arange(CELLS) + 0.5) / CELLS * 2 - 1
    x, y = np.meshgrid(line, line)
    seen = x * x + y * y <= 1
    points = np.stack([x[seen], y[seen]], 1)
    steepest = math.inf
    while steepest > 0.2:  # waves between cells
        system = dataclasses.replace(system, diameter=float(system.diameter * 0.7))
        light, chief = (ld.field_rays(system, "d", FIELD, p, at) for p in (points, CENTRE))
        paths, slope = ld.path_differences(system, "d", light, chief)
        waves = np.where(seen, L(0), np.nan)
        waves[seen] = paths / WAVELENGTH_MM
        steepest = max(np.nanmax(np.abs(np.diff(waves, axis=k))) for k in (0, 1))
    geo = geolens(system)
    field = np.where(seen, np.exp(-2j * np.arctan2(L(0), L(-1)) * np.where(seen, waves, 0)), 0)
    energy = (np.abs(field) ** 2).sum()
    # of the pupil in direction cosines
    radius = (points * (slope - slope.mean(0))).sum(0) / (points**2).sum(0)
    pixel = float(0.25 * WAVELENGTH_MM / np.abs(radius).max())
    place = (np.arange(12) - 6) * L(pixel)
    wave_x, wave_y = (
        np.exp(2j * np.arctan2(L(0), L(-1)) * r / WAVELENGTH_MM * np.outer(place, line))
        for r in radius
    )
    spread = np.abs(wave_y @ field @ wave_x.T) ** 2 / energy * pixel**2 / WAVELENGTH_MM**2
    spread = spread * (2 / L(CELLS)) ** 2 * np.abs(radius).prod()
    # a shift by whole cells of the pupil is a frequency; the MTF is the overlap of the field with
    # itself
    mtf = [
        [np.abs((f[k:] * f[:-k].conj()).sum()) / energy for k in (3, 9)] for f in (field, field.T)
    ]
    return {
        "wavefront": error(analysis.wavefront(geo, FIELD, grid=CELLS, at_m=at_m).opd_mm, paths),
        "point spread": error(
            analysis.psf_on_pixels(geo, FIELD, pixel, 12, grid=CELLS, at_m=at_m).energy, spread
        ),
        "MTF": max(
            error(
                analysis.diffraction_mtf(
                    geo,
                    FIELD,
                    np.array([3, 9]) * float(2 / CELLS * np.abs(r) / WAVELENGTH_MM),
                    grid=CELLS,
                    at_m=at_m,
                )[k],
                mtf[k],
                1,
            )
            for k, r in enumerate(radius[::-1])
        ),
    }


def focus(system, at_m):
    """Focus solves, depth of field."""
    geo = geolens(system)
    at = 1e3 * L(at_m)
    pupil = analysis.pupil_grid(GRID).numpy()
    product = square = L(0)
    for d, f in itertools.product((1, 2), FIELDS):
        colours = [ld.field_rays(system, line, f, pupil, d * at) for line in LINES]
        position, slopes = (
            np.concatenate([getattr(rays, name) for rays in colours])
            for name in ("position", "slopes")
        )
        slopes = slopes - slopes.mean(0)
        product = product + (position * slopes).sum()
        square = square + (slopes**2).sum()
    film = ld.crossing(system, "d", at)
    found = analysis.depth_of_field(geo.focus_at(at_m), 0.02)

    def blur(distance_m):
        """Diameter on the film of the paraxial light of a point."""
        slope = system.diameter / 2 / (1e3 * L(float(distance_m)))
        y, nu = ld.paraxial(
            system, "d", system.diameter / 2 - slope * ld.entrance_pupil(system), slope
        )
        return 2 * abs(y[-1] + film * nu[-1] / system.index["d"][-1])

    shared = focus_rays(geo, FIELDS, LIGHT_UM, GRID, at_m=(at_m, 2 * at_m)).thickness_mm[-1]
    limits = [found.near_m] + [found.far_m] * bool(found.far_m.isfinite())
    return {
        "paraxial focus": error(geo.focus_at(at_m).thickness_mm[-1], film),
        "ray focus": error(shared, system.thickness[-1] - product / square),
        "depth of field": max(float(abs(blur(d) / 0.02 - 1)) for d in limits),
    }
