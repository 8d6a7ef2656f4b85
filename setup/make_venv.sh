#!/usr/bin/env bash
# Make the virtual environment FOLDER with PYTHON, or with the first Python >= 3.11 found; do nothing when it is there.
# usage: setup/make_venv.sh FOLDER [PYTHON]
set -euo pipefail
folder=$1 asked=${2:-}

recent() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; }

if [ -x "$folder/bin/python" ] && recent "$folder/bin/python"; then exit 0; fi

python=""
if [ -n "$asked" ]; then
    if recent "$asked"; then python=$asked; fi
else
    for candidate in python3 python3.13 python3.12 python3.11 python3.14 python; do
        if recent "$candidate"; then python=$candidate; break; fi
    done
fi
if [ -z "$python" ]; then
    found=$("${asked:-python3}" --version 2>/dev/null | head -n 1 || true)
    echo "Python 3.11 or newer is needed, but '${asked:-python3}' is: ${found:-not there}. Install one and run 'make setup PYTHON=/path/to/python3.11'." >&2
    exit 2
fi
if ! "$python" -m venv --clear "$folder"; then
    echo "'$python -m venv' failed; on Debian and Ubuntu install the package python3-venv, then run 'make setup' again." >&2
    exit 2
fi
