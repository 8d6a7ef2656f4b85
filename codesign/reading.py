"""The frame around every reader: which file is opened, how much of it is read, and what a failure
inside means.

A reader opens its file here, says from the header how much it is about to hold, and puts whatever
it leaves to a library into ``reading``: no list of the errors of libraries stands anywhere else.
"""

import json
import math
import os
import re
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, BinaryIO

from codesign.errors import CodesignError, DomainError, FileFormatError, ShapeError

MOST_SAID = 600  # characters of a sentence
SOURCE = re.compile(r"\[\w+\.cpp:\d+\]")  # places in a library's own source, in its words
MOST_BYTES = 2**33  # of an array that a header announces; larger ones are read in pieces


@contextmanager
def reading(
    what: str | Path,
    remedy: str = "it is damaged, or of another kind",
    kind: type[CodesignError] = FileFormatError,
) -> Iterator[None]:
    """Turn whatever a library raises for bytes it did not expect into one sentence.

    Args:
      what: file, or part of one, that the sentence begins with.
      remedy: what it ends with.
      kind: of the error.
    Raises: FileFormatError, or ``kind``; errors of ours pass unchanged, and so does Ctrl-C.
    """
    try:
        yield
    except CodesignError:
        raise
    except Exception as error:  # what libraries raise for damaged bytes has no common root
        said = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        said = " ".join(SOURCE.sub("", said).split())[:200] or type(error).__name__
        raise kind(f"{what} cannot be read ({said}); {remedy}.") from error


@contextmanager
def building(
    what: str | Path,
    remedy: str = "it is damaged, or of another version",
) -> Iterator[None]:
    """As ``reading``, around classes that are made of a file's values: their refusals name the file
    too."""
    try:
        with reading(what, remedy):
            yield
    except (DomainError, ShapeError, FileFormatError) as error:
        said = " ".join(str(error).split())
        said = said if len(said) < MOST_SAID else f"{said[:MOST_SAID]} …"
        raise FileFormatError(said if said.startswith(str(what)) else f"{what}: {said}") from error


_OPENED: ContextVar[dict[Path, None] | None] = ContextVar("opened", default=None)


@contextmanager
def noting() -> Iterator[dict[Path, None]]:
    """The files that readers open within, each once, in order."""
    found: dict[Path, None] = {}
    token = _OPENED.set(found)
    try:
        yield found
    finally:
        _OPENED.reset(token)
        note(found)


def note(paths: Iterable[Path]) -> None:
    """Files that something else than our readers opens."""
    if (opened := _OPENED.get()) is not None:
        opened.update(dict.fromkeys(paths))


def open_regular(path: str | Path, most_bytes: int | None = None) -> BinaryIO:
    """Open a regular file for reading bytes.

    Args:
      most_bytes: refuse a longer one.
    Raises: FileFormatError where there is none, where it may not be read, where it is a folder, a
      pipe (which is not waited for) or a device, or where it is too long.
    """
    try:
        file = open(path, "rb", opener=_without_waiting)  # noqa: SIM115 - handed to the caller
    except FileNotFoundError:
        raise FileFormatError(f"no file lies at {path}; check the path.") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        said = error.strerror if isinstance(error, OSError) else error
        raise FileFormatError(
            f"{path} cannot be read ({said}); give a file you may read."
        ) from error
    note([Path(path)])
    length = os.fstat(file.fileno()).st_size
    if most_bytes is not None and length > most_bytes:
        file.close()
        raise FileFormatError(
            f"{path} has {length} bytes, more than the {most_bytes} of its kind; is it another file?"
        )
    return file


def check_regular(path: str | Path, most_bytes: int | None = None) -> Path:
    """The path, for a library that opens files itself. Raises: FileFormatError, as
    ``open_regular``."""
    open_regular(path, most_bytes).close()
    return Path(path)


def read_bytes(path: str | Path, most_bytes: int) -> bytes:
    """The content of a regular file of at most so many bytes. Raises: FileFormatError, as
    ``open_regular``."""
    with open_regular(path, most_bytes) as file, reading(path, "check the disk"):
        return file.read()


def read_json(path: str | Path, most_bytes: int = 50_000_000) -> Any:
    """What a file of JSON in UTF-8 holds. Raises: FileFormatError where it is none, or nested
    without end."""
    text = read_text(path, most_bytes)
    with reading(path, "it is no whole JSON file"):
        return json.loads(text, parse_constant=_number, parse_float=_number)


def read_text(path: str | Path, most_bytes: int = 50_000_000) -> str:
    """The text of a regular file in UTF-8, without a byte order mark. Raises: FileFormatError, as
    ``open_regular``, and where it is no text."""
    content = read_bytes(path, most_bytes)
    with reading(path, "it is no text in UTF-8"):
        return content.decode("utf-8-sig").replace("\r\n", "\n")


def check_room(
    what: str | Path, shape: tuple[int, ...], item_bytes: int, most_bytes: int = MOST_BYTES
) -> None:
    """Refuse a header that announces more than anyone means, before anything is made of it. Raises:
    FileFormatError."""
    if any(size < 0 for size in shape) or math.prod(shape) * item_bytes > most_bytes:
        raise FileFormatError(
            f"{what} announces {' x '.join(map(str, shape))} values of {item_bytes} bytes, more than the {most_bytes} "
            "bytes that are read at once; it is damaged."
        )


def _number(text):
    if not math.isfinite(value := float(text)):
        raise ValueError(f"{text[:20]} is no finite number")
    return value


def _without_waiting(path: str, flags: int) -> int:
    handle = os.open(path, flags | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise FileFormatError(f"{path} is not a regular file; give a file.")
    return handle
