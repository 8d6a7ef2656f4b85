"""What a run ran on: versions of the software that made its numbers, and the hardware that made its
times."""

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

PACKAGES = ("codesign", "torch", "mitsuba", "drjit", "numpy", "kornia")


def versions():
    """Dictionary name -> version of Python, the packages that compute, and the git commit
    ("unknown" outside a checkout)."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    found["commit"] = _commit(Path(__file__).resolve().parents[2])
    return found


def hardware():
    """Dictionary of processor, usable cores, memory, graphics card, system. No host or user
    names."""
    return {
        "cpu": _cpu(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "threads_torch": torch.get_num_threads(),
        "memory_gb": _memory_gb(),
        "gpu": torch.cuda.get_device_name(0) if torch.cuda.is_available() else "none",
        "system": platform.platform(),
    }


def _commit(root):
    def git(*words):
        ran = subprocess.run(
            ["git", "-C", root, *words], capture_output=True, text=True, timeout=10, check=True
        )
        return ran.stdout.strip()

    if not (root / ".git").exists():
        return "unknown"
    try:
        return git("rev-parse", "HEAD") + ("+changes" if git("status", "--porcelain") else "")
    except (OSError, subprocess.SubprocessError):
        return "unknown"


def _cpu():
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass  # not Linux
    return platform.processor() or platform.machine()


def _memory_gb():
    try:
        return round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9, 1)
    except (AttributeError, OSError, ValueError):
        return "unknown"
