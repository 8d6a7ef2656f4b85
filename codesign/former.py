"""Former names of rooms: they import for one version, with a warning."""

import sys
import warnings
from collections.abc import Iterable
from types import ModuleType


def stands_for(former: str, files: Iterable[str], room: ModuleType) -> None:
    """Let the module ``former``, which calls this, and files that it had be ``room``, also where
    pickles name them."""
    for name in (former, *(f"{former}.{file}" for file in files)):
        sys.modules[name] = room
    warnings.warn(
        f"{former} is {room.__name__} now, with the same names; import that.",
        FutureWarning,
        stacklevel=3,
    )
