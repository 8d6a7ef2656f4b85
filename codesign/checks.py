"""Arguments checked at the door, once: what was given, what is wanted, what to do. One fault is one
sentence
everywhere: ``<name> must be <what is wanted>, got <what was given>; <what to do>.``"""

import math
import os
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from codesign.errors import DomainError, FileFormatError, ShapeError, shown

Kind = TypeVar("Kind")
FLOATS = (torch.float32, torch.float64)
# of what is positive: beyond, single precision ends
LEAST = 1e-30
MOST = 1e30
MOST_WHOLE = 2**62


def check(
    value: Any,
    axes: str | tuple[int, ...],
    name: str,
    dtypes: tuple[torch.dtype, ...] = (),
    *,
    sizes: dict[str, int] | None = None,
    least: float | None = None,
    finite: bool = False,
    remedy: str = "",
) -> Tensor:
    """``value`` unchanged when it is a dense tensor of this type and shape.

    >>> check(torch.zeros(5, 2, 8, 9), "B 2 H W", "the flow").shape
    torch.Size([5, 2, 8, 9])

    Args:
      axes: of the shape: numbers, and letters for at least one entry ("T>=2" for at least two), the
        same letter for the same size; "..." stands for any axes, once ("...>=0" where they may be
        empty). A tuple is an exact shape.
      dtypes: allowed; floating-point numbers of any precision by default.
      sizes: what letters stand for, from tensors checked before; letters that are new are added.
      least, finite: of the values, which are otherwise not looked at.
      remedy: what to do where values are wrong.
    Raises: DomainError for another type, no values, or values out of range; ShapeError for another
      shape.
    """
    if not isinstance(value, Tensor):
        raise DomainError(
            f"{name} must be a torch tensor, got {shown(value)}; see torch.as_tensor."
        )
    if value.dtype not in dtypes if dtypes else not value.is_floating_point():
        wanted = (
            " or ".join(str(dtype).removeprefix("torch.") for dtype in dtypes)
            or "floating-point numbers"
        )
        raise DomainError(f"{name} must be {wanted}, got {value.dtype}; convert with .to().")
    if value.layout != torch.strided or value.is_meta:
        given = "a meta tensor without values" if value.is_meta else f"one stored as {value.layout}"
        raise DomainError(
            f"{name} must be a dense tensor, got {given}; sparse ones become dense by .to_dense()."
        )
    _check_shape(value, axes, name, {} if sizes is None else sizes)
    if least is None:
        return check_finite(value, name, remedy) if finite else value
    low, high = (float(bound) for bound in value.detach().aminmax())
    if math.isnan(low) or (finite and not math.isfinite(low + high)):
        check_finite(value, name, remedy)
    if low < least:
        first = (value.detach() < least).nonzero()[0].tolist()
        raise DomainError(
            f"{name} must be >= {least:g}, got {low:g} (first below at index {first}){_told(remedy)}."
        )
    return value


def check_finite(tensor: Tensor, name: str, remedy: str = "") -> Tensor:
    """``tensor`` unchanged when it holds neither NaN nor infinity. Raises: DomainError."""
    # one pass, and no finite entry can hide another that is not
    if bool(tensor.detach().sum().isfinite()):
        return tensor
    finite = tensor.detach().isfinite()
    if not bool(finite.all()):
        first = (~finite).nonzero()[0].tolist()
        raise DomainError(
            f"{name} must be finite, got NaN or infinity in {int((~finite).sum())} of {finite.numel()} values "
            f"(first at index {first}){_told(remedy or 'remove or repair them')}."
        )
    return tensor


def check_number(
    value: Any,
    name: str,
    least: float = -math.inf,
    most: float = math.inf,
    *,
    above: float = -math.inf,
    below: float = math.inf,
    remedy: str = "",
) -> float:
    """A finite number as a float, also of a tensor of one element. Raises: DomainError for anything
    else.

    Args:
      least, most: smallest and largest that is allowed.
      above, below: the same, themselves not allowed.
    """
    number = _number(value)
    if not (math.isfinite(number) and least <= number <= most and above < number < below):
        raise DomainError(
            f"{name} must be a finite number{_bounds(least, most, above, below)}, got {shown(value)}{_told(remedy)}."
        )
    return number


def check_positive(value: Any, name: str, least: float = LEAST, remedy: str = "") -> float:
    """A number > 0 as a float, from ``least`` to 1e30. Raises: DomainError for anything else."""
    number = check_number(value, name, above=0.0, remedy=remedy)
    return check_number(number, name, least, MOST, remedy=remedy)


