"""Optimisers and the loop around them."""

from codesign.optimise.adam import ScaledAdam
from codesign.optimise.least_squares import DampedLeastSquares, StopRules

__all__ = ["DampedLeastSquares", "ScaledAdam", "StopRules"]
