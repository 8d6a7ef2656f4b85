"""Certificates of gradients: autograd against differences with common random numbers."""

from codesign.doors import explain
from codesign.grad.certify import certify, worst
from codesign.grad.differences import Difference
from codesign.grad.row import Row

__all__ = ["Difference", "Row", "certify", "worst"]

explain(globals())
