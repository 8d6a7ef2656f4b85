"""What may enter an event layer: frames, thresholds, times. Everything else is refused with a
sentence."""

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.checks import FLOATS, LEAST, MOST, check, check_finite, check_kind, check_positive
from codesign.errors import DomainError, ShapeError, shown

Times = Tensor | Sequence[float] | np.ndarray  # seconds
REAL = (
    torch.float64,
    torch.float32,
    torch.float16,
    torch.bfloat16,
    torch.int64,
    torch.int32,
    torch.int16,
)
PICTURE = 256  # values from which on the scale of frames can be judged
MOST_VALUES = 2**32  # that are made in one call: 16 GB in single precision


def check_frames(
    frames: Tensor, minimum: int = 2, *, name: str = "frames", non_negative: bool = True
) -> Tensor:
    """Return ``frames`` unchanged when they are a float32 or float64 tensor [T, ...] of finite
    values.

    Args:
      frames: [T, ...] tensor, time first.
      minimum: least number of frames allowed.
      non_negative: also refuse values below 0 (linear intensity).
    Raises: ShapeError for too few frames or no pixels; DomainError for other types, NaN, infinite
      or negative values.
    """
    axes = f"T>={minimum} ..."
    least = 0.0 if non_negative else None
    remedy = "intensities are 0 or more: subtract the black level first" if non_negative else ""
    return check(frames, axes, name, FLOATS, least=least, finite=True, remedy=remedy)


def on_unit_scale(frames: Tensor) -> bool:
    """Whether linear frames seem to be on 0 to 1, on which the sensor sees nothing but black: the
    brightest is above 0 and at most 1. Others are mostly told by the first frame alone."""
    if frames.numel() < PICTURE or float(frames[:1].detach().max()) > 1:
        return False
    return 0 < float(frames.detach().max()) <= 1


def warn_of_scale(frames: Tensor, log_input: bool) -> None:
    """Warn of linear frames that seem to be on 0 to 1."""
    if not log_input and on_unit_scale(frames):
        warn_of_black()


def warn_of_black() -> None:
    """The warning itself, where the brightest of all frames is known."""
    warnings.warn(
        "no frame is brighter than 1; frames are linear light on the scale 0 to 255, on which these are "
        "black and make hardly an event: multiply by 255 if they are on 0 to 1.",
        UserWarning,
        stacklevel=3,
    )


def check_per_pixel(
    value: Tensor | float, name: str, frames: Tensor, dtype: torch.dtype | None = None
) -> Tensor:
    """Return a contrast threshold or time constant as a tensor on the frames' device that
    broadcasts over one frame.

    Args:
      value: number, 0-dim tensor, or tensor that broadcasts to the pixel shape
        ``frames.shape[1:]``; > 0, thresholds in natural log units. dtype: None: of the frames.
    Raises: DomainError when a value is no number from 1e-30 to 1e30, beyond which single precision
      ends; ShapeError when it does not broadcast.
    """
    if not isinstance(value, Tensor):
        value = check_positive(value, name)
    elif value.dtype not in REAL or value.layout != torch.strided or value.is_meta:
        raise DomainError(
            f"{name} is a tensor of {value.dtype} on {value.device}; give a real number, or a dense tensor "
            "of them, > 0."
        )
    value = torch.as_tensor(
        value, dtype=torch.float64 if dtype is None else dtype, device=frames.device
    )
    pixels = frames.shape[1:]
    fits = value.ndim <= len(pixels) and all(
        a in (1, b) for a, b in zip(reversed(value.shape), reversed(pixels), strict=False)
    )
    if not fits or value.numel() == 0:
        raise ShapeError(
            f"{name} has shape {list(value.shape)}; it must be a scalar or fit the pixel shape "
            f"{list(pixels)}."
        )
    low, high = (float(bound) for bound in value.detach().aminmax())
    if not (low >= LEAST and high <= MOST):
        raise DomainError(
            f"{name} spans {low:g} to {high:g}; every value must be a number > 0, from {LEAST:g} to {MOST:g}."
        )
    return value.to(frames.dtype if dtype is None else dtype)


