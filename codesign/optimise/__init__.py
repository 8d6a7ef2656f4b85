"""Optimisers and the loop around them."""

from codesign.doors import explain
from codesign.optimise.descent import Descent
from codesign.optimise.gradients import SampleGradients, clipped_mean, sample_gradients
from codesign.optimise.least_squares import DampedLeastSquares, StopRules
from codesign.optimise.loop import Loop, Record, check_parameters

__all__ = [
    "DampedLeastSquares",
    "Descent",
    "Loop",
    "Record",
    "SampleGradients",
    "StopRules",
    "check_parameters",
    "clipped_mean",
    "sample_gradients",
]

explain(globals())
