"""One small family of exceptions. Every message says what was given, what is allowed, and what to
do. A search is not told of what it does not find."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import PurePath
from typing import Any

_searched = ContextVar("searched", default=False)


class CodesignError(Exception):
    """Anything the user can mend. Commands print the message alone and exit with code 2."""


class ShapeError(CodesignError, ValueError):
    """A tensor has the wrong number of axes or the wrong size along one."""


class DomainError(CodesignError, ValueError):
    """A value lies outside what the formula or the hardware allows (NaN included)."""


class FileFormatError(CodesignError, ValueError):
    """A file is missing, malformed, or of a kind this function does not read."""


class MissingPackageError(CodesignError, ImportError):
    """A package that the core does without is not installed; the message names the extra that
    brings it."""


class BackendError(CodesignError, RuntimeError):
    """A system component that rendering needs (LLVM, a Mitsuba variant, CUDA) is missing or
    unfit."""


class GradientError(CodesignError, RuntimeError):
    """A derivative was asked for that the backend cannot give (for example a second derivative)."""


class NonFiniteError(CodesignError, ArithmeticError):
    """A value or gradient became infinite or NaN; the message names the junction where it
    appeared."""


def shown(value: Any) -> str:
    """A wrong value in one short line of a message: shape and type of what has them, the kind of
    what is long."""
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if shape is not None and dtype is not None:
        where = "" if str(getattr(value, "device", "cpu")) == "cpu" else f" on {value.device}"
        return f"{type(value).__name__} {list(shape)} {str(dtype).removeprefix('torch.')}{where}"
    plain = value is None or isinstance(
        value, (str, bytes, int, float, complex, list, tuple, dict, PurePath)
    )
    return " ".join(repr(value).split())[:80] if plain else f"a {type(value).__name__}"


@contextmanager
def searching() -> Iterator[None]:
    """Within it, in this thread alone, rays may be looked for where no light passes."""
    before = _searched.set(True)
    try:
        yield
    finally:
        _searched.reset(before)


def is_searched() -> bool:
    """Whether a search asks."""
    return _searched.get()
