"""The former name of ``codesign.mount``."""

from codesign import mount
from codesign.former import stands_for

FILES = ("body", "criterion", "mount", "observability", "ranges", "requirements", "starts")
stands_for(__name__, FILES, mount)