def as_seconds(times: Any, name: str) -> Tensor:
    """Real numbers as a float64 tensor; DomainError for anything else."""
    try:
        found = torch.as_tensor(times)
        if found.is_complex() or found.is_meta:
            raise TypeError
        return torch.as_tensor(times, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise DomainError(
            f"{name} is {str(times)[:60]!r} ({type(times).__name__}); a list or tensor of real numbers, "
            "seconds, is needed."
        ) from None


def check_times(t_s: Times, count: int | None = None) -> Tensor:
    """Return frame times as a float64 tensor [count] on the CPU, strictly increasing; any number
    with None.

    Raises: ShapeError when the number of times differs; DomainError when they are no real numbers,
      do not increase strictly, are not finite, or require a gradient, which nothing gives to times.
    """
    times_s = as_seconds(t_s, "t_s")
    if isinstance(t_s, Tensor) and t_s.requires_grad:
        raise DomainError(
            "t_s requires a gradient, and events give none to frame times; pass t_s.detach()."
        )
    times_s = times_s.cpu()
    if times_s.ndim != 1 or count not in (None, len(times_s)):
        raise ShapeError(
            f"t_s has shape {list(times_s.shape)}; one time per frame is needed, [{count or 'T'}]."
        )
    if not len(times_s):
        raise ShapeError("t_s holds no time; at least one is needed.")
    check_finite(times_s, "t_s")
    steps = times_s.diff()
    if bool((steps <= 0).any()):
        at = int((steps <= 0).nonzero()[0])
        raise DomainError(
            f"t_s goes from {float(times_s[at])!r} to {float(times_s[at + 1])!r} s at index {at}; times "
            "must increase strictly."
        )
    dtype = torch.as_tensor(t_s).dtype
    if len(steps) and dtype in (torch.float32, torch.float16, torch.bfloat16):
        grid_s = torch.finfo(dtype).eps * float(times_s.abs().max())
        if grid_s > 1e-6 and float(steps.min()) < 256 * grid_s:
            raise DomainError(
                f"t_s tells times apart by {grid_s:.2g} s in {dtype}, too coarse for steps of {float(steps.min()):.2g} s; "
                "give float64, or times from the first frame on."
            )
    return times_s


def check_dtype(dtype: torch.dtype, fractions: bool = False) -> None:
    """Raise DomainError for what is no real type of tensors, and, for values with ``fractions``, for
    one of whole numbers."""
    if not any(dtype is one and (one.is_floating_point or not fractions) for one in REAL):
        kind = "floating" if fractions else "real"
        raise DomainError(
            f"dtype is {shown(dtype)}; a {kind} type is needed, such as torch.float32."
        )


def exactly(counts: Tensor, dtype: torch.dtype, what: str = "events") -> Tensor:
    """Whole counts in a type that holds them all; DomainError for another."""
    most = 2 / torch.finfo(dtype).eps if dtype.is_floating_point else torch.iinfo(dtype).max
    if counts.numel() and int(counts.max()) > most:
        raise DomainError(
            f"{int(counts.max())} {what} fall into one interval of a pixel, more than {dtype} holds exactly; take "
            "torch.float32."
        )
    return counts.to(dtype)


def check_room(values: float, what: str) -> None:
    """Raise DomainError where a result would hold more values than are made in one call."""
    if not values <= MOST_VALUES:
        raise DomainError(
            f"{what} would hold {values:.3g} values, more than the {MOST_VALUES} of one call; ask for less."
        )


def check_counts(counts: Tensor, *, non_negative: bool = False) -> None:
    """Raise unless ``counts`` are a float32 or float64 tensor [T-1, 2, ..., H, W] of finite
    numbers, 0 or more where asked; ShapeError for the axes, DomainError for the rest."""
    check(
        counts, "T-1 2 ... H W", "counts", FLOATS, least=0.0 if non_negative else None, finite=True
    )


def check_level(state: Tensor, level: Tensor) -> Tensor:
    """Return a level carried from an earlier chunk unchanged when it has the shape and type of one
    frame of ``level``, finite; ShapeError, DomainError otherwise."""
    return check(state, tuple(level.shape[1:]), "the state", (level.dtype,), finite=True)


def check_begun(state: Any, generator: Any) -> None:
    """Raise DomainError where a later chunk is given a generator beside its state."""
    if state is not None and generator is not None:
        raise DomainError(
            "a generator and a state are given; the state carries the generator of its first chunk on: "
            "leave the generator out."
        )


def check_state(state: object, kind: type) -> None:
    """Raise DomainError for a state that is neither None nor of its kind."""
    if state is not None:
        check_kind(state, kind, "the state", "pass what the call before returned")


def check_chunk(frames: Tensor, shape: torch.Size, dtype: torch.dtype) -> None:
    """Raise ShapeError for frames [T, ...] of another size or type than the frame [...] of the
    chunk before."""
    if (frames.shape[1:], frames.dtype) != (shape, dtype):
        raise ShapeError(
            f"{frames.dtype} frames of {list(frames.shape[1:])} follow {dtype} frames of {list(shape)}; chunks "
            "of time keep their size and type, a batch its samples."
        )


def check_later(times_s: Tensor, before_s: float) -> Tensor:
    """The times of a chunk with that of the frame before it ahead; DomainError where they go
    back."""
    if float(times_s[0]) <= before_s:
        raise DomainError(
            f"the chunk starts at {float(times_s[0])!r} s, the last frame seen was at {before_s!r} s; times "
            "must go on increasing."
        )
    return torch.cat((torch.tensor([before_s], dtype=torch.float64), times_s))
