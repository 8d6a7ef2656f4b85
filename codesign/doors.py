"""What a public function says when it fails for what it was given: which argument, what it was,
what is needed.

Values are checked where the formula needs it; that a number is not NaN, at every door. That text,
None or a list stands where a tensor belongs is checked nowhere: when a call fails in Python, torch
or NumPy, its arguments are held against the annotations, and the caller reads a sentence. A call
that succeeds costs less than a microsecond more.
"""

import functools
import inspect
import math
import numbers
import os
import re
import sysconfig
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from os import PathLike
from pathlib import Path
from typing import Any, NoReturn, ParamSpec, TypeVar

from codesign import shipped
from codesign.errors import CodesignError, DomainError, ShapeError, shown

P = ParamSpec("P")
T = TypeVar("T")
HOME = str(Path(__file__).parent) + os.sep
# packages that have doors
PACKAGES = ("codesign.", "scenes.")
OURS = (HOME, str(shipped.FOLDER / "scenes") + os.sep)
LIBRARIES = (
    sysconfig.get_path("stdlib"),
    sysconfig.get_path("purelib"),
    sysconfig.get_path("platlib"),
    "<",
)
FAILS = (ArithmeticError, AttributeError, LookupError, OSError, RuntimeError, TypeError, ValueError)
# what torch and NumPy say of tensors that do not fit
UNFIT = re.compile(
    "shape|size|dimension|dtype|device|broadcast|meta|layout|sparse|complex|scalar|one element|out of range|index|linalg"
    "|too large|must match|must be|not supported|operand|0-d|determinant|null byte|assignment failed|cannot be converted"
    "|overflow|division|negative|NaN|infinit|expected|invalid combination|invalid data type"
    "|Long|Half|Double|Float|not implemented for",
    re.IGNORECASE,
)
# classes that have doors, for annotations whose names are imported only when types are checked
KINDS: dict[str, type] = {}
PLAIN: dict[Any, tuple[tuple[type, ...], str]] = {
    float: ((numbers.Real,), "a number"),
    int: ((numbers.Integral,), "a whole number"),
    bool: ((bool,), "True or False"),
    complex: ((numbers.Number,), "a number"),
    Path: ((str, PathLike), "a path"),
}


def explain(room: dict[str, Any]) -> None:
    """Put doors into the public functions and classes of a room: ``explain(globals())`` is its last
    line."""
    home = room["__name__"]
    for name in public_names(room):
        public = room[name]
        if inspect.isclass(public):
            for base in public.__mro__:
                if base.__module__.startswith(PACKAGES) and "__explained__" not in vars(base):
                    _class(base)
        elif isinstance(public, types.FunctionType) and not hasattr(public, "__explained__"):
            room[name] = door(public, f"{home.removeprefix('codesign.')}.{name}")
            room[name].__module__ = home  # where a pickle finds it


def public_names(room: Mapping[str, Any]) -> list[str]:
    """What ``__all__`` of a module's names says, or what it defines itself without an
    underscore."""
    home = room["__name__"]
    own = (
        name
        for name, made in room.items()
        if name[0] != "_" and getattr(made, "__module__", "") == home
    )
    return list(room.get("__all__", own))


def _class(kind):
    if issubclass(kind, BaseException) or getattr(kind, "_is_protocol", False):
        return
    kind.__explained__ = True
    KINDS[kind.__name__] = kind
    for name, made in list(vars(kind).items()):
        if not name.startswith("_") or name in ("__init__", "__call__"):
            inner = made.__func__ if isinstance(made, (staticmethod, classmethod)) else made
            if isinstance(inner, types.FunctionType):
                full = kind.__name__ if name == "__init__" else f"{kind.__name__}.{name}"
                # results that are held may be NaN
                told = door(inner, full, nan_fits=name == "__init__")
                setattr(kind, name, told if inner is made else type(made)(told))


def door(function: Callable[P, T], name: str, nan_fits: bool = False) -> Callable[P, T]:
    """``function``, whose failures for what it was given are sentences.

    Raises: ShapeError or DomainError from the error of torch, NumPy or Python; other errors as they
      are: those of functions of the caller's own, and those that no argument explains.
    """

    def explained(error, args, kwargs) -> NoReturn:
        sentence = _sentence(function, name, args, kwargs, error)
        if sentence is None:
            raise error
        raise sentence from error

    def later(values, args, kwargs):
        try:
            yield from values
        except FAILS as error:
            explained(error, args, kwargs)

    @functools.wraps(function)
    def told(*args: P.args, **kwargs: P.kwargs) -> Any:
        try:
            result = function(*args, **kwargs)
        except FAILS as error:
            explained(error, args, kwargs)
        for value in () if nan_fits else (*args, *kwargs.values()):
            if value.__class__ is float and value != value:
                given = _listed(_given(function, args, kwargs) or {})
                raise DomainError(
                    f"{name}: an argument is NaN, which is no number; give one ({given})."
                )
        return later(result, args, kwargs) if isinstance(result, types.GeneratorType) else result

    told.__explained__ = True  # pyright: ignore
    return told


