"""Designing a lens: solves, constraints, tolerances, and designs in principal modes of ray
motion."""

from codesign.lens.design.constraints import Limits
from codesign.lens.design.modes import LensDesign, detune, edge_thickness_mm, make_design
from codesign.lens.design.solves import focus_paraxial, focus_rays, hold_efl
from codesign.lens.design.tolerance import Tolerances

__all__ = [
    "LensDesign",
    "Limits",
    "Tolerances",
    "detune",
    "edge_thickness_mm",
    "focus_paraxial",
    "focus_rays",
    "hold_efl",
    "make_design",
]
