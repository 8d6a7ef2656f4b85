"""The former name of ``codesign.mount``: it imports for one version, with a warning."""

import sys
import warnings

from codesign import mount

# pickles name the file in which a class stood
for _file in ("body", "criterion", "mount", "observability", "ranges", "requirements", "starts"):
    sys.modules[f"{__name__}.{_file}"] = mount


def __getattr__(name):
    return getattr(mount, name)


warnings.warn(
    "codesign.place is codesign.mount now, with the same names; import that.", FutureWarning, stacklevel=2
)
