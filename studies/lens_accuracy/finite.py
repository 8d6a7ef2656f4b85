"""Every figure of a lens for a near object against the long-double lens: relative errors by figure."""

import dataclasses
import math

import numpy as np
import torch

from codesign import lens
from codesign.lens import analysis
from codesign.lens.design import focus_rays
from codesign.lens.design.hits import traced_semi_aperture_mm
from codesign.lens.seidel import seidel_sums
from studies.lens_accuracy import longdouble as ld
from studies.lens_accuracy.draw import FIELDS

L = np.longdouble
D = torch.float64
FIELD = FIELDS[1]
LINES = "dFC"
GRID = 8  # cells across the pupil
CELLS = 24  # of the pupil that is summed to a point spread and an MTF
STEEPEST = 0.2  # waves between those cells
BLUR_MM = 0.02
FREQUENCY_SHARES = (0.1, 0.35, 0.7)  # of the cut-off


def geolens(system):
    """The GeoLens of a System, to the last bit of its numbers."""
    count = len(system.curvature)
    media = [
        None
        if system.index["d"][i + 1] == 1
        else lens.Glass.from_indices(**{k: float(system.index[k][i + 1]) for k in LINES})
        for i in range(count)
    ]
    surfaces = [
        lens.Surface(math.inf, float(t), medium, 1e3, asphere=(0.0,) * 4, is_stop=i == system.stop)
        for i, (t, medium) in enumerate(zip(system.thickness, media, strict=True))
    ]
    flat = lens.GeoLens(surfaces, float(system.diameter), name="drawn")
    numbers = {"curvature_per_mm": system.curvature, "conic": system.conic, "asphere": system.asphere}
    return flat.replace(**{k: torch.from_numpy(v.astype(float)) for k, v in numbers.items()}).requires_grad_(
        False
    )


def error(found, truth, size=None):
    """Largest difference, relative to the largest true value (or to ``size``)."""
    truth = np.asarray(truth, dtype=L)
    size = np.abs(truth).max() if size is None else size
    return float(np.abs(np.asarray(found.detach().numpy(), dtype=L) - truth).max() / size)


@torch.no_grad()
def compare(system, at_m):
    """Relative error by figure of the GeoLens of a System with its object ``at_m`` away."""
    geo = geolens(system)
    at = L(1e3) * L(at_m)
    return {
        **_rays(system, geo, at, at_m),
        **_thin_rays(system, geo, at, at_m),
        **_waves(system, at_m),
        **_solves(system, geo, at, at_m),
    }


def _pupil(grid):
    return analysis.pupil_grid(grid).numpy()


def _rays(system, geo, at, at_m):
    """Spots, fans, encircled radius, through focus, apertures."""
    pupil = _pupil(GRID)
    true = {
        (line, field): ld.field_rays(system, line, field, pupil, at) for line in LINES for field in FIELDS
    }
    sizes = np.array([[ld.rms(true[line, field].position) for field in FIELDS] for line in LINES])
    mine = torch.stack([lens.rms_spot_mm(geo, FIELDS, lens.WAVELENGTH_UM[k], GRID, at_m) for k in LINES])
    position, _ = lens.spots(geo, FIELDS, grid=GRID, at_m=at_m)
    light = [lens.WAVELENGTH_UM[k] for k in LINES]
    mixed, weight = analysis.polychromatic_spot(geo, FIELD, light, GRID, at_m=at_m)
    together = np.concatenate([true[k, FIELD].position for k in LINES])
    away = np.sort(np.sqrt(((together - together.mean(0)) ** 2).sum(1)))
    share = 0.8 + 0.5 / len(away) - (0.8 * len(away) % 1) / len(away)  # between two rays
    planes = (-0.05, 0.08)
    moved = [[ld.rms(true["d", f].position + L(z) * _slopes(true["d", f])) for z in planes] for f in FIELDS]
    line = np.linspace(-1, 1, 9)
    fans = {}
    for axis in (0, 1):
        points = np.zeros((9, 2))
        points[:, 1 - axis] = line
        fans[axis] = ld.field_rays(system, "d", FIELD, points, at)
    chief = ld.field_rays(system, "d", FIELD, np.zeros((1, 2)), at)
    fan = analysis.ray_fan(geo, FIELD, count=9, at_m=at_m)
    paths = [ld.path_differences(system, "d", fans[axis], chief)[0] for axis in (0, 1)]
    turn = np.arange(16) * (2 * np.pi / 16) + np.pi / 2
    rim = np.concatenate([[[0.0, 0.0]], np.stack([np.cos(turn), np.sin(turn)], 1)])
    heights = np.max([ld.field_rays(system, "d", f, rim, at).heights.max(1) for f in FIELDS], 0)
    return {
        "spot_positions": error(position, np.stack([true["d", f].position for f in FIELDS])),
        "spots": float((abs(mine.numpy() - sizes) / sizes).max()),
        "polychromatic_spot": error(analysis.spot_radius_mm(mixed, weight), ld.rms(together)),
        "encircled_radius": error(
            analysis.encircled_radius_mm(geo, FIELD, float(share), light, GRID, at_m=at_m),
            away[np.searchsorted(np.arange(1, len(away) + 1) / len(away), share - 1e-12)],
        ),
        "through_focus": error(
            analysis.through_focus_spot_mm(geo, FIELDS, planes, grid=GRID, at_m=at_m), moved
        ),
        "fans": max(
            error(fan.tangential_mm, (fans[0].position - chief.position)[:, 1]),
            error(fan.sagittal_mm, (fans[1].position - chief.position)[:, 0]),
        ),
        "fan_paths": max(
            error(values, path / L(0.5875618e-3))
            for values, path in zip((fan.tangential_waves, fan.sagittal_waves), paths, strict=True)
        ),
        "apertures": error(traced_semi_aperture_mm(geo, FIELDS, 0.0, at_m=at_m), heights),
        "geometric_mtf": _geometric_mtf(geo, together, light, at_m),
    }


