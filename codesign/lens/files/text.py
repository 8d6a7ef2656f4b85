"""The text of a lens file, and the numbers in it, read within bounds whatever the file holds; and
tables that say what each keyword of a file sets, or why it is refused."""

import codecs
import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codesign.errors import CodesignError, FileFormatError
from codesign.reading import read_bytes

LARGEST_BYTES = 2_000_000
MOST_SURFACES = 500
MOST_LINES = 50_000
NUMBER = re.compile(r"[+-]?(\d{1,40}\.?\d{0,40}|\.\d{1,40})([eE][+-]?\d{1,4})?", re.ASCII)
CONTROL = re.compile(r"[\x00-\x08\x0b\x0e-\x1f\x7f]")


def read_text(path: str | Path) -> str:
    """The text of a file in UTF-8, UTF-16 (either byte order) or Latin-1, of at most LARGEST_BYTES.

    Raises: FileFormatError for what is not a regular file (a pipe is not waited for), is too long,
      or is not text.
    """
    content = read_bytes(path, LARGEST_BYTES)
    try:
        text = content.decode(_encoding(content))
    except UnicodeDecodeError as error:
        raise FileFormatError(
            f"it is not text ({error.encoding} fails at byte {error.start}); save it as UTF-8."
        ) from error
    text = text.removeprefix("\ufeff").rstrip("\x1a")
    if max(text.count("\n"), text.count("\r")) > MOST_LINES:
        raise FileFormatError(
            f"it has more than {MOST_LINES} lines, which no lens needs; is it a lens file?"
        )
    strange = CONTROL.search(text)
    if strange:
        raise FileFormatError(
            f"it is not text (control character {ord(strange[0])} at position {strange.start()}); save it "
            "as UTF-8."
        )
    return text


def _encoding(content):
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    if b"\x00" in content[:2]:
        return "utf-16-be" if content[:1] == b"\x00" else "utf-16-le"
    try:
        content.decode("utf-8")
        return "utf-8"
    except UnicodeDecodeError:
        return "latin-1"


def lines(text: str) -> Iterator[tuple[int, str]]:
    """The lines of a text, with their numbers from 1."""
    return enumerate(re.split(r"\r\n|\r|\n", text), 1)


def number(word: str, what: str) -> float:
    """The finite number a word spells. Raises: FileFormatError naming what it stands for."""
    value = float(word) if NUMBER.fullmatch(word) else math.nan
    if not math.isfinite(value):
        raise FileFormatError(f"{what} is '{shown(word)}', a finite number is needed; correct it.")
    return value


def whole(word: str, what: str, most: int = 10_000) -> int:
    """The whole number from 0 to ``most`` a word spells."""
    if not re.fullmatch(r"\d{1,6}", word, re.ASCII) or int(word) > most:
        raise FileFormatError(
            f"{what} is '{shown(word)}', a whole number from 0 to {most} is needed; correct it."
        )
    return int(word)


def shown(value: object) -> str:
    """A value of a file as it may stand in a sentence: short, on one line."""
    return "".join(c if c.isprintable() else "?" for c in " ".join(str(value)[:60].split())[:40])


def title(value: object, otherwise: str) -> str:
    """A name on one line of at most 80 printable characters; ``otherwise`` where there is none."""
    return (
        "".join(c for c in " ".join(str(value).split()) if c.isprintable())[:80].strip()
        or otherwise
    )


@contextmanager
def at(place: str) -> Iterator[None]:
    """Put the place in front of the sentence of any error of the block."""
    try:
        yield
    except CodesignError as error:
        said = str(error).removeprefix(f"{place.split()[-1]} ")  # that names the file itself
        raise type(error)(f"{place}: {said}") from error


@dataclass(frozen=True)
class Rule:
    """A keyword sets the value of this name to ``make(keyword, words behind it)``; dictionaries add
    up.

    least: how many words must stand behind it.
    """

    sets: str
    make: Callable[[str, list[str]], Any]
    least: int = 1


# a keyword's rule, or the sentence that refuses it; the empty one is of what changes no ray and is
# passed over
Table = Mapping[str, Rule | str]
IDLE = ""


def take(values: dict[str, Any], table: Table, keyword: str, words: list[str]) -> None:
    """Set what a keyword of the table sets. Raises: FileFormatError where it is refused or has no
    value."""
    rule = table[keyword]
    if isinstance(rule, str):
        if rule != IDLE:
            raise FileFormatError(rule)
        return
    if len(words) < rule.least:
        raise FileFormatError(f"{keyword} has no value; give one.")
    value = rule.make(keyword, words)
    values[rule.sets] = values.get(rule.sets, {}) | value if isinstance(value, dict) else value


def all_words(keyword: str, words: list[str]) -> list[str]:
    return words


def yes(keyword: str, words: list[str]) -> bool:
    return True


def one_number(keyword: str, words: list[str]) -> float:
    return number(words[0], keyword)


def all_numbers(keyword: str, words: list[str]) -> list[float]:
    return [number(word, keyword) for word in words]


def one_whole(keyword: str, words: list[str]) -> int:
    return whole(words[0], keyword)
