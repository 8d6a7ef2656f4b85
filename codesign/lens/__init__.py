"""Differentiable lenses: ray-traced (GeoLens), thin, and pinhole."""

from codesign.doors import explain
from codesign.lens import analysis, catalogue, design
from codesign.lens.aiming import aimed_rays
from codesign.lens.analysis import pupil_grid, rms_spot_mm, spots
from codesign.lens.analysis.field_curves import relative_illumination
from codesign.lens.catalogue import half_field_deg
from codesign.lens.families import Family, family, family_names
from codesign.lens.files import load, save
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM, Glass
from codesign.lens.pinhole import Pinhole, ThinLens
from codesign.lens.seidel import seidel_sums
from codesign.lens.spectrum import Spectrum
from codesign.lens.surface import Phase, Surface
from codesign.lens.trace import Status, TraceResult, sum_over_chunks

__all__ = [
    "WAVELENGTH_UM",
    "Family",
    "GeoLens",
    "Glass",
    "Phase",
    "Pinhole",
    "Spectrum",
    "Status",
    "Surface",
    "ThinLens",
    "TraceResult",
    "aimed_rays",
    "analysis",
    "catalogue",
    "design",
    "family",
    "family_names",
    "half_field_deg",
    "load",
    "pupil_grid",
    "relative_illumination",
    "rms_spot_mm",
    "save",
    "seidel_sums",
    "spots",
    "sum_over_chunks",
]

explain(globals())
