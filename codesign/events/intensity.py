"""Front end of the event sensor: from linear intensity to log level."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign import backend
from codesign.checks import check_flag
from codesign.events.entry import check_frames, warn_of_scale
from codesign.exclusive import exclusive

JOINT = 20.0  # intensity on the 0-255 scale where the linear part meets the logarithm
DARK_SLOPE = math.log(JOINT) / JOINT


def lin_log(frames: Tensor) -> Tensor:
    """Log intensity with a linear part for dark pixels.

    Args:
      frames: [T, ...] linear intensity on the 0-255 scale, finite, >= 0 (values above 255 are taken
        as they are).
    Returns:
      [T, ...] natural log units: I ln(20)/20 for I <= 20, ln I above. Continuous; v2e's rounding to
      1e-8 is left out.
    Gradient: frames. Slope ln(20)/20 = 0.1498 up to and including I = 20, 1/I above (it drops to
      0.05 at the joint, as in v2e).
    Raises: DomainError for NaN, infinite or negative values.
    Source: v2e (Hu, Liu, Delbruck, CVPR-W 2021), lin-log mapping.
    """
    return _lin_log(check_frames(frames, minimum=1))


def _lin_log(frames):
    # the logarithm gets a safe input where it is not selected, so that its gradient there is 0 and
    # not 0 * inf
    return torch.where(frames <= JOINT, frames * DARK_SLOPE, frames.clamp(min=JOINT).log())


def _linear(arr, level):
    """Inverse of lin-log, in one launch: in torch each of its operations passes through memory."""
    import drjit as dr

    joint = math.log(JOINT)
    dark = dr.maximum(level, 0) / DARK_SLOPE
    return (dr.select(level <= joint, dark, dr.exp(dr.maximum(level, joint))),)


def light_share(intensity: Any) -> Any:
    """How far the photoreceptor's speed and noise are from dark to full light: (I + 20)/275, 1 at I
    = 255. Tensors and drjit arrays. Source: v2e."""
    return (intensity + 20) / 275


@dataclass(frozen=True)
class FrontEnd:
    """How frames become log levels: lin-log of the 0-255 scale, or frames that are log levels
    already (``log_input``)."""

    log_input: bool = False

    def __post_init__(self):
        check_flag(self.log_input, "log_input")

    def level(self, frames):
        """Log level of a tensor of frames; gradient: frames."""
        return frames if self.log_input else _lin_log(frames)

    def frames(self, level):
        """Frames [...] whose level a tensor is, the inverse of ``level``; a linear one is never
        below 0."""
        return level if self.log_input else backend.run_kernel(_linear, (level,), [level.shape])[0]

    def slope(self, frames):
        """Derivative of the level to the frame."""
        if self.log_input:
            return torch.ones_like(frames)
        return torch.where(frames <= JOINT, DARK_SLOPE, 1 / frames.clamp(min=JOINT))

    def traced(self, dr, frames):
        """The same of a drjit array, and its slope as a function (called where a gradient is
        wanted)."""
        if self.log_input:
            return frames, lambda: frames * 0 + 1
        dark = frames <= JOINT
        safe = dr.maximum(frames, JOINT)
        level = dr.select(dark, frames * DARK_SLOPE, dr.log(safe))
        return level, lambda: dr.select(dark, DARK_SLOPE, dr.rcp(safe))

    def accepts(self, dr, frames):
        """Mask of drjit values that may enter: finite, and >= 0 where they are linear."""
        return dr.isfinite(frames) if self.log_input else (frames >= 0) & (frames < math.inf)


@exclusive
def kernel_levels(frames, front_end):
    """Log levels of frames by the arithmetic of the kernels, which rounds alike on every processor
    (torch's logarithm does not); also whether one may not enter (then the levels mean nothing). No
    gradient."""
    import drjit as dr

    arr = backend.arrays(frames.device.type, frames.dtype)
    values = backend.load(arr.Float, frames)
    with dr.suspend_grad():
        found = front_end.traced(dr, values)[0]
        bad = dr.any(~front_end.accepts(dr, values))
        dr.eval(found, bad)
    dr.sync_thread()
    return found.torch().reshape(frames.shape).clone(), bool(bad[0])


def log_levels(frames: Tensor, log_input: bool, minimum: int) -> Tensor:
    """Check frames and bring them to log intensity; ``log_input`` says that they already are."""
    return front_end_of(frames, log_input, minimum).level(frames)


def front_end_of(frames: Tensor, log_input: bool, minimum: int) -> FrontEnd:
    """Check frames; how they become log levels."""
    front_end = FrontEnd(log_input)
    check_frames(frames, minimum, non_negative=not log_input)
    warn_of_scale(frames, log_input)
    return front_end
