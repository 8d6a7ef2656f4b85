"""One runnable file per question: `python -m studies.NAME --help`."""