def _slopes(rays):
    return rays.direction[:, :2] / rays.direction[:, 2:]


def _geometric_mtf(geo, points, light, at_m):
    frequency = np.array([5.0, 20.0])
    away = points - points.mean(0)
    true = [
        np.abs(np.exp(-2j * ld.PI * frequency[:, None].astype(L) * away[:, axis]).mean(1)) for axis in (1, 0)
    ]
    return error(analysis.geometric_mtf(geo, FIELD, frequency, light, GRID, at_m=at_m), true, 1)


def _thin_rays(system, geo, at, at_m):
    """Seidel sums, distortion, field curvature, colour."""
    truth = ld.seidel(system, FIELD, at)
    sums = seidel_sums(geo, FIELD, at_m=at_m)
    mine = torch.cat([sums.per_surface, sums.axial_colour[:, None], sums.lateral_colour[:, None]], 1).T
    heights = {
        k: np.array([ld.field_rays(system, k, f, np.zeros((1, 2)), at).position[0, 1] for f in FIELDS])
        for k in LINES
    }
    ideal = ld.image_scale(system, at) * np.tan(np.array(FIELDS, dtype=L))
    places = [ld.image_place(system, at, k) - ld.image_place(system, at) for k in "FC"]
    shifts = np.stack([ld.focus_shifts(system, "d", f, at) for f in FIELDS])
    lines = [lens.WAVELENGTH_UM[k] for k in "FC"]
    return {
        "seidel_sums": max(error(m, t) for m, t in zip(mine, truth, strict=True)),
        "distortion": error(
            analysis.distortion_percent(geo, FIELDS[1:], at_m=at_m), 100 * (heights["d"][1:] / ideal[1:] - 1)
        ),
        "field_curvature": error(analysis.focus_shift_mm(geo, FIELDS, at_m=at_m), shifts),
        "lateral_colour": error(
            analysis.lateral_colour_mm(geo, FIELDS, lines, at_m=at_m),
            np.stack([heights[k] - heights["d"] for k in "FC"], 1),
        ),
        "axial_colour": error(analysis.chromatic_focus_shift_mm(geo, lines, at_m=at_m), places),
    }


