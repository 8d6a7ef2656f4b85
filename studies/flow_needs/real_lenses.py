"""A triplet with one aberration at a time, each of stated blur: what the synthetic point images are held against."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from scipy.optimize import minimize_scalar

from codesign import lens
from codesign.lens import GeoLens
from studies.flow_needs.cases import EFL_MM, WALL_M
from studies.flow_needs.measure import camera_of
from studies.flow_needs.predictors import point_images_px, ramp

WANTED_PX = (0.75, 1.5, 3.0)
ELEMENTS = ((0, 1), (2, 3), (4, 5))
STOP = 3
DECENTRE_MM = 0.1  # of elements, per unit of amplitude, standard deviations
TILT_DEG = 0.5
SHIFT_MM = 0.02
PLATE_MM = 6.0  # thickness of the plate that makes astigmatism
WIDE_MM = 3.0  # semi-aperture that clips nothing


Make = Callable[[float], GeoLens]  # of an amplitude


def nominal() -> GeoLens:
    """The Cooke triplet, f/5, at the studies' focal length, focused on the walls, with apertures that clip nothing."""
    published = lens.load("cooke-triplet")
    scaled = published.scaled(EFL_MM / float(published.first_order().efl_mm.detach()))
    surfaces = [dataclasses.replace(s, semi_aperture_mm=WIDE_MM) for s in scaled.to_surfaces()]
    return GeoLens(surfaces, scaled.entrance_pupil_diameter_mm).focus_at(WALL_M, spot_grid=16).freeze()


def families() -> dict[str, tuple[Make, float]]:
    """Every kind of fault by name: what makes the lens of an amplitude, and an amplitude to begin a search with."""
    start = nominal()

    def defocused(shift_mm):
        return shifted(start, shift_mm)

    def spherical(term):
        return changed(start, {STOP: {"asphere": (0.0, term)}}).focus_at(WALL_M, spot_grid=16).freeze()

    def coma(decentre_mm):
        return changed(start, {row: {"decentre_mm": (decentre_mm, 0.0)} for row in ELEMENTS[1]})

    def astigmatism(tilt_deg):
        return astigmatic(start, tilt_deg)

    return {
        "defocus": (defocused, 0.1),
        "spherical": (spherical, 1e-3),
        "coma": (coma, 0.1),
        "astigmatism": (astigmatism, 8.0),
        "built with errors, 1": (_built(start, 1), 0.2),
        "built with errors, 2": (_built(start, 2), 0.2),
    }


def judged() -> Iterator[tuple[str, float, GeoLens]]:
    """Family, RMS radius in pixels and lens, of every family at every radius wanted.

    Raises: DomainError when a family does not reach it.
    """
    camera = camera_of(nominal(), "centre")
    for name, (make, first) in families().items():
        for wanted_px in WANTED_PX:
            yield name, wanted_px, ramp(make, camera, wanted_px, first)


def changed(optics: GeoLens, rows: Mapping[int, Mapping[str, Any]]) -> GeoLens:
    """The lens with other fields of some surfaces."""
    surfaces = list(optics.to_surfaces())
    for row, fields in rows.items():
        surfaces[row] = dataclasses.replace(surfaces[row], **fields)
    return GeoLens(surfaces, optics.entrance_pupil_diameter_mm).freeze()


def shifted(optics: GeoLens, shift_mm: float) -> GeoLens:
    """The lens with its film further behind it."""
    last = optics.thickness_mm[-1:] + shift_mm
    return optics.replace(thickness_mm=torch.cat([optics.thickness_mm[:-1], last]).detach())


def astigmatic(start: GeoLens, tilt_deg: float) -> GeoLens:
    """A tilted plate behind the lens, and the film where points are shortest across the tilt's axis: lines along it."""
    surfaces = list(start.to_surfaces())
    gap_mm = surfaces[-1].thickness_mm
    surfaces[-1] = dataclasses.replace(surfaces[-1], thickness_mm=(gap_mm - PLATE_MM) / 2)
    plane = dataclasses.replace(surfaces[-1], radius_mm=math.inf, tilt_deg=(tilt_deg, 0.0))
    glass = dataclasses.replace(plane, thickness_mm=PLATE_MM, medium=surfaces[0].medium)
    optics = GeoLens([*surfaces, glass, plane], start.entrance_pupil_diameter_mm).focus_at(WALL_M).freeze()

    def length_px(shift_mm):
        points = point_images_px(camera_of(shifted(optics, shift_mm), "centre"), grid=12)
        return float(points[..., 1].square().mean().sqrt())

    found = minimize_scalar(length_px, bounds=(-1.0, 1.0), method="bounded", options={"xatol": 1e-3})
    return shifted(optics, float(found.x))


def _built(start, seed):
    """Elements off the axis, tilted, and at wrong distances, all in proportion to an amplitude."""
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randn(len(ELEMENTS), 5, generator=generator, dtype=torch.float64)
    surfaces = start.to_surfaces()

    def make(amplitude):
        rows = {}
        for element, row in zip(ELEMENTS, (amplitude * drawn).tolist(), strict=True):
            for surface in element:
                rows[surface] = {
                    "decentre_mm": (DECENTRE_MM * row[0], DECENTRE_MM * row[1]),
                    "tilt_deg": (TILT_DEG * row[2], TILT_DEG * row[3]),
                }
            behind = element[1]
            rows[behind]["thickness_mm"] = surfaces[behind].thickness_mm + SHIFT_MM * row[4]
        return changed(start, rows)

    return make
