"""Differentiable co-design: lens, render, event camera, event flow.

`import codesign` is all that is needed: its rooms (`codesign.lens`, `codesign.flow`, …) are
imported when they are first asked for.
"""

import importlib
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from codesign import waiting  # noqa: F401 - before torch, where nobody has imported it yet

if TYPE_CHECKING:
    from codesign import (
        backend,
        errors,
        events,
        exclusive,
        fidelity,
        flow,
        grad,
        lens,
        mount,
        optimise,
        pose,
        render,
        report,
        shipped,
        state,
        system,
        train,
        types,
    )
    from codesign.fidelity.search import select
    from codesign.report.show import show
    from codesign.system import System

__all__ = [
    "System",
    "backend",
    "errors",
    "events",
    "exclusive",
    "fidelity",
    "flow",
    "grad",
    "lens",
    "mount",
    "optimise",
    "pose",
    "render",
    "report",
    "select",
    "shipped",
    "show",
    "state",
    "system",
    "train",
    "types",
]


def __getattr__(name: str) -> Any:
    if name == "System":
        return importlib.import_module("codesign.system").System
    if name == "select":
        return importlib.import_module("codesign.fidelity").select
    if name == "show":
        return importlib.import_module("codesign.report.show").show
    if name in __all__ or name in ("place", "task"):  # the latter are former names of mount
        return importlib.import_module(f"codesign.{name}")
    if name == "__version__":
        try:
            return version("codesign")
        except PackageNotFoundError:
            return "unknown"  # run from a checkout that was never installed
    raise AttributeError(
        f"module 'codesign' has no attribute '{name}'; it has {', '.join(__all__)}."
    )


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__, "__version__"])
