"""Certificates of gradients: autograd against differences with common random numbers; and other ways to a gradient where
they fail."""

from codesign.doors import explain
from codesign.grad.certify import certify, worst
from codesign.grad.differences import Difference, central
from codesign.grad.fallback import Choice, choose, gradient
from codesign.grad.row import Row

__all__ = ["Choice", "Difference", "Row", "central", "certify", "choose", "gradient", "worst"]

explain(globals())
