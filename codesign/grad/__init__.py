"""Certificates of gradients: autograd against differences with common random numbers."""

from codesign.grad.certify import Row, certify, worst
from codesign.grad.differences import Difference, central, plateau

__all__ = ["Difference", "Row", "central", "certify", "plateau", "worst"]
