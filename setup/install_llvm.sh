#!/usr/bin/env bash
# Make sure drjit finds an LLVM that is recent enough: nothing to do when it does, else install one where that is
# allowed (Debian, Ubuntu; as root or with passwordless sudo), else print the line to run. Exit 1 means "still unfit".
# usage: setup/install_llvm.sh PYTHON
set -euo pipefail
python=$1

fit() { "$python" -c 'from codesign.backend import check_version; check_version("cpu")' 2>/dev/null; }

privileged() {
    if [ "$(id -u)" -eq 0 ]; then "$@"; else sudo -n "$@"; fi
}

install_with_apt() {
    command -v apt-get >/dev/null || return 1
    [ "$(id -u)" -eq 0 ] || sudo -n true 2>/dev/null || return 1
    export DEBIAN_FRONTEND=noninteractive
    privileged apt-get update -qq || echo "apt-get update failed; trying with the package lists at hand." >&2
    for version in 19 20 21 22 23; do
        if apt-cache show "libllvm$version" >/dev/null 2>&1; then
            echo "installing libllvm$version, which the renderer compiles its kernels with"
            privileged apt-get install -y -qq --no-install-recommends "libllvm$version" && fit && return 0
        fi
    done
    return 1
}

if fit; then exit 0; fi
# a path set by hand overrules whatever is installed, so installing would not help
if [ -z "${DRJIT_LIBLLVM_PATH:-}" ] && install_with_apt; then exit 0; fi
"$python" - <<'PY' >&2
from codesign import backend
from codesign.errors import BackendError

try:
    backend.check_version("cpu")
except BackendError as error:
    print(f"Set-up goes on, but nothing can be rendered yet: {error}")
for system, line in backend.INSTALL_LLVM.items():
    print(f"  {system}: {line}")
PY
exit 1
