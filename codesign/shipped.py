"""The scenes and studies that come with codesign. In a checkout they are top-level packages; a
wheel carries them inside codesign, where they shadow nobody's own."""

import gc
import os
import sys
from pathlib import Path

_INSIDE = Path(__file__).with_name("_shipped")
_collected: list[tuple[int, int, int]] = []  # thresholds before imports
FOLDER = _INSIDE if _INSIDE.is_dir() else Path(__file__).parents[1]


def on_path() -> None:
    """Let `import scenes` and `import studies` find those that come with codesign, before any
    others of these names, here and in processes that are started from here. `codesign run` does it
    for every study; a program that uses scenes out of a wheel calls it first.

    >>> import codesign
    >>> codesign.shipped.on_path()
    >>> from scenes import worlds
    """
    folder = str(FOLDER)
    sys.path[:] = [folder, *(place for place in sys.path if place != folder)]
    inherited = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    others = [place for place in inherited if place not in ("", folder)]
    os.environ["PYTHONPATH"] = os.pathsep.join([folder, *others])


def begin_imports() -> None:
    """Look for garbage a thousandth as often while a study is imported, for there is none."""
    if not _collected:
        _collected.append(gc.get_threshold())
        gc.set_threshold(1000 * _collected[0][0], *_collected[0][1:])


def end_imports() -> None:
    """As before, where they began, but look for none among what was imported, which stays."""
    if _collected:
        gc.freeze()
        gc.set_threshold(*_collected.pop())


def command(study: str) -> str:
    """What starts a study from a shell: `python -m studies.NAME` in a checkout, `codesign run NAME`
    out of a wheel."""
    return f"codesign run {study}" if FOLDER == _INSIDE else f"python -m studies.{study}"
