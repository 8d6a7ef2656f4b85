"""One runnable file per question: `python -m studies.NAME --help`."""

import codesign  # noqa: F401  (sets the wait policy of OpenMP, which must happen before torch is imported)
