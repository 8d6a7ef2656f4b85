"""One runnable file or folder per question: `python -m studies` lists them, `python -m studies.NAME
--help` explains one."""

import sys

import codesign  # noqa: F401  (sets the wait policy of OpenMP, which must happen before torch is imported)

if sys.argv[0] == "-m":  # Python is about to run a module of this package, and looks for it
    from studies.frame import listing

    listing.refuse_parts(sys.orig_argv)
