"""The tensors inside what crosses a junction, and those that a function holds without showing
them."""

import dataclasses
import dis
import gc
from collections.abc import Callable
from types import FunctionType, ModuleType
from typing import Any

from torch import Tensor, nn

MOST = 10_000  # objects that are looked through behind one function


def tensors_in(value: Any) -> list[Tensor]:
    """Tensors of a value: itself, or those in dataclasses, tuples, lists and dictionaries."""
    found: list[Tensor] = []
    mapped(value, lambda tensor: found.append(tensor) or tensor)
    return found


def mapped(value: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """The same value with its tensors changed: those inside dataclasses, tuples, lists and
    dictionaries too."""
    if isinstance(value, Tensor):
        return change(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in dataclasses.fields(value) if field.init]
        return dataclasses.replace(
            value, **{name: mapped(getattr(value, name), change) for name in names}
        )
    if type(value) in (list, tuple):
        return type(value)(mapped(each, change) for each in value)
    if isinstance(value, dict):
        return {name: mapped(each, change) for name, each in value.items()}
    return value


def hidden_tensors(part: Any) -> list[tuple[str, Tensor]]:
    """Tensors that ask for gradients behind a Module, function or object, each with what it was
    found in.

    Looked through are attributes, containers, partials, defaults and closures, and of the globals
    that a function names Modules, tensors and what is of the same file.
    """
    found: list[tuple[str, Tensor]] = []
    seen: set[int] = set()
    todo: list[tuple[str, Any]] = [("a tensor", part)]
    while todo and len(seen) < MOST:
        owner, value = todo.pop()
        if id(value) in seen or isinstance(value, type | ModuleType):
            continue
        seen.add(id(value))
        if isinstance(value, Tensor):
            if value.is_leaf and value.requires_grad:
                found.append((owner, value))
            continue
        owner = (
            f"a {type(value).__name__}"
            if isinstance(value, nn.Module) and owner == "a tensor"
            else owner
        )
        inner = gc.get_referents(value)
        if isinstance(value, FunctionType):
            names = {
                step.argval for step in dis.get_instructions(value) if step.opname == "LOAD_GLOBAL"
            }
            used = [value.__globals__[name] for name in names if name in value.__globals__]
            inner = [each for each in inner if each is not value.__globals__] + [
                each
                for each in used
                if isinstance(each, nn.Module | Tensor)
                or getattr(each, "__module__", "") == value.__module__
            ]
        todo += [(owner, each) for each in inner]
    return found