def _sentence(function, name, args, kwargs, error):
    if isinstance(error, CodesignError) or not is_ours(error.__traceback__):
        return None
    given = _given(function, args, kwargs)
    if given is None:
        return None
    hints = _hints(function)
    said = " ".join(str(error).split())
    for argument, value in given.items():
        needed = mismatch(value, hints.get(argument, Any))
        if needed:
            return DomainError(f"{name}: {argument} = {shown(value)}, but {needed} is needed.")
    for argument, value in given.items():
        if isinstance(value, float) and not math.isfinite(value):
            return DomainError(f"{name}: {argument} = {value}, but a finite number is needed.")
    for argument, value in given.items():
        parts = value if isinstance(value, (list, tuple)) else ()
        blamed = {f"{type(each).__name__}' object" for each in (value, *parts)}
        if isinstance(error, (AttributeError, TypeError)) and any(
            words in said for words in blamed
        ):
            return DomainError(f"{name}: {argument} = {shown(value)} does not fit ({said}).")
        name_of = f"has no attribute '{value}'" if isinstance(value, str) else None
        unknown = (
            name_of is not None and isinstance(error, AttributeError) and name_of in str(error)
        )
        if unknown or (isinstance(error, KeyError) and error.args[0] is value):
            return DomainError(f"{name}: {argument} = {shown(value)} is not known.")
    if isinstance(error, (AttributeError, OSError, KeyError)) or not UNFIT.search(said):
        return None
    what = _listed(given)
    kind = ShapeError if re.search("shape|size|dimension|index|broadcast", said) else DomainError
    return kind(
        f"{name} cannot work with {what}: {said[:200]} (its help says which shapes and values fit)."
    )


def _given(function, args, kwargs):
    """{argument: value}; None where Python's own sentence says what is wrong: too many, too few,
    unknown names."""
    try:
        given = inspect.signature(function).bind(*args, **kwargs).arguments
    except TypeError:
        return None
    return {argument: value for argument, value in given.items() if argument not in ("self", "cls")}


def _listed(given):
    return ", ".join(f"{argument} = {shown(value)}" for argument, value in given.items())


def is_ours(trace: types.TracebackType | None) -> bool:
    """Whether the last function that is no library's is one of ours, and no callback of the
    caller's."""
    last = ""
    while trace is not None:
        file = trace.tb_frame.f_code.co_filename
        library = file.startswith(LIBRARIES) or file.endswith(".pyx")
        # ours may be installed among libraries
        if file.startswith(OURS) or not library:
            last = file
        trace = trace.tb_next
    return last.startswith(OURS)


@functools.cache
def _hints(function):
    hints = {}
    for argument, hint in function.__annotations__.items():
        try:
            hints[argument] = (
                eval(hint, function.__globals__, KINDS) if isinstance(hint, str) else hint
            )
        except (NameError, TypeError):
            hints[argument] = Any  # a name that stands under TYPE_CHECKING alone
    return hints


def mismatch(value: Any, hint: Any) -> str:
    """What ``hint`` asks for where ``value`` is nothing of the kind; empty where it is, or where
    that is not known."""
    if hint is Any:
        return ""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return mismatch(value, parts[0])
    if origin in (typing.Union, types.UnionType):
        needs = [mismatch(value, part) for part in parts]
        return "" if "" in needs else " or ".join(dict.fromkeys(needs))
    if hint is None or hint is types.NoneType:
        return "" if value is None else "None"
    if origin is typing.Literal:
        return "" if value in parts else " or ".join(map(repr, parts))
    if hint in PLAIN:
        kinds, words = PLAIN[hint]
        number = getattr(value, "ndim", None) == 0 and hint in (float, int)
        return "" if number or isinstance(value, kinds) else words
    if origin is Callable or hint is Callable:
        return "" if callable(value) else "a function"
    kind = origin or hint
    if getattr(kind, "_is_protocol", False):
        lacks = [each for each in _asked(kind) if not hasattr(value, each)]
        return f"a {kind.__name__} (which has {', '.join(lacks[:4])})" if lacks else ""
    if not isinstance(kind, type):
        return ""
    text = isinstance(value, (str, bytes)) and kind is not str
    if (text and issubclass(kind, Iterable)) or not isinstance(value, kind):
        return f"a {kind.__name__}" if kind.__module__ != "torch" else f"a torch.{kind.__name__}"
    if parts and issubclass(kind, Mapping) and len(parts) == 2:
        return _within(value.values(), parts[1], kind)
    if (
        parts
        and issubclass(kind, Iterable)
        and isinstance(value, (list, tuple))
        and kind is not tuple
    ):
        return _within(value, parts[0], kind)
    return ""


def _asked(protocol):
    parts = [part for part in protocol.__mro__ if getattr(part, "_is_protocol", False)]
    names = {
        name for part in parts for name in (*vars(part), *vars(part).get("__annotations__", {}))
    }
    return sorted(name for name in names if not name.startswith("_"))


def _within(values, hint, kind):
    needs = (mismatch(each, hint) for each in values)
    needed = next(filter(None, needs), "")
    return f"a {kind.__name__} of which each is {needed}" if needed else ""
