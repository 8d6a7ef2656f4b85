"""The former name of ``codesign.mount``."""

from codesign import mount
from codesign.former import stands_for

FILES = (
    "depth",
    "ego_velocity",
    "evidence",
    "expected",
    "head",
    "own_body",
    "score",
    "sight",
    "trend",
)
stands_for(__name__, FILES, mount)
