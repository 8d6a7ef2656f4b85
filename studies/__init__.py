"""One runnable file or folder per question: `python -m studies` lists them, `python -m studies.NAME
--help` explains one."""

import sys

# sets the wait policy of OpenMP, which must happen before torch is imported
from codesign import shipped

if sys.argv[0] == "-m":  # Python is about to run a module of this package, and looks for it
    from studies.frame import listing

    shipped.begin_imports()
    listing.refuse_parts(sys.orig_argv)
