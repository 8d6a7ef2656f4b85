"""Tables of what is refused: ``refusals.txt`` beside the tests has a line "call | sentence" for each
call, the sentence as a pattern, under headings "[section: Error]"; other lines say what it is about.

    @refusals.table(__file__, "paths")
    def test_what_is_no_path_is_refused(row):
        row.holds(globals())
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from codesign import errors


@dataclass(frozen=True)
class Row:
    """What is called, and the error and sentence that it ends in."""

    call: str
    error: type[Exception]
    sentence: str

    def holds(self, names: Mapping[str, Any]) -> str:
        """The whole sentence, which is one line and fits the pattern; names: of what is called."""
        with pytest.raises(self.error, match=self.sentence) as told:
            eval(self.call, dict(names))
        assert "\n" not in str(told.value)
        return str(told.value)


def rows(file: str, *sections: str) -> list[Row]:
    """The rows of some sections, of all their errors; of all sections where none is named."""
    text = Path(file).with_name("refusals.txt").read_text(encoding="utf-8")
    found = []
    for name, error, lines in re.findall(
        r"^\[([^:\]]+): (\w+)\]\n(.*?)(?=^\[|\Z)", text, re.M | re.S
    ):
        if name in (sections or (name,)):
            calls = [line.rsplit(" | ", 1) for line in lines.splitlines() if " | " in line]
            found += [Row(call, getattr(errors, error), sentence) for call, sentence in calls]
    assert found, f"no rows of {sections}"
    return found


def table(file: str, *sections: str) -> pytest.MarkDecorator:
    """Runs a test with every ``row`` of some sections, or of all."""
    found = rows(file, *sections)
    return pytest.mark.parametrize("row", found, ids=[row.sentence for row in found])
