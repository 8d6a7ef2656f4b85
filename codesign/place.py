"""The former name of ``codesign.mount``: it imports for one version, with a warning."""

import warnings

from codesign import mount


def __getattr__(name):
    return getattr(mount, name)


warnings.warn(
    "codesign.place is codesign.mount now, with the same names; import that.", FutureWarning, stacklevel=2
)
