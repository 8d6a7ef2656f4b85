"""Flow fields that claim the same everywhere."""

import torch

from codesign.types import FlowField


def field_of(flow, interval_s, deviation_px=0.1, confidence=1.0):
    """Of flow [N, 2, H, W]."""
    ones = torch.ones_like(flow[:, 0])
    covariance = deviation_px**2 * torch.stack([ones, 0 * ones, ones], 1)
    return FlowField(flow, ones.bool(), interval_s, confidence * ones, covariance)