def check_whole(
    value: Any, name: str, least: int | None = 1, most: int = MOST_WHOLE, remedy: str = ""
) -> int:
    """A whole number as an int, from ``least`` (None: any) to ``most``. Raises: DomainError for
    anything else."""
    number = _number(value)
    lowest = -most if least is None else least
    if not (math.isfinite(number) and number % 1 == 0 and lowest <= int(value) <= most):
        first = lowest if least is not None or number < lowest else -math.inf
        beyond = math.isfinite(number) and int(value) > most
        bounds = _bounds(first, most if most < MOST_WHOLE or beyond else math.inf)
        raise DomainError(
            f"{name} must be a whole number{bounds}, got {shown(value)}{_told(remedy)}."
        )
    return int(value)


def check_seed(value: Any, name: str, bits: int = 63) -> int:
    """A seed as an int, below 2 ** ``bits`` in size. Raises: DomainError for anything else."""
    return check_whole(value, name, None, 2**bits - 1)


def check_flag(value: Any, name: str) -> bool:
    """True or False. Raises: DomainError for anything else."""
    if not isinstance(value, bool):
        raise DomainError(f"{name} must be True or False, got {shown(value)}.")
    return value


def check_choice(value: Any, name: str, allowed: Iterable[str]) -> str:
    """One of several names. Raises: DomainError for anything else."""
    if not isinstance(value, str) or value not in allowed:
        raise DomainError(
            f"{name} must be one of {', '.join(map(repr, allowed))}, got {shown(value)}."
        )
    return value


def check_kind(value: Any, kind: type[Kind], name: str, remedy: str = "") -> Kind:
    """``value`` unchanged when it is a ``kind``. Raises: DomainError for anything else."""
    if not isinstance(value, kind):
        raise DomainError(f"{name} must be {_a(kind)}, got {_a(type(value))}{_told(remedy)}.")
    return value


def check_path(path: Any, name: str = "the path") -> Path:
    """``path`` as a Path. Raises: FileFormatError for anything but text or a path of files."""
    if not isinstance(path, (str, os.PathLike)) or not str(path) or "\0" in str(path):
        raise FileFormatError(f"{name} must be text or a pathlib.Path, got {shown(path)}.")
    return Path(path)


def _check_shape(value, axes, name, sizes):
    shape = tuple(value.shape)
    if isinstance(axes, tuple):
        if shape != axes:
            raise ShapeError(f"{name} must be {list(axes)}, got {list(shape)}.")
        return
    words, parts, spot = _read(axes)
    # how many axes "..." stands for
    spare = len(shape) - len(parts) + 1 if spot is not None else 0
    if spot is not None and spare >= 0:
        any_axis = [("", parts[spot][1])] * spare
        parts = [*parts[:spot], *any_axis, *parts[spot + 1 :]]
    known = {axis: sizes[axis] for axis, _ in parts if axis in sizes}
    fits = len(shape) == len(parts)
    for size, (axis, least) in zip(shape, parts, strict=False):
        wanted = int(axis) if axis.isdigit() else sizes.setdefault(axis, size) if axis else size
        fits = fits and size == wanted and size >= least
    if not fits:
        told = "".join(f", {axis} = {size}" for axis, size in known.items()).replace(
            ",", " with", 1
        )
        empty = " (no axis may be empty)" if 0 in shape else ""
        raise ShapeError(f"{name} must be [{', '.join(words)}]{told}, got {list(shape)}{empty}.")


@cache
def _read(axes):
    """The words of a shape; (letter or number, least size) of each axis; the place of "..." among
    them, or None."""
    words = axes.split()
    split = [word.partition(">=") for word in words]
    parts = [(axis, 0 if axis.isdigit() else int(least or 1)) for axis, _, least in split]
    spots = [place for place, (axis, _) in enumerate(parts) if axis == "..."]
    return words, parts, spots[0] if spots else None


def _number(value):
    """A real number as a float, NaN for what is none: text and truth values, also inside arrays."""
    kind = getattr(getattr(value, "dtype", None), "kind", "f")  # NumPy's
    if isinstance(value, (str, bytes, bool)) or kind not in "iuf":
        return math.nan
    if isinstance(value, Tensor):
        value = math.nan if value.dtype == torch.bool else value.detach()
    try:
        return float(value)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return math.nan


def _bounds(least, most, above=-math.inf, below=math.inf):
    if math.isfinite(least) and math.isfinite(most):
        return f" from {least:g} to {most:g}"
    bounds = ((">", above), (">=", least), ("<", below), ("<=", most))
    return " and".join(f" {sign} {bound:g}" for sign, bound in bounds if math.isfinite(bound))


def _a(kind):
    return f"{'an' if kind.__name__[0] in 'AEIOaeio' else 'a'} {kind.__name__}"


def _told(remedy):
    return f"; {remedy}" if remedy else ""