def _waves(system, at_m):
    """Wavefront, point spread and MTF, of the lens stopped down so far that the cells resolve its wavefront."""
    at = L(1e3) * L(at_m)
    line = (np.arange(CELLS) + 0.5) / CELLS * 2 - 1
    x, y = np.meshgrid(line, line)
    seen = x * x + y * y <= 1
    points = np.stack([x[seen], y[seen]], 1)
    wavelength = L(0.5875618e-3)
    while True:
        rays = ld.field_rays(system, "d", FIELD, points, at)
        chief = ld.field_rays(system, "d", FIELD, np.zeros((1, 2)), at)
        paths, slope = ld.path_differences(system, "d", rays, chief)
        waves = np.zeros_like(x, dtype=L)
        waves[seen] = paths / wavelength
        steps = [np.abs(np.diff(waves, axis=k)) * (np.diff(seen, axis=k) == 0) for k in (0, 1)]
        if max(s.max() for s in steps) < STEEPEST:
            break
        system = dataclasses.replace(system, diameter=system.diameter * 0.7)
    geo = geolens(dataclasses.replace(system, diameter=float(system.diameter)))
    system = dataclasses.replace(system, diameter=float(system.diameter))
    field = np.where(seen, np.exp(-2j * ld.PI * waves), 0)
    radius = (points * (slope - slope.mean(0))).sum(0) / (points**2).sum(0)
    pixels, pixel = 12, float(0.25 * wavelength / np.abs(radius).max())
    place = (np.arange(pixels) - pixels // 2) * L(pixel)
    # a plane wave of direction cosines radius * pupil per cell
    sign = np.sign(radius)
    wave_x, wave_y = (
        np.exp(2j * ld.PI / wavelength * np.abs(r) * place[:, None] * (s * line)[None])
        for r, s in zip(radius, sign, strict=True)
    )
    amplitude = wave_y @ field @ wave_x.T
    cell = (L(2) / CELLS) ** 2 * np.abs(radius).prod()
    spread = np.abs(amplitude) ** 2 * cell * L(pixel) ** 2 / wavelength**2 / (np.abs(field) ** 2).sum()
    mine = analysis.psf_on_pixels(geo, FIELD, pixel, pixels, grid=CELLS, at_m=at_m)
    frequency = np.array(FREQUENCY_SHARES) * float(2 * np.abs(radius).min() / wavelength)
    mtf = analysis.diffraction_mtf(geo, FIELD, frequency, grid=CELLS, at_m=at_m)
    front = analysis.wavefront(geo, FIELD, grid=CELLS, at_m=at_m)
    return {
        "wavefront": error(front.opd_mm, paths),
        "psf": error(mine.energy, spread),
        "mtf": error(mtf, [_transfer(field, k, radius[1 - k] / wavelength, frequency) for k in (0, 1)], 1),
    }


def _transfer(field, axis, radius, frequency):
    """MTF [K] along an axis of the field (0: y, 1: x) by sums over pixels of a line spread of twice the cells, in the
    order of rising direction cosines."""
    cells = 2 * CELLS
    rows = (field if axis == 0 else field.T)[:: 1 if radius > 0 else -1]
    order = np.arange(cells)
    place = order - CELLS
    waves = np.exp(2j * ld.PI * np.outer(place, np.arange(CELLS)).astype(L) / cells)
    spread = (np.abs(waves @ rows) ** 2).sum(1)
    at = place / (2 * abs(radius) * 2)
    return np.abs((np.exp(-2j * ld.PI * np.outer(frequency, at)) * spread).sum(1)) / spread.sum()


def _solves(system, geo, at, at_m):
    """Focus solves, depth of field, hyperfocal distance."""
    pupil = _pupil(GRID)
    both = [at, 2 * at]
    bundles = []
    for distance in both:
        for f in FIELDS:
            rays = [ld.field_rays(system, k, f, pupil, distance) for k in LINES]
            bundles.append(
                (np.concatenate([r.position for r in rays]), np.concatenate([_slopes(r) for r in rays]))
            )
    wavelengths = [lens.WAVELENGTH_UM[k] for k in LINES]
    shared = focus_rays(geo, FIELDS, wavelengths, GRID, at_m=(at_m, 2 * at_m)).thickness_mm[-1]
    found = analysis.depth_of_field(geo, BLUR_MM, at_m)
    z = ld.entrance_pupil(system)
    film = ld.image_place(system, at)
    n = system.index["d"][-1]

    def blur(distance):  # diameter on the film of the paraxial light of a point
        edge = system.diameter / 2
        slope = edge / distance
        y, nu = ld.yu(system, "d", edge - slope * z, slope)
        return 2 * abs(y[-1] + film * nu[-1] / n)

    limits = [found.near_m, *([found.far_m] if bool(found.far_m.isfinite()) else [])]
    hyperfocal = analysis.hyperfocal_m(geo, BLUR_MM)
    film_there = ld.image_place(system, 1e3 * L(float(hyperfocal)))
    y, nu = ld.yu(system, "d", system.diameter / 2, 0)
    return {
        "paraxial_focus": error(geo.focus_at(at_m).thickness_mm[-1], film),
        "ray_focus": error(shared, system.thickness[-1] + ld.least_spot(bundles)),
        "depth_of_field": max(float(abs(blur(1e3 * L(float(d))) / BLUR_MM - 1)) for d in limits),
        "hyperfocal": float(abs(2 * abs(y[-1] + film_there * nu[-1] / n) / BLUR_MM - 1)),
    }
