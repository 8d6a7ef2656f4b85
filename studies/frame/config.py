"""The configuration every study shares, and its round trip through config.json."""

import dataclasses
import json
import math
import types
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

from codesign.errors import DomainError, FileFormatError


@dataclass(frozen=True)
class StudyConfig:
    """What every study can be told."""

    quick: bool = False
    """Smaller and shorter: shows that everything works, not the best result."""
    out: Path | None = None
    """Folder for the results; runs/<study>/<time> when left out."""
    seed: int = 0
    """Seed of everything random in the run."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; auto takes CUDA when there is one."""
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
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        owner = stored.pop("study")
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        raise FileFormatError(
            f"'{path.parent}' is not a run that can be resumed (its config.json is missing or malformed); "
            "give the folder of an interrupted run."
        ) from error
    if owner != study:
        raise FileFormatError(
            f"'{path.parent}' is a run of the study '{owner}', not of '{study}'; resume it with 'python -m "
            f"studies.{owner} --resume {path.parent}'."
        )
    known = {field.name for field in dataclasses.fields(kind)}
    if known != set(stored):
        raise FileFormatError(
            f"'{path}' was written by another version of this study (fields that differ: "
            f"{', '.join(sorted(known ^ set(stored)))}); start a new run."
        )
    hints = typing.get_type_hints(kind)
    return kind(**{name: _typed(value, hints[name]) for name, value in stored.items()})


def check_same(stored: StudyConfig, given: StudyConfig):
    """Raise DomainError when an option given beside --resume differs from the stored run: it would have no
    effect."""
    for field in dataclasses.fields(given):
        value = getattr(given, field.name)
        earlier = getattr(stored, field.name)
        if field.name != "resume" and value not in (field.default, earlier):
            option = "--" + field.name.replace("_", "-")
            raise DomainError(
                f"{option} is {value}, but the run to resume was started with {earlier}; leave {option} "
                "out, or start a new run."
            )


def _plain(name, value) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        raise DomainError(f"option --{name.replace('_', '-')} is {value}; give a finite number.")
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


def _typed(value, hint) -> Any:
    kinds = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)
    if isinstance(value, str) and Path in kinds:
        return Path(value)
    if isinstance(value, list):
        entry = next((typing.get_args(kind)[0] for kind in kinds if typing.get_args(kind)), object)
        return tuple(_typed(each, entry) for each in value)
    return value
