"""The configuration every study shares, and its round trip through config.json."""

import dataclasses
import json
import math
import shlex
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

from codesign import shipped
from codesign.errors import DomainError, FileFormatError
from codesign.reading import building, read_json

UNIONS = (typing.Union, types.UnionType)


@dataclass(frozen=True)
class StudyConfig:
    """What every study can be told. A study's own dataclass adds its options, all with defaults."""

    QUICK: ClassVar[Mapping[str, Any]] = {}
    """What --quick sets those options to that were not given."""
    ANEW: ClassVar[tuple[str, ...]] = ()
    """Options that may change when a run is resumed: how it computes, not what."""
    GPU: ClassVar[bool] = False
    """Whether it computes on --device; what does not refuses another than the processor."""

    quick: bool = False
    """Smaller and shorter: shows that everything works, not the best result. Options given beside
    it count."""
    out: Path | None = None
    """Folder for the results, taken from where the command is run; runs/<study>/<time> there when
    left out."""
    seed: int = 0
    """Seed of everything random in the run."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; auto takes CUDA where there is one and the study can use it."""
    resume: Path | None = None
    """Folder of an interrupted run of this study, to go on with its own configuration."""


Config = TypeVar("Config", bound=StudyConfig)


def to_json(study: str, config: StudyConfig):
    """Text of config.json: the study's name and every field, flat.

    Raises: DomainError when a number is not finite.
    """
    stored = {"study": study}
    for field in dataclasses.fields(config):
        stored[field.name] = _plain(field.name, getattr(config, field.name))
    return json.dumps(stored, indent=2)


def read_config(path: Path, study: str, kind: type[Config]) -> Config:
    """Read config.json back into the study's dataclass.

    Raises: FileFormatError when it is missing, malformed, or of another study or version of it.
    """
    with building(f"'{path.parent}' is not a run that can be resumed"):
        stored = read_json(path)
    owner = stored.pop("study", None) if isinstance(stored, dict) else None
    if not isinstance(owner, str):
        raise FileFormatError(
            f"'{path}' is no configuration of a run; give the folder of an interrupted run."
        )
    if owner != study:
        raise FileFormatError(
            f"'{path.parent}' is a run of the study '{owner[:60]}', not of '{study}'; resume it with: "
            f"{resume_command(owner[:60], path.parent)}"
        )
    known = {field.name for field in dataclasses.fields(kind)}
    if known != set(stored):
        raise FileFormatError(
            f"'{path}' was written by another version of this study (fields that differ: "
            f"{', '.join(sorted(known ^ set(stored)))[:200]}); start a new run."
        )
    hints = typing.get_type_hints(kind)
    return kind(**{name: _typed(path, name, value, hints[name]) for name, value in stored.items()})


def check_least(config: StudyConfig, least: float, *names: str) -> None:
    """Raises: DomainError for the first of these options that is below ``least``."""
    for name in names:
        value = getattr(config, name)
        if value < least:
            raise DomainError(f"--{name.replace('_', '-')} is {value}; at least {least} is needed.")


def check_unused(config: StudyConfig, why: str, *names: str) -> None:
    """Raises: DomainError for the first of these options that is given where it has no effect;
    ``why`` it has none ends the sentence."""
    plain = configured(type(config), config.quick)
    for name in names:
        if getattr(config, name) != getattr(plain, name):
            raise DomainError(f"--{name.replace('_', '-')} has no effect {why}; leave it out.")


def resume_command(study: str, folder: Path) -> str:
    """The line that goes on with the run in ``folder``, fit to be pasted into a shell."""
    return f"{shipped.command(study)} --resume {shlex.quote(str(folder))}"


def configured(kind: type[Config], quick: bool, **given: Any) -> Config:
    """A study's configuration: what is given comes before what --quick sets, and that before the
    defaults."""
    return kind(quick=quick, **{**(kind.QUICK if quick else {}), **given})


def resolved(study: str, kind: type[Config], parse: Callable[[Config], Config]) -> Config:
    """The configuration that a command line asks for; beside --resume that of the stored run.

    Args:
      study, kind: the study and its dataclass.
      parse: reads the command line into a configuration, with defaults out of the one it is handed.
        What is typed and what is a default need not be told apart: the line is read again over
        other defaults.
    Raises: FileFormatError when there is no such run; DomainError when an option typed beside
      --resume is not that of the stored run, and none of ANEW: it would have no effect.
    """
    asked = parse(kind())
    if asked.resume is None:
        return parse(configured(kind, quick=True)) if asked.quick else asked
    stored = read_config(asked.resume / "config.json", study, kind)
    known = dataclasses.replace(stored, resume=asked.resume)
    again = parse(known)
    same = {"out": asked.resume, "device": "auto"}
    anew = {name: getattr(again, name) for name in kind.ANEW}
    for field in dataclasses.fields(kind):
        if field.name in anew:
            continue
        value = getattr(again, field.name)
        earlier = getattr(known, field.name)
        if value not in (earlier, same.get(field.name, earlier)):
            option = "--" + field.name.replace("_", "-")
            raise DomainError(
                f"{option} is {value}, but the run to resume was started with {earlier}; leave {option} "
                "out, or start a new run."
            )
    return dataclasses.replace(known, **anew)


def check_paths(kind: type[StudyConfig], arguments: Sequence[str]) -> None:
    """Refuse empty paths of a command line, which would stand for the present folder.

    Raises: DomainError naming the option.
    """
    hints = typing.get_type_hints(kind)
    option = ""
    for word in arguments:
        name, _, value = word.partition("=")
        if word.startswith("--"):
            option = name
        hint = hints.get(option.removeprefix("--").replace("-", "_"))
        empty = not value if word.startswith(f"{option}=") else not word
        if empty and Path in (hint, *typing.get_args(hint)):
            raise DomainError(
                f"the path of {option} is empty; give one, or leave {option} out ('.' is the present folder)."
            )


def _plain(name, value) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        raise DomainError(
            f"option --{name.replace('_', '-')} is {value}; give a finite number, or leave the option out."
        )
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, tuple):
        return [_plain(name, entry) for entry in value]
    raise TypeError(
        f"field {name} of a study's configuration is a {type(value).__name__}; use numbers, text, paths and "
        "tuples of them"
    )


def _typed(path, name, value, hint) -> Any:
    """A value of config.json as the field wants it."""
    for kind in typing.get_args(hint) if typing.get_origin(hint) in UNIONS else (hint,):
        origin, arguments = typing.get_origin(kind), typing.get_args(kind)
        if origin is Literal and value in arguments and type(value) in map(type, arguments):
            return value
        if kind is Path and isinstance(value, str):
            return Path(value)
        if kind is float and type(value) is int:
            return float(value) if abs(value) < 2**53 else value
        if origin is tuple and isinstance(value, list):
            wanted = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else arguments
            if len(wanted) == len(value):
                return tuple(_typed(path, name, *each) for each in zip(value, wanted, strict=True))
        if type(value) is kind or (kind is type(None) and value is None):
            return value
    raise FileFormatError(
        f"'{path}': {name} is {json.dumps(value)[:80]}, which is no {getattr(hint, '__name__', hint)}; it "
        "was changed or is damaged: start a new run."
    )
