"""JSON pages of lens files: parsed strictly, and looked into with sentences that name the key."""

import json
import math
from collections.abc import Container
from typing import Any

from codesign.errors import FileFormatError
from codesign.lens.files.text import MOST_SURFACES, shown

Page = dict[str, Any]

DEEPEST = 30
MOST_NUMBERS = 16


def parse(text: str) -> Any:
    """The object a JSON text holds. Raises: FileFormatError when it is not JSON, nests deeper than
    30, or has a key twice."""
    try:
        page = json.loads(text, object_pairs_hook=_once)
    except (ValueError, RecursionError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(
            f"it is not readable JSON ({shown(error)}); write it again with lens.save."
        ) from error
    if _depth(page) > DEEPEST:
        raise FileFormatError(f"it nests deeper than {DEEPEST} levels; is it a lens file?")
    return page


def _once(pairs):
    found = {}
    for key, value in pairs:
        if key in found:
            raise FileFormatError(f"the key '{shown(key)}' comes twice in one object; keep one.")
        found[key] = value
    return found


def _depth(page):
    depth = 0
    level = [page]
    while level and depth <= DEEPEST:
        depth += 1
        level = [
            v
            for node in level
            if isinstance(node, (dict, list))
            for v in (node.values() if isinstance(node, dict) else node)
        ]
    return depth


def number(row: Page, key: str, default: float | None = None, infinite: bool = False) -> float:
    """The number under a key, finite unless ``infinite``. Raises: FileFormatError when it is
    missing, of another kind, or not finite."""
    if key not in row and default is not None:
        return default
    value = present(row, key)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise FileFormatError(f"{key} is {shown(value)!r}, a number is needed; correct it.")
    try:
        value = float(value)
    except OverflowError:
        value = math.nan
    if math.isnan(value) or (math.isinf(value) and not infinite):
        raise FileFormatError(f"{key} is {shown(row[key])}, a finite number is needed; correct it.")
    return value


def present(row: Page, key: str) -> Any:
    if key not in row:
        raise FileFormatError(f"the field '{key}' is missing; add it.")
    return row[key]


def boolean(row: Page, key: str) -> bool:
    """The truth under a key, false when it is missing or null."""
    value = row.get(key)
    if value is not None and not isinstance(value, bool):
        raise FileFormatError(f"{key} is {shown(value)!r}, true or false is needed; correct it.")
    return bool(value)


def numbers(row: Page, key: str) -> tuple[float, ...]:
    """The list of at most MOST_NUMBERS finite numbers under a key, empty when it is missing or
    null."""
    value = row.get(key)
    value = [] if value is None else value
    if not isinstance(value, list) or len(value) > MOST_NUMBERS:
        raise FileFormatError(
            f"{key} is {shown(value)}, a list of at most {MOST_NUMBERS} numbers is needed; correct it."
        )
    return tuple(number({key: v}, key) for v in value)


def entry(row: Page, key: str) -> Page:
    """The object under a key."""
    value = present(row, key)
    if not isinstance(value, dict):
        raise FileFormatError(f"{key} is {shown(value)!r}, an object is needed; correct it.")
    return value


def rows(page: Page, key: str, first: int = 1) -> list[Page]:
    """The list of 1 to MOST_SURFACES objects, surfaces numbered from ``first``, under a key."""
    value = page.get(key)
    if not isinstance(value, list) or not 0 < len(value) <= MOST_SURFACES:
        raise FileFormatError(
            f'"{key}" must be a list of 1 to {MOST_SURFACES} surfaces; add at least one.'
        )
    for i, row in enumerate(value, first):
        if not isinstance(row, dict):
            raise FileFormatError(f"surface {i}: it is {shown(row)!r}, an object is needed.")
    return value


def only(row: Page, known: Container[str]) -> None:
    """Raise for a key that says something (not null, false, zero or empty) and is not known."""
    strange = [
        key
        for key, value in row.items()
        if key not in known and value not in (None, False, 0, "", [], {})
    ]
    if strange:
        raise FileFormatError(
            f"the field '{shown(strange[0])}' is not understood; delete it if it changes no ray."
        )
