"""Front end of the event sensor: linear for dark pixels, logarithmic for the rest."""

import math

import torch

from codesign.events.entry import check_frames

JOINT = 20.0  # intensity on the 0-255 scale where the linear part meets the logarithm
DARK_SLOPE = math.log(JOINT) / JOINT


def lin_log(frames):
    """Log intensity with a linear part for dark pixels.

    Args:
      frames: [T, ...] linear intensity on the 0-255 scale, finite, >= 0 (values above 255 are taken as they are).
    Returns:
      [T, ...] natural log units: I ln(20)/20 for I <= 20, ln I above. Continuous; v2e's rounding to 1e-8 is left out.
    Gradient: frames. Slope ln(20)/20 = 0.1498 up to and including I = 20, 1/I above (it drops to 0.05 at the joint, as in v2e).
    Raises: DomainError for NaN, infinite or negative values.
    Source: v2e (Hu, Liu, Delbruck, CVPR-W 2021), lin-log mapping.
    """
    return _lin_log(check_frames(frames, minimum=1))


def _lin_log(frames):
    # the logarithm gets a safe input where it is not selected, so that its gradient there is 0 and not 0 * inf
    return torch.where(frames <= JOINT, frames * DARK_SLOPE, frames.clamp(min=JOINT).log())


def log_levels(frames, log_input, minimum):
    """Check frames and bring them to log intensity; ``log_input`` says that they already are."""
    check_frames(frames, minimum, non_negative=not log_input)
    return frames if log_input else _lin_log(frames)
