"""The sigmoid per frame pair: the named baseline that the memory layer is measured against."""

import torch
from torch import Tensor

from codesign.events.entry import check_per_pixel, check_positive
from codesign.events.intensity import log_levels

GHOST_LOGIT = -5.0  # a pixel without change fires sigmoid(-5) = 0.67 % of an event per polarity and frame


def soft(
    frames: Tensor, theta: Tensor | float, *, sharpness: float | None = None, log_input: bool = False
) -> Tensor:
    """Soft events of consecutive frames, without memory and capped at one per pixel, polarity and frame.

    Args:
      frames: [T, ...] linear intensity on the 0-255 scale (lin-log is applied here), any pixel shape; log
        intensity with ``log_input``.
      theta: contrast threshold > 0, natural log units, scalar or broadcasting over one frame.
      sharpness: k > 0 in 1/log units; None: k = 5/theta.
    Returns: [T-1, 2, ...] ON = sigmoid(k (dL - theta)), OFF = sigmoid(k (-dL - theta)), between 0 and 1,
      never 0.
    Gradient: frames and theta, exact.
    Raises: ShapeError for fewer than two frames; DomainError for theta or sharpness <= 0, NaN, infinite or
      negative input.

    Example:
    >>> from codesign import events
    >>> frames = torch.tensor([50.0, 100.0, 60.0]).reshape(3, 1, 1)
    >>> counts = events.soft(frames, theta=0.2)
    >>> [[round(count, 3) for count in step] for step in counts.flatten(1).tolist()]
    [[1.0, 0.0], [0.0, 1.0]]
    """
    level = log_levels(frames, log_input, minimum=2)
    theta = check_per_pixel(theta, "theta", level)
    k = -GHOST_LOGIT / theta if sharpness is None else check_positive(sharpness, "sharpness")
    step = level.diff(dim=0)
    return torch.stack((torch.sigmoid(k * (step - theta)), torch.sigmoid(k * (-step - theta))), dim=1)
