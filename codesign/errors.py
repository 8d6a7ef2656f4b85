"""One small family of exceptions. Every message says what was given, what is allowed, and what to do."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # sentences cost no import of torch
    from torch import Tensor


class CodesignError(Exception):
    """Anything the user can mend. Commands print the message alone and exit with code 2."""


class ShapeError(CodesignError, ValueError):
    """A tensor has the wrong number of axes or the wrong size along one."""


class DomainError(CodesignError, ValueError):
    """A value lies outside what the formula or the hardware allows (NaN included)."""


class FileFormatError(CodesignError, ValueError):
    """A file is missing, malformed, or of a kind this function does not read."""


class MissingPackageError(CodesignError, ImportError):
    """A package that the core does without is not installed; the message names the extra that brings it."""


class BackendError(CodesignError, RuntimeError):
    """A system component that rendering needs (LLVM, a Mitsuba variant, CUDA) is missing or unfit."""


class GradientError(CodesignError, RuntimeError):
    """A derivative was asked for that the backend cannot give (for example a second derivative)."""


class NonFiniteError(CodesignError, ArithmeticError):
    """A value or gradient became infinite or NaN; the message names the junction where it appeared."""


def shown(value: Any) -> str:
    """A wrong value in one short line of a message."""
    return " ".join(repr(value).split())[:80]


def as_number(value: Any, name: str) -> float:
    """A real number as a float, NaN and infinity too; DomainError for text, lists, complex numbers, None."""
    try:
        if isinstance(value, str):
            raise TypeError
        return float(value)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise DomainError(f"{name} = {shown(value)} is no number; give one.") from None


def check_whole(value: Any, name: str) -> int:
    """A whole number of at least 1 as an int; DomainError for anything else."""
    number = as_number(value, name)
    if not (1 <= number < float("inf") and number % 1 == 0):
        raise DomainError(f"{name} = {value} must be a whole number of at least 1.")
    return int(value)


def check_seed(value: Any, name: str, bits: int = 63) -> int:
    """A seed as an int, whole and below 2 ** bits in size; DomainError for anything else."""
    number = as_number(value, name)
    if not (abs(number) < 2**bits and number % 1 == 0):
        raise DomainError(f"{name} = {value} must be a whole number between -2^{bits} and 2^{bits}.")
    return int(value)


def check_finite(
    tensor: "Tensor", name: str, remedy: str = "remove or repair the non-finite entries"
) -> "Tensor":
    """Raise DomainError when ``tensor`` holds NaN or infinity; return it unchanged otherwise."""
    if bool(tensor.detach().sum().isfinite()):  # one pass, and no finite entry can hide another that is not
        return tensor
    finite = tensor.detach().isfinite()
    if not bool(finite.all()):
        bad = int((~finite).sum())
        first = (~finite).nonzero()[0].tolist()
        raise DomainError(
            f"{name}: {bad} of {finite.numel()} values are NaN or infinite (first at index {first}); "
            f"{remedy}."
        )
    return tensor
