"""What may enter an event layer: frames, thresholds, times. Everything else is refused with a sentence."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError, check_finite

Times = Tensor | Sequence[float] | np.ndarray  # seconds


def check_frames(
    frames: Tensor, minimum: int = 2, *, name: str = "frames", non_negative: bool = True
) -> Tensor:
    """Return ``frames`` unchanged when they are a float32 or float64 tensor [T, ...] of finite values.

    Args:
      frames: [T, ...] tensor, time first.
      minimum: least number of frames allowed.
      non_negative: also refuse values below 0 (linear intensity).
    Raises: ShapeError for too few frames or no pixels; DomainError for other types, NaN, infinite or negative
      values.
    """
    check_layout(frames, minimum, name=name)
    low, high = (float(bound) for bound in frames.detach().aminmax())
    if not (math.isfinite(low) and math.isfinite(high)):
        check_finite(frames, name)
    if non_negative and low < 0:
        first = (frames.detach() < 0).nonzero()[0].tolist()
        raise DomainError(
            f"{name} reach down to {low:g} (first negative at index {first}); intensities are 0 or more: "
            "subtract the black level first."
        )
    return frames


def check_layout(frames: Tensor, minimum: int = 2, *, name: str = "frames") -> None:
    """The part of ``check_frames`` that reads no value: type, number of frames, pixels. For kernels that look
    at the values themselves."""
    if not isinstance(frames, Tensor) or frames.dtype not in (torch.float32, torch.float64):
        given = frames.dtype if isinstance(frames, Tensor) else type(frames).__name__
        raise DomainError(
            f"{name} are {given}; a torch tensor of float32 or float64 is needed: convert with "
            "torch.as_tensor(frames).float()."
        )
    if frames.ndim == 0 or frames.shape[0] < minimum:
        count = frames.shape[0] if frames.ndim else "no time axis, so 0"
        raise ShapeError(
            f"{name} hold {count} frame(s) (shape {list(frames.shape)}); at least {minimum} are needed, "
            "time on the first axis."
        )
    if frames.numel() == 0:
        raise ShapeError(f"{name} have shape {list(frames.shape)}, which holds no pixel; give at least one.")


def check_theta(theta: Tensor | float, name: str, frames: Tensor) -> Tensor:
    """Return a contrast threshold as a tensor of the frames' dtype and device that broadcasts over one frame.

    Args:
      theta: number, 0-dim tensor, or tensor that broadcasts to the pixel shape ``frames.shape[1:]``; natural
        log units, > 0.
    Raises: DomainError when a threshold is not a positive finite number; ShapeError when it does not
      broadcast.
    """
    if not isinstance(theta, (Tensor, float, int)):
        raise DomainError(
            f"{name} is a {type(theta).__name__}; give a number or a tensor of natural log units."
        )
    theta = torch.as_tensor(theta, dtype=frames.dtype, device=frames.device)
    pixels = frames.shape[1:]
    fits = theta.ndim <= len(pixels) and all(
        a in (1, b) for a, b in zip(reversed(theta.shape), reversed(pixels), strict=False)
    )
    if not fits or theta.numel() == 0:
        raise ShapeError(
            f"{name} has shape {list(theta.shape)}; it must be a scalar or fit the pixel shape "
            f"{list(pixels)}."
        )
    low, high = (float(bound) for bound in theta.detach().aminmax())
    if not (low > 0 and math.isfinite(high)):
        raise DomainError(
            f"{name} spans {low:g} to {high:g}; every contrast threshold must be a finite number > 0 (0.2 "
            "is typical)."
        )
    return theta


def check_times(t_s: Times, count: int) -> Tensor:
    """Return frame times as a float64 tensor [count] on the CPU, strictly increasing.

    Raises: ShapeError when the number of times differs; DomainError when they do not increase strictly or are
      not finite.
    """
    times_s = torch.as_tensor(t_s, dtype=torch.float64).detach().cpu()
    if times_s.shape != (count,):
        raise ShapeError(f"t_s has shape {list(times_s.shape)}; one time per frame is needed, [{count}].")
    check_finite(times_s, "t_s")
    steps = times_s.diff()
    if bool((steps <= 0).any()):
        at = int((steps <= 0).nonzero()[0])
        raise DomainError(
            f"t_s goes from {float(times_s[at])!r} to {float(times_s[at + 1])!r} s at index {at}; times "
            "must increase strictly."
        )
    return times_s
