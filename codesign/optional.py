"""Packages that the core does without: imported when they are first used, and named in one sentence
when they are missing."""

import importlib
from types import ModuleType
from typing import Any

from codesign.errors import MissingPackageError

# where the name to install is not that of the module
DISTRIBUTIONS = {
    "PIL": "pillow",
    "collada": "pycollada",
}


def require(module: str, extra: str, purpose: str) -> ModuleType:
    """Import a module that comes with an extra of this package.

    Args:
      module: full name, for example "lz4.frame".
      extra: the extra of pyproject.toml that installs it, for example "event-files".
      purpose: what needs it, as the sentence begins: "reading and writing .aedat4".
    Raises: MissingPackageError when it, or what it needs itself, is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        missing = (error.name or module).split(".")[0]
        package = DISTRIBUTIONS.get(missing, missing.replace("_", "-"))
        raise MissingPackageError(
            f"{purpose} needs {package}; install it with: pip install 'codesign[{extra}]'"
        ) from error
    except ImportError as error:
        raise MissingPackageError(
            f"{purpose} needs {module}, which is installed but cannot be imported ({error}); install it anew with: "
            f"pip install --force-reinstall 'codesign[{extra}]'"
        ) from error


def optional(module: str, extra: str, purpose: str, *before: str) -> Any:
    """What stands in for ``import module``: the module, imported when an attribute of it is first
    asked for.

    Args:
      module, extra, purpose: as for ``require``.
      before: modules of the same extra to import first, for what their import does.
    """
    return _Later((*before, module), extra, purpose)


class _Later:
    def __init__(self, modules, extra, purpose):
        self._asked = modules, extra, purpose

    def __getattr__(self, name):
        if name.startswith("__"):  # what inspection asks of every object shall import nothing
            raise AttributeError(name)
        modules, extra, purpose = self._asked
        loaded = [require(module, extra, purpose) for module in modules]
        return getattr(loaded[-1], name)
