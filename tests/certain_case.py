"""A flow field whose confidence and covariance are known to be there, for tests of the closed
form."""

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Certain:
    flow_px: torch.Tensor
    confidence: torch.Tensor
    covariance_px2: torch.Tensor


def certain(field):
    """The field's flow, confidence and covariance, which the closed form always gives."""
    if field.confidence is None or field.covariance_px2 is None:
        raise AssertionError("the closed form gave no confidence or covariance")
    return Certain(field.flow_px, field.confidence, field.covariance_px2)
