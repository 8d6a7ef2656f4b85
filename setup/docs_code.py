"""Doctests of docstrings become blocks of code in the docs (mkdocs.yml)."""

import re
from typing import Any

from griffe import Extension, Object

DOCTEST = re.compile(r"^( *)>>> .*(?:\n\1\S.*)*", re.M)


class Doctests(Extension):
    """Puts fences around every doctest, which google's style knows in a section of its own only."""

    def on_object(self, *, obj: Object, **kwargs: Any) -> None:
        if obj.docstring:
            obj.docstring.value = DOCTEST.sub(r"\1```pycon\n\g<0>\n\1```", obj.docstring.value)
