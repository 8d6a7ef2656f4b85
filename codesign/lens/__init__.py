"""Differentiable lenses: ray-traced (GeoLens), thin, and pinhole."""

from codesign.lens import catalogue
from codesign.lens.analysis import rms_spot_mm, spots
from codesign.lens.catalogue import half_field_deg
from codesign.lens.files import load, save
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM, Glass
from codesign.lens.pinhole import Pinhole, ThinLens
from codesign.lens.surface import Surface
from codesign.lens.trace import Status, TraceResult

__all__ = ["WAVELENGTH_UM", "GeoLens", "Glass", "Pinhole", "Status", "Surface", "ThinLens", "TraceResult", "catalogue", "half_field_deg", "load", "rms_spot_mm", "save", "spots"]
