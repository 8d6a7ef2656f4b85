"""Searches, which look where there may be nothing, and so are not warned of what is not found."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_searched = ContextVar("searched", default=False)


@contextmanager
def searching() -> Iterator[None]:
    """Within it, in this thread alone, rays may be looked for where no light passes."""
    before = _searched.set(True)
    try:
        yield
    finally:
        _searched.reset(before)


def is_searched() -> bool:
    """Whether a search asks."""
    return _searched.get()
