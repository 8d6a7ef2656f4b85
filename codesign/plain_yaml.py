"""YAML as data: mappings, lists, text, finite numbers, booleans and null, read and written by
PyYAML.

Numbers and booleans are those of JSON (YAML 1.2), so that ``yes`` is a word and ``1e-3`` a number.
Tags, anchors and aliases are refused, so a file can make no object and unfold into no other; so are
keys that stand twice.
"""

import json
import re
from collections.abc import Mapping
from typing import Any

import yaml

from codesign.errors import DomainError, FileFormatError

MOST = 10_000  # lines, and brackets
STRING = "tag:yaml.org,2002:str"
SCALARS = {
    "bool": r"true|false",
    "null": r"null",
    "int": r"-?(0|[1-9][0-9]*)",
    "float": r"-?(0|[1-9][0-9]*)(\.[0-9]*)?([eE][-+]?[0-9]+)?",
}


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers: dict = {}  # noqa: RUF012 - PyYAML's own name

    def compose_node(self, parent, index):
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent) or event.anchor or event.tag:
            raise yaml.MarkedYAMLError(
                problem="tags, anchors and aliases are not read", problem_mark=event.start_mark
            )
        return super().compose_node(parent, index)

    def construct_mapping(self, node, deep=False):
        names = [key.value for key, _ in node.value]
        for place, (key, _) in enumerate(node.value):
            if key.value in names[:place]:
                raise yaml.MarkedYAMLError(
                    problem=f"'{key.value}' stands there twice", problem_mark=key.start_mark
                )
        found = super().construct_mapping(node, deep)
        if not all(isinstance(key, str) for key in found):
            raise yaml.MarkedYAMLError(problem="a key is no word", problem_mark=node.start_mark)
        return found


class _Dumper(yaml.SafeDumper):
    """Quotes what either kind of YAML takes for something else than text."""


_Dumper.add_representer(
    list, lambda to, row: to.represent_sequence("tag:yaml.org,2002:seq", row, flow_style=True)
)
# U+0085 is a line break to YAML: unless it is escaped it is read as a blank
_Dumper.add_representer(
    str, lambda to, text: to.represent_scalar(STRING, text, '"' * ("\x85" in text))
)
for _kind, _pattern in SCALARS.items():
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_kind}", re.compile(f"^(?:{_pattern})$"), None
        )


def dump(page: Mapping[str, Any], comment: str = "") -> str:
    """Text of nested mappings of numbers, text, booleans, None, and lists of these.

    Args:
      comment: lines for the top of the file.
    Raises: DomainError for values that are not finite, or of other kinds. Keys become text.

    >>> print(dump({"pose": {"z": 0.25, "tiny": 1e-7, "frame": "base_link"}, "box": [0.1, 2]}), end="")
    pose:
      z: 0.25
      tiny: 1.0e-07
      frame: base_link
    box: [0.1, 2]
    """
    try:
        plain = json.loads(json.dumps(page, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise DomainError(
            f"yaml: {error}; finite numbers, text, lists and mappings are written."
        ) from error
    head = "".join(f"# {line}".rstrip() + "\n" for line in comment.splitlines())
    style = {"sort_keys": False, "default_flow_style": False, "allow_unicode": True, "width": 10**6}
    return head + yaml.dump(plain, Dumper=_Dumper, **style)


def load(text: str) -> dict[str, Any]:
    """Nested dictionaries of what a page says.

    Raises: FileFormatError naming the line that is no data.

    >>> load("pose:\\n  z: 0.25\\n  frame: base_link  # where it is screwed on")
    {'pose': {'z': 0.25, 'frame': 'base_link'}}
    """
    if max(map(text.count, "\n[{")) > MOST:
        raise FileFormatError(f"yaml: more than {MOST} lines, lists or mappings; fewer are read.")
    try:
        page = yaml.load(text, _Loader)
        json.dumps(page, allow_nan=False)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise FileFormatError(
            f"yaml, line {line}: {error.problem}; give 'key: value' lines."
        ) from error
    except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
        raise FileFormatError(
            f"yaml: {' '.join(str(error).split())[:120]}; give 'key: value' lines."
        ) from error
    if not isinstance(page, dict):
        raise FileFormatError("yaml: this is no mapping; give 'key: value' lines.")
    return page
