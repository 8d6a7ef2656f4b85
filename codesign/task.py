"""The former name of ``codesign.mount``: it imports for one version, with a warning."""

import sys
import warnings

from codesign import mount

# pickles name the file in which a class stood
for _file in ("depth", "ego_velocity", "evidence", "expected", "head", "own_body", "score", "sight", "trend"):
    sys.modules[f"{__name__}.{_file}"] = mount


def __getattr__(name):
    return getattr(mount, name)


warnings.warn(
    "codesign.task is codesign.mount now, with the same names; import that.", FutureWarning, stacklevel=2
)
