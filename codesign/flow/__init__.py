"""Event flow: the closed-form estimator and error measures."""

from codesign.flow import metrics
from codesign.flow.lk import estimate_lk

__all__ = ["estimate_lk", "metrics"]
