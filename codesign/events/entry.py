"""What may enter an event layer: frames, thresholds, times. Everything else is refused with a sentence."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError, as_number, check_finite

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
    if frames.layout != torch.strided or frames.is_meta:
        given = "meta tensors without values" if frames.is_meta else f"stored as {frames.layout}"
        raise DomainError(f"{name} are {given}; a dense tensor is needed (sparse ones: frames.to_dense()).")
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
    is_complex = isinstance(theta, Tensor) and theta.is_complex()
    if isinstance(theta, bool) or is_complex or not isinstance(theta, (Tensor, float, int)):
        raise DomainError(
            f"{name} is a {'complex tensor' if is_complex else type(theta).__name__}; give a number or a "
            "tensor of natural log units."
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


def check_times(t_s: Times, count: int | None = None) -> Tensor:
    """Return frame times as a float64 tensor [count] on the CPU, strictly increasing; any number with None.

    Raises: ShapeError when the number of times differs; DomainError when they are no real numbers, do not
      increase strictly, are not finite, or require a gradient, which nothing gives to times.
    """
    try:
        times_s = torch.as_tensor(t_s)
        if times_s.is_complex():
            raise TypeError
        times_s = torch.as_tensor(t_s, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError):
        raise DomainError(
            f"t_s is {str(t_s)[:60]!r} ({type(t_s).__name__}); times are a list or tensor of real numbers, "
            "seconds."
        ) from None
    if isinstance(t_s, Tensor) and t_s.requires_grad:
        raise DomainError("t_s requires a gradient, and events give none to frame times; pass t_s.detach().")
    times_s = times_s.cpu()
    if times_s.ndim != 1 or len(times_s) != (len(times_s) if count is None else count):
        raise ShapeError(
            f"t_s has shape {list(times_s.shape)}; one time per frame is needed, [{count or 'T'}]."
        )
    check_finite(times_s, "t_s")
    steps = times_s.diff()
    if bool((steps <= 0).any()):
        at = int((steps <= 0).nonzero()[0])
        raise DomainError(
            f"t_s goes from {float(times_s[at])!r} to {float(times_s[at + 1])!r} s at index {at}; times "
            "must increase strictly."
        )
    return times_s


def check_positive(value: float, name: str, unit: str = "") -> float:
    """A finite number above 0 as a float; DomainError for anything else."""
    number = as_number(value, name)
    if not 0 < number < math.inf:
        raise DomainError(f"{name} is {value!r}; a finite number above 0{unit} is needed.")
    return number


def check_whole(value: int, name: str, least: int | None = None) -> int:
    """A whole number as an int, at least ``least``; DomainError for anything else."""
    number = math.nan if isinstance(value, bool) else as_number(value, name)
    if not math.isfinite(number) or int(value) != value or (least is not None and value < least):
        raise DomainError(
            f"{name} is {value!r}; a whole number{'' if least is None else f' >= {least}'} is needed."
        )
    return int(value)


def check_counts(counts: Tensor, *, non_negative: bool = False) -> None:
    """Raise unless ``counts`` are a float32 or float64 tensor [T-1, 2, ..., H, W] of finite numbers, 0 or more
    where asked; ShapeError for the axes, DomainError for the rest."""
    if not isinstance(counts, Tensor) or counts.dtype not in (torch.float32, torch.float64):
        given = counts.dtype if isinstance(counts, Tensor) else type(counts).__name__
        raise DomainError(
            f"counts are {given}; a torch tensor of float32 or float64 is needed, since bins take shares of "
            "an event: convert with .float()."
        )
    if counts.ndim < 4 or counts.shape[1] != 2 or 0 in counts.shape:
        raise ShapeError(
            f"counts have shape {list(counts.shape)}; [T-1, 2, H, W] or [T-1, 2, K, H, W] is needed, ON first "
            "on axis 1, no axis empty."
        )
    check_finite(counts, "counts")
    if non_negative and bool((counts < 0).any()):
        raise DomainError(
            f"counts reach down to {float(counts.detach().min()):g}; numbers of events are 0 or more."
        )


def check_level(state: Tensor, level: Tensor) -> Tensor:
    """Return a memorised level unchanged when it has the shape and type of one frame of ``level``, finite;
    ShapeError, DomainError otherwise."""
    if not isinstance(state, Tensor) or state.shape != level.shape[1:] or state.dtype != level.dtype:
        given = f"{state.dtype} {list(state.shape)}" if isinstance(state, Tensor) else type(state).__name__
        raise ShapeError(
            f"state is {given}, one frame is {level.dtype} {list(level.shape[1:])}; pass the state of the same "
            "sensor."
        )
    return check_finite(state, "state")
