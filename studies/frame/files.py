"""Files that a run is given: one that goes on has to be of the same."""

import dataclasses
import hashlib
from collections.abc import Iterable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from codesign.errors import DomainError
from codesign.reading import reading
from studies.frame.config import StudyConfig

BEGINNING = 1 << 16  # bytes that are read of each file of a folder


def digest(content: bytes | BinaryIO) -> str:
    """Of bytes, or of an open file, which is read piece by piece."""
    content = BytesIO(content) if isinstance(content, bytes) else content
    return hashlib.file_digest(content, "sha256").hexdigest()[:12]


def digests(paths: Iterable[Path], but: Path | None = None) -> dict[str, str]:
    """Name -> digest of the files among some paths, and of names, sizes and beginnings of what lies
    in folders, less what lies in ``but``."""
    found, own = {}, but and but.resolve()
    for path in paths:
        if path.is_file():
            with path.open("rb") as content:
                found[f"'{path}'"] = digest(content)
        elif path.is_dir():
            inside = sorted(
                each
                for each in path.resolve().rglob("*")
                if each.is_file() and own not in each.parents
            )
            told = b"".join(map(_beginning, inside))
            found[f"what lies in '{path}'"] = digest(told)
    return found


def _beginning(path):
    with reading(path), path.open("rb") as content:
        begins = content.read(BEGINNING)
    return digest(f"{path.name} {path.stat().st_size} ".encode() + begins).encode()


def given(config: StudyConfig) -> list[Path]:
    """The paths among a study's options, but for those that may change."""
    found = []
    for field in dataclasses.fields(config):
        if field.name not in ("out", "resume", *config.ANEW):
            value = getattr(config, field.name)
            values = value if isinstance(value, tuple) else (value,)
            found += [Path(each) for each in values if each and isinstance(each, str | Path)]
    return found


def check_same(stored: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise DomainError where a run that goes on is not the one that was begun."""
    for name in (*stored, *now):
        if stored.get(name) != now.get(name):
            was, is_now = stored.get(name, "not there"), now.get(name, "not there")
            raise DomainError(
                f"{name} changed since this run was begun ({was}, now {is_now}); what it has found holds no more: "
                "change it back, or start a new run."
            )
