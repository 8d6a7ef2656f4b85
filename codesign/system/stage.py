"""How a system calls its stages: the input first, and by name whatever else the stage's signature asks for."""

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from torch import nn

from codesign.errors import DomainError

OFFERED = (
    "batch",
    "camera",
    "scene",
    "rays",
    "T_body_cam",
    "T_world_body",
    "T_world_cam",
    "t_s",
    "bins",
    "generator",
    "frames",
    "volume",
    "field",
    "estimate",
    "truth",
)


def event_call(part: Any) -> Any:
    """What is called of an event stage: its ``volume``, where it has one, which knows when events come between
    frames; otherwise the stage itself."""
    volume = getattr(part, "volume", None)
    return volume if callable(volume) else part


_NAMED = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)


class Stage:
    """A Module or function, and the names that it asks for.

    Args: name: of the stage, for sentences. call: Module or function. inputs: 1 when the stage's input comes
      first by position, 0 when everything goes by name.
    Raises: DomainError when the stage asks for something that a system does not have.
    """

    def __init__(self, name: str, call: Callable[..., Any], inputs: int):
        if inspect.isclass(call):
            raise DomainError(
                f"stage '{name}' is the class {call.__name__}; give an instance: {call.__name__}()."
            )
        if not callable(call):
            raise DomainError(f"stage '{name}' is a {type(call).__name__}; give a Module or a function.")
        self.name = name
        self.call = call
        self.inputs = inputs
        self.asked = self._asked()

    def _asked(self) -> tuple[str, ...]:
        try:
            target = self.call.forward if isinstance(self.call, nn.Module) else self.call
            parameters = list(inspect.signature(target).parameters.values())
        except (TypeError, ValueError):  # written in C: it gets its input and nothing else
            return ()
        parameters = parameters[self.inputs :]
        for parameter in parameters:
            required = parameter.default is parameter.empty and parameter.kind in _NAMED
            if required and parameter.name not in OFFERED:
                raise DomainError(
                    f"stage '{self.name}' asks for '{parameter.name}', which a system does not have; it has "
                    f"{', '.join(OFFERED)}. Bind other arguments beforehand (functools.partial)."
                )
        return tuple(p.name for p in parameters if p.kind in _NAMED and p.name in OFFERED)

    def __call__(self, has: Mapping[str, Any], *inputs: Any) -> Any:
        """Run the stage on its input, with what it asks for out of ``has``."""
        return self.call(*inputs, **{name: has[name] for name in self.asked})
