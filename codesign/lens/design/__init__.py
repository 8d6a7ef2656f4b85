"""Designing a lens: solves, constraints, tolerances, and designs in principal modes of ray
motion."""

from codesign.doors import explain
from codesign.lens.design.constraints import Limits
from codesign.lens.design.hits import fit_apertures
from codesign.lens.design.modes import LensDesign, detune, edge_thickness_mm, make_design
from codesign.lens.design.moves import (
    elements,
    flattened,
    groups,
    moved_element,
    neighbour_glasses,
    with_glass,
    without_element,
)
from codesign.lens.design.tolerance import Tolerances
from codesign.lens.solves import focus_paraxial, focus_rays, hold_efl

__all__ = [
    "LensDesign",
    "Limits",
    "Tolerances",
    "detune",
    "edge_thickness_mm",
    "elements",
    "fit_apertures",
    "flattened",
    "focus_paraxial",
    "focus_rays",
    "groups",
    "hold_efl",
    "make_design",
    "moved_element",
    "neighbour_glasses",
    "with_glass",
    "without_element",
]

explain(globals())
