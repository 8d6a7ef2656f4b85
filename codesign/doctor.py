"""`python -m codesign doctor`: what is installed, what is missing, what to do. One line each; works
when nothing else does."""

import os
import platform
import re
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

PYTHON_NEEDED = (3, 11)
REINSTALL = "run 'make setup', or 'pip install -e . -c constraints.txt' in a fresh environment"


@dataclass(frozen=True)
class Finding:
    """One line of the report. ok is None for a fact that is neither good nor bad."""

    name: str
    ok: bool | None
    found: str
    remedy: str = ""


def diagnose(device="cpu"):
    """Yield findings one by one, the slow trial render last.

    Args:
      device: "cpu" or "cuda", where the trial render runs.
    Returns: generator of Finding; never raises for something that is missing or broken on this
      machine.
    """
    yield _python()
    yield _package("torch", "")
    yield _package("mitsuba", _variant(device))
    yield _package("drjit", "")
    yield _llvm(device)
    yield _cuda(device)
    yield _threads()
    yield _extras()
    yield _render(device)


def main(device="cpu"):
    """Print the findings as they come. Returns the exit code: 0 when a render works and nothing it
    needs is unfit, else 2."""
    sys.stdout.reconfigure(errors="replace")  # pyright: ignore[reportAttributeAccessIssue]
    colour = sys.stdout.isatty() and "NO_COLOR" not in os.environ
    marks = (
        {True: "\033[32m✔\033[0m", False: "\033[31m✘\033[0m", None: "·"}
        if colour
        else {True: "ok     ", False: "missing", None: "       "}
    )
    ready = True
    for finding in diagnose(device):
        print(f"{marks[finding.ok]} {finding.name:<9}{finding.found}", flush=True)
        if finding.remedy:
            print(f"            -> {finding.remedy}", flush=True)
        ready = ready and finding.ok is not False
    print(
        "Ready: a render works."
        if ready
        else "Not ready: nothing can be rendered yet; do what the arrows say."
    )
    return 0 if ready else 2


def _python():
    good = sys.version_info[:2] >= PYTHON_NEEDED
    remedy = (
        ""
        if good
        else f"install Python {'.'.join(map(str, PYTHON_NEEDED))} or newer, then 'make setup PYTHON=/path/to/it'"
    )
    return Finding("Python", good, f"{platform.python_version()} at {sys.executable}", remedy)


def _package(name, extra):
    try:
        __import__(name)
        return Finding(name, True, f"{version(name)}{extra}")
    except PackageNotFoundError:
        return Finding(name, True, f"of unknown version{extra}")
    except Exception as error:  # noqa: BLE001 - a broken binary wheel can raise anything, and the other lines still help
        return Finding(name, False, _sentence(error), REINSTALL)


def _variant(device):
    try:
        from codesign import backend

        return f", variant {backend.variant(device)}"
    except Exception as error:  # noqa: BLE001 - see _package
        return f", variant unknown ({_sentence(error)})"


def _llvm(device):
    try:
        from codesign import backend
        from codesign.errors import BackendError

        found = backend.llvm_version()
        text = (
            "none found"
            if found is None
            else f"{'.'.join(map(str, found))} at {mapped_llvm() or 'a path that could not be found out'}"
        )
        if device.startswith("cuda"):
            return Finding("LLVM", None, text + " (not needed on cuda)")
        try:
            backend.check_version("cpu")
        except BackendError as error:
            return Finding("LLVM", False, text, str(error))
        return Finding("LLVM", True, text)
    except Exception as error:  # noqa: BLE001 - see _package
        return Finding("LLVM", False, _sentence(error), REINSTALL)


def mapped_llvm():
    """Path of the LLVM library this process has loaded: from the kernel's list on Linux, else
    DRJIT_LIBLLVM_PATH, else None."""
    try:
        for line in Path("/proc/self/maps").read_text().splitlines():
            path = line[line.find("/") :] if "/" in line else ""
            if "llvm" in Path(path).name.lower():
                return path
    except OSError:
        pass  # not Linux: only what was set by hand is known
    return os.environ.get("DRJIT_LIBLLVM_PATH")


def _cuda(device):
    try:
        import torch

        if torch.cuda.is_available():
            return Finding("CUDA", True, f"{torch.version.cuda}, {torch.cuda.get_device_name(0)}")
    except Exception as error:  # noqa: BLE001 - see _package
        needed = device.startswith("cuda")
        return Finding(
            "CUDA", False if needed else None, _sentence(error), REINSTALL if needed else ""
        )
    if device.startswith("cuda"):
        return Finding(
            "CUDA",
            False,
            "no device",
            "install an NVIDIA driver and a CUDA build of torch, or use --device cpu",
        )
    return Finding("CUDA", None, "no device; everything runs on the CPU")


def _threads():
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    try:
        import drjit
        import torch

        return Finding(
            "threads",
            None,
            f"{cores} usable cores; torch {torch.get_num_threads()}, drjit {drjit.thread_count()}",
        )
    except Exception as error:  # noqa: BLE001 - see _package
        return Finding("threads", None, f"{cores} usable cores ({_sentence(error)})")


def _extras():
    """What pyproject.toml offers beside the core, without what only collects (all, dev) or compares
    (bench)."""
    try:
        wanted = [line.split(";") for line in requires("codesign") or ()]
    except PackageNotFoundError:
        return Finding("extras", None, "codesign itself is not installed, only its folder is used")
    missing = set()
    for package, *conditions in wanted:
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", "".join(conditions))
        if extra and extra[1] not in ("all", "dev", "bench"):
            try:
                version(re.split(r"[^\w.-]", package.strip())[0])
            except PackageNotFoundError:
                missing.add(extra[1])
    if not missing:
        return Finding("extras", None, "every one is installed")
    names = ",".join(sorted(missing))
    return Finding(
        "extras",
        None,
        f"not installed: {names}",
        f"pip install 'codesign[{names}]', if you need them",
    )


def _render(device):
    try:
        from codesign import backend

        worked, message = backend.trial_render(device)
        hint = "update the NVIDIA driver" if device.startswith("cuda") else backend.install_hint()
        remedy = "" if worked else f"mend what is missing above; if nothing is, {hint}"
    except Exception as error:  # noqa: BLE001 - see _package
        return Finding("render", False, _sentence(error), REINSTALL)
    return Finding("render", worked, "a small scene rendered" if worked else message, remedy)


def _sentence(error):
    lines = str(error).strip().splitlines() or ["no message"]
    return f"{type(error).__name__}: {lines[0][:200]}"
