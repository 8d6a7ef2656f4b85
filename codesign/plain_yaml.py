"""A small part of YAML that is data and nothing else: nested mappings, and values in the notation of JSON.

    rotation:
      x: 0.5          # two spaces a level; a comment stands alone or after two spaces
      axes: [0, 1]
      name: "optical"

Any YAML reader (PyYAML's safe_load, yaml-cpp, ROS's parameter files) takes what is written here for the same values,
and floats come back to the last bit. Tags, anchors, aliases and multi-line values are refused when read, so a file can
make no object and run nothing; that is why no YAML package is asked for.
"""

import json
import math
import re
from collections.abc import Mapping
from typing import Any

from codesign.errors import DomainError, FileFormatError

INDENT = 2
MOST_LINES = 10_000
DEEPEST = 20  # levels
KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,99}")
WORD = re.compile(r"(\.{0,2}/)*[A-Za-z_][A-Za-z0-9_/.-]*")  # text that needs no quotes
OTHERS = re.compile(
    "y|n|yes|no|on|off|true|false|null|nan|inf|infinity", re.IGNORECASE
)  # values to some readers


def dump(page: Mapping[str, Any], comment: str = "") -> str:
    """Text of nested mappings of numbers, text, booleans, None, and lists of these.

    Args: comment: lines for the top of the file.
    Raises: DomainError for keys that are not plain words, values that are not finite, or of other kinds.

    >>> print(dump({"pose": {"z": 0.25, "tiny": 1e-7, "frame": "base_link"}, "box": [0.1, 2]}), end="")
    pose:
      z: 0.25
      tiny: 1.0e-07
      frame: "base_link"
    box: [0.1, 2]
    """
    head = [f"# {line}".rstrip() for line in comment.splitlines()]
    return "\n".join([*head, *_lines(page, 0)]) + "\n"


def _lines(page, level):
    found = []
    for key, value in page.items():
        if not KEY.fullmatch(key):
            raise DomainError(f"yaml: the key {key!r} is not a plain word; use letters, digits and _.")
        if isinstance(value, Mapping):
            found += [" " * INDENT * level + f"{key}:", *_lines(value, level + 1)]
            if not value:
                raise DomainError(f"yaml: the mapping '{key}' is empty; leave it out.")
        else:
            found.append(" " * INDENT * level + f"{key}: {_text(key, value)}")
    return found


def _text(key, value):
    if isinstance(value, list | tuple):
        return f"[{', '.join(_text(key, each) for each in value)}]"
    if isinstance(value, float):
        if not math.isfinite(value):
            raise DomainError(f"yaml: '{key}' is {value}; a finite number is needed.")
        # YAML 1.1 takes 1e-07 for text: it wants a point
        return re.sub(r"^(-?\d+)e", r"\1.0e", repr(value))
    if value is None or isinstance(value, bool | int | str):
        return json.dumps(value)
    raise DomainError(
        f"yaml: '{key}' is a {type(value).__name__}; numbers, text, lists and mappings are written."
    )


def load(text: str) -> dict[str, Any]:
    """Nested dictionaries of what ``dump`` wrote; hand-made files may leave the quotes of plain words.

    Raises: FileFormatError naming the line that is not of this part of YAML.

    >>> load("pose:\\n  z: 0.25\\n  frame: base_link  # where it is screwed on")
    {'pose': {'z': 0.25, 'frame': 'base_link'}}
    """
    top: dict[str, Any] = {}
    open_pages = [top]
    awaited = False
    lines = text.splitlines()
    if len(lines) > MOST_LINES:
        raise FileFormatError(f"yaml: {len(lines)} lines; at most {MOST_LINES} are read.")
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        body = line.lstrip(" ")
        level, odd = divmod(len(line) - len(body), INDENT)
        key, colon, value = body.partition(":")
        deepest = len(open_pages) - 1
        if odd or level > min(deepest, DEEPEST) or (awaited and level != deepest):
            raise _bad(number, line, "indent by two spaces a level, below a key that ends with a colon")
        if not KEY.fullmatch(key) or not colon or (value and not value.startswith(" ")):
            raise _bad(number, line, "write 'key: value', the key in letters, digits and _")
        del open_pages[level + 1 :]
        if key in open_pages[level]:
            raise _bad(number, line, f"'{key}' stands there twice; leave one")
        value = value.strip()
        awaited = not value or value.startswith("#")
        open_pages[level][key] = {} if awaited else _value(value, number, line)
        if awaited:
            open_pages.append(open_pages[level][key])
    if awaited:
        raise FileFormatError(f"yaml: the last key of the file has no value; give one (line {len(lines)}).")
    return top


def _value(text, number, line):
    try:
        value, end = json.JSONDecoder(parse_constant=_refused, parse_float=_finite).raw_decode(text)
    except (ValueError, RecursionError):
        word = text.split(" #")[0].strip()
        if WORD.fullmatch(word) and not OTHERS.fullmatch(word):
            return word
        if word.startswith("[") and word.endswith("]") and "[" not in word[1:]:
            return [_value(each.strip(), number, line) for each in word[1:-1].split(",")]
        raise _bad(number, line, 'give a number, "text", true, false, null or a [list] of these') from None
    rest = text[end:].strip()
    if (rest and not rest.startswith("#")) or isinstance(value, dict):
        raise _bad(number, line, "give one value in a line, mappings over several")
    return value


def _refused(name):
    raise ValueError(name)


def _finite(text):
    return float(text) if math.isfinite(float(text)) else _refused(text)


def _bad(number, line, remedy):
    return FileFormatError(f"yaml, line {number} ({line.strip()[:60]!r}): {remedy}.")
