"""Certificates of gradients: autograd against differences with common random numbers."""

from codesign.grad.certify import certify, worst
from codesign.grad.differences import Difference, central, plateau
from codesign.grad.row import Row

__all__ = ["Difference", "Row", "central", "certify", "plateau", "worst"]
