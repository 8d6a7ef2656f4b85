#!/usr/bin/env bash
# Install the core alone, as a stranger would with `pip install .`, into an environment of its own, and use it there.
# usage: setup/core_check.sh [PYTHON]
set -euo pipefail
cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.."
checkout=$PWD
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
setup/make_venv.sh "$place/venv" "${1:-}"
python=$place/venv/bin/python
# a copy: building in place would leave a folder build/ and take in what an earlier build left there
mkdir "$place/source"
tar -c --exclude=__pycache__ pyproject.toml setup.py README.md LICENSE codesign scenes studies | tar -x -C "$place/source"
"$python" -m pip install --disable-pip-version-check --quiet "$place/source" --constraint constraints.txt
cp setup/core_check.py "$place"
cd "$place" # where no checkout is found
"$python" core_check.py
"$place/venv/bin/codesign" list >/dev/null
"$place/venv/bin/codesign" run lens_opt --quick --steps 2 --cases 1 --judged 1 --out optimised
grep -q "needs imageio-ffmpeg; install it with" optimised/report.html
# the tests that meet packages of extras: what needs one is skipped, nothing else fails
cd -- "$checkout"
"$python" -m pip install --disable-pip-version-check --quiet pytest pytest-xdist --constraint constraints.txt
"$python" -m pytest -q -n auto --maxprocesses 8 -p no:cacheprovider tests/events/test_formats.py tests/events/test_formats_layouts.py \
    tests/scenes/test_from_mesh.py tests/test_optional.py tests/lens/test_import_real.py
echo "core check: imports, renders, optimises, skips what it lacks"
