"""Lens files of keywords: tables that say what each keyword sets, or why it is refused."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from codesign.errors import FileFormatError
from codesign.lens.files.text import number, whole


@dataclass(frozen=True)
class Rule:
    """A keyword sets the value of this name to ``make(keyword, words behind it)``; dictionaries add up.

    least: how many words must stand behind it.
    """

    sets: str
    make: Callable[[str, list[str]], Any]
    least: int = 1


# a keyword's rule, or the sentence that refuses it; the empty one is of what changes no ray and is passed over
Table = Mapping[str, Rule | str]
IDLE = ""


def take(values: dict[str, Any], table: Table, keyword: str, words: list[str]) -> None:
    """Set what a keyword of the table sets. Raises: FileFormatError where it is refused or has no value."""
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
