"""What may enter an event layer: frames, thresholds, times. Everything else is refused with a sentence."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.errors import DomainError, FileFormatError, ShapeError, as_number, check_finite, shown

Times = Tensor | Sequence[float] | np.ndarray  # seconds
REAL = (torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.int32, torch.int16)
LEAST = 1e-30  # of thresholds and time constants; its inverse is the largest
MOST_WHOLE = 2**62
MOST_VALUES = 2**32  # that are made in one call: 16 GB in single precision


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
    if minimum and (frames.ndim == 0 or frames.shape[0] < minimum):
        count = frames.shape[0] if frames.ndim else "no time axis, so 0"
        raise ShapeError(
            f"{name} hold {count} frame(s) (shape {list(frames.shape)}); at least {minimum} are needed, "
            "time on the first axis."
        )
    if frames.numel() == 0:
        raise ShapeError(f"{name} have shape {list(frames.shape)}, which holds no pixel; give at least one.")


def check_per_pixel(
    value: Tensor | float, name: str, frames: Tensor, dtype: torch.dtype | None = None
) -> Tensor:
    """Return a contrast threshold or time constant as a tensor on the frames' device that broadcasts over
    one frame.

    Args:
      value: number, 0-dim tensor, or tensor that broadcasts to the pixel shape ``frames.shape[1:]``; > 0,
        thresholds in natural log units. dtype: None: of the frames.
    Raises: DomainError when a value is no number from 1e-30 to 1e30, beyond which single precision ends;
      ShapeError when it does not broadcast.
    """
    if not isinstance(value, Tensor):
        value = as_number(value, name)
    elif value.dtype not in REAL or value.layout != torch.strided or value.is_meta:
        raise DomainError(
            f"{name} is a tensor of {value.dtype} on {value.device}; give a real number, or a dense tensor "
            "of them, > 0."
        )
    value = torch.as_tensor(value, dtype=torch.float64 if dtype is None else dtype, device=frames.device)
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
    if not (low >= LEAST and high <= 1 / LEAST):
        raise DomainError(
            f"{name} spans {low:g} to {high:g}; every value must be a number > 0, from {LEAST:g} to {1 / LEAST:g}."
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
    """Return frame times as a float64 tensor [count] on the CPU, strictly increasing; any number with None.

    Raises: ShapeError when the number of times differs; DomainError when they are no real numbers, do not
      increase strictly, are not finite, or require a gradient, which nothing gives to times.
    """
    times_s = as_seconds(t_s, "t_s")
    if isinstance(t_s, Tensor) and t_s.requires_grad:
        raise DomainError("t_s requires a gradient, and events give none to frame times; pass t_s.detach().")
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
    return times_s


def check_positive(value: float, name: str, unit: str = "", least: float = LEAST) -> float:
    """A number of at least ``least`` and at most 1e30 as a float; DomainError for anything else."""
    number = as_number(value, name)
    if not least <= number <= 1 / LEAST:
        raise DomainError(
            f"{name} is {shown(value)}; a finite number above 0{unit}, at least {least:g}, is needed."
        )
    return number


def check_whole(value: int, name: str, least: int | None = None, most: int = MOST_WHOLE) -> int:
    """A whole number as an int, at least ``least`` and at most ``most``; DomainError for anything else."""
    number = math.nan if isinstance(value, bool) else as_number(value, name)
    if (
        not math.isfinite(number)
        or int(value) != value
        or not (-most if least is None else least) <= value <= most
    ):
        bounds = "" if least is None else f" >= {least}"
        if number > most or (least is None and number < -most):
            bounds += f" up to {most}"
        raise DomainError(f"{name} is {shown(value)}; a whole number{bounds} is needed.")
    return int(value)


def check_flag(value: bool, name: str, meaning: str = "") -> bool:
    """True or False; DomainError for anything else."""
    if not isinstance(value, bool):
        raise DomainError(f"{name} is {shown(value)}; True{meaning} or False is needed.")
    return value


def check_choice(value: str, name: str, allowed: Iterable[str]) -> str:
    """One of several names; DomainError for anything else."""
    if not isinstance(value, str) or value not in allowed:
        raise DomainError(f"{name} is {shown(value)}; choose one of {', '.join(map(repr, allowed))}.")
    return value


def check_dtype(dtype: torch.dtype) -> None:
    """Raise DomainError for what is no real type of tensors."""
    if not any(dtype is one for one in REAL):
        raise DomainError(f"dtype is {shown(dtype)}; a real type is needed, such as torch.float32.")


def check_room(values: float, what: str) -> None:
    """Raise DomainError where a result would hold more values than are made in one call."""
    if not values <= MOST_VALUES:
        raise DomainError(
            f"{what} would hold {values:.3g} values, more than the {MOST_VALUES} of one call; ask for less."
        )


def check_path(path: str | Path) -> Path:
    """A path of a file; FileFormatError for what is none."""
    if not isinstance(path, (str, Path)) or not str(path) or "\0" in str(path):
        raise FileFormatError(
            f"the path is {shown(path)} ({type(path).__name__}); a str or pathlib.Path is needed."
        )
    return Path(path)


def check_counts(counts: Tensor, *, non_negative: bool = False) -> None:
    """Raise unless ``counts`` are a float32 or float64 tensor [T-1, 2, ..., H, W] of finite numbers, 0 or
    more where asked; ShapeError for the axes, DomainError for the rest."""
    check_layout(counts, 0, name="counts")
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
    """Return a level carried from an earlier chunk unchanged when it has the shape and type of one frame of
    ``level``, finite; ShapeError, DomainError otherwise."""
    if not isinstance(state, Tensor) or (state.shape, state.dtype, state.device) != (
        level.shape[1:],
        level.dtype,
        level.device,
    ):
        given = f"{state.dtype} {list(state.shape)}" if isinstance(state, Tensor) else type(state).__name__
        raise ShapeError(
            f"state is {given}, one frame is {level.dtype} {list(level.shape[1:])}; pass the state of the same "
            "sensor."
        )
    return check_finite(state, "state")


def check_state(state: object, kind: type) -> None:
    """Raise DomainError for a state that is neither None nor of its kind."""
    if state is not None and not isinstance(state, kind):
        raise DomainError(f"the state is a {type(state).__name__}; pass what the call before returned.")


def check_chunk(frames: Tensor, shape: torch.Size, dtype: torch.dtype) -> None:
    """Raise ShapeError for frames [T, ...] of another size or type than the frame [...] of the chunk
    before."""
    if (frames.shape[1:], frames.dtype) != (shape, dtype):
        raise ShapeError(
            f"{frames.dtype} frames of {list(frames.shape[1:])} follow {dtype} frames of {list(shape)}; chunks "
            "of time keep their size and type, a batch its samples."
        )


def check_later(times_s: Tensor, before_s: float) -> Tensor:
    """The times of a chunk with that of the frame before it ahead; DomainError where they go back."""
    if float(times_s[0]) <= before_s:
        raise DomainError(
            f"the chunk starts at {float(times_s[0])!r} s, the last frame seen was at {before_s!r} s; times "
            "must go on increasing."
        )
    return torch.cat((torch.tensor([before_s], dtype=torch.float64), times_s))
