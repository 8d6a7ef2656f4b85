"""Optimisers and the loop around them."""

from codesign.doors import explain
from codesign.optimise.descent import Descent
from codesign.optimise.least_squares import DampedLeastSquares, StopRules
from codesign.optimise.loop import Loop, Record

__all__ = [
    "DampedLeastSquares",
    "Descent",
    "Loop",
    "Record",
    "StopRules",
]

explain(globals())
