"""How a system calls its stages: the input first, and by name whatever else the stage's signature
asks for."""

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor, nn

from codesign.errors import CodesignError, DomainError, ShapeError
from codesign.system.contents import hidden_tensors, tensors_in
from codesign.types import EventVolume

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
INPUT = {"events": "frames", "flow": "volume", "estimate": "field"}
"""What a stage gets first; the others get everything by name."""
_MADE = ("rays", "frames", "volume", "field", "estimate", "truth")
_NAMED = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
_PLACED = (
    inspect.Parameter.POSITIONAL_ONLY,
    inspect.Parameter.POSITIONAL_OR_KEYWORD,
    inspect.Parameter.VAR_POSITIONAL,
)


class Held(nn.Module):
    """A bound method or partial, and the Modules that it calls, so that their parameters are
    known."""

    def __init__(self, call: Callable[..., Any], modules: list[nn.Module]):
        super().__init__()
        self.call = call
        self.held = nn.ModuleList(modules)

    def forward(self, *inputs: Any, **named: Any) -> Any:
        """What the held part returns."""
        return self.call(*inputs, **named)


def modules_of(part: Any) -> list[nn.Module]:
    """The Modules of a part: itself, the one whose method it is, those in a partial."""
    if isinstance(part, nn.Module):
        return [part]
    if inspect.ismethod(part):
        return modules_of(part.__self__)
    if isinstance(part, functools.partial):
        bound = (part.func, *part.args, *part.keywords.values())
        return list(dict.fromkeys(module for value in bound for module in modules_of(value)))
    return []


def registrable(part: Any) -> Any:
    """The part as torch registers it: the Module behind its ``forward``, or a Module around what
    holds some."""
    if isinstance(part, functools.partial) and not part.args and not part.keywords:
        return registrable(part.func)
    owner = getattr(part, "__self__", None)
    if isinstance(owner, nn.Module) and part.__name__ in ("forward", "__call__"):
        return owner
    modules = modules_of(part)
    return Held(part, modules) if modules and not isinstance(part, nn.Module) else part


def event_call(part: Any) -> Any:
    """What is called of an event stage: its ``volume``, where it has one, which knows when events
    come between frames; otherwise the stage itself."""
    volume = getattr(part, "volume", None)
    return volume if callable(volume) else part


def label(part: Any) -> str:
    """What to call a part in a sentence: name of the function, or of the class."""
    while isinstance(part, Held | functools.partial):
        part = part.call if isinstance(part, Held) else part.func
    return str(getattr(part, "__qualname__", type(part).__name__)).replace("<locals>.", "")


class Stage:
    """A Module or function, and the names that it asks for.

    Args:
      name: of the stage, which says what its input is (``INPUT``).
      call: Module or function.
    Raises: DomainError when the stage asks for something that a system does not have, or cannot
      take its input.
    """

    def __init__(self, name: str, call: Callable[..., Any]):
        if inspect.isclass(call):
            raise DomainError(
                f"stage '{name}' is the class {call.__name__}; give an instance: {call.__name__}()."
            )
        if not callable(call):
            raise DomainError(
                f"stage '{name}' is a {type(call).__name__}; give a Module or a function."
            )
        self.name = name
        self.call = call
        self.input = INPUT.get(name)
        self.by_position = self.input is not None
        self.asked = self._asked()

    def _asked(self) -> tuple[str, ...]:
        target: Any = self.call.call if isinstance(self.call, Held) else self.call
        bound = target.keywords if isinstance(target, functools.partial) else {}
        try:
            target = target.forward if isinstance(target, nn.Module) else target
            parameters = [
                p for p in inspect.signature(target).parameters.values() if p.name not in bound
            ]
        except (TypeError, ValueError):  # written in C: it gets its input and nothing else
            return ()
        if self.input is not None:
            parameters = self._behind_the_input(parameters, self.input)
        for parameter in parameters:
            required = parameter.default is parameter.empty
            if required and parameter.kind == parameter.POSITIONAL_ONLY:
                raise DomainError(
                    f"stage '{self.name}' takes '{parameter.name}' by position alone; everything but the input comes "
                    "by name: leave out the '/' of its signature."
                )
            if required and parameter.kind in _NAMED and parameter.name not in OFFERED:
                raise DomainError(
                    f"stage '{self.name}' asks for '{parameter.name}', which a system does not have; it has "
                    f"{', '.join(OFFERED)}. Arguments go by name: rename it, or bind it beforehand (functools.partial)."
                )
        return tuple(p.name for p in parameters if p.kind in _NAMED and p.name in OFFERED)

    def _behind_the_input(self, parameters, given):
        """What is asked for beside the input; a keyword of the input's name takes it by name."""
        placed = [p for p in parameters if p.kind in _PLACED]
        if not placed:
            if not any(p.name == given for p in parameters):
                raise DomainError(
                    f"stage '{self.name}' ({label(self.call)}) takes no input; it gets the {given} first: "
                    f"def {self.name}({given}, ...)."
                )
            self.by_position = False
        elif placed[0].name in _MADE and placed[0].name != given:
            raise DomainError(
                f"stage '{self.name}' names its first argument '{placed[0].name}', but gets the {given} there; write "
                f"def {self.name}({given}, {placed[0].name}, ...) for both."
            )
        elif placed[0].kind != inspect.Parameter.VAR_POSITIONAL:
            parameters = [p for p in parameters if p is not placed[0]]
        return parameters

    def __call__(self, has: Mapping[str, Any], *inputs: Any) -> Any:
        """Run the stage on its input, with what it asks for out of ``has``.

        Raises: DomainError naming both sides where torch cannot join weights and input of different
          dtypes or devices; ShapeError where a network is of other bins than the volume.
        """
        named = {name: has[name] for name in self.asked}
        if inputs and not self.by_position:
            named[str(self.input)] = inputs[0]
        placed = inputs if self.by_position else ()
        try:
            return self.call(*placed, **named)
        except RuntimeError as error:
            if not isinstance(error, CodesignError):
                # counts, flow: the first of a kind
                self._check_kinds(tensors_in((inputs, named))[:1], error)
                if self.name == "flow" and isinstance(inputs[0], EventVolume):
                    self._check_bins(inputs[0].counts.shape[2], error)
            raise

    def _check_bins(self, bins: int, error: RuntimeError) -> None:
        """Raise where a network's first convolution takes other channels than the volume has."""
        layers = [each for module in modules_of(self.call) for each in module.modules()]
        taken = next((each.in_channels for each in layers if hasattr(each, "in_channels")), None)
        if taken not in (None, bins, 2 * bins):
            remedy = f"bins={taken // 2}" if taken % 2 == 0 else "bins="
            raise ShapeError(
                f"stage 'flow' ({label(self.call)}) begins with a convolution of {taken} channels, and the volume "
                f"has {bins} bins of two polarities, {2 * bins} channels: give {remedy}, or a network of as many "
                "channels."
            ) from error

    def _check_kinds(self, given: list[Tensor], error: RuntimeError) -> None:
        weights = [p for module in modules_of(self.call) for p in module.parameters()]
        weights = weights or [tensor for _, tensor in hidden_tensors(self.call)]
        own, other = (
            {_kind(t) for t in part if t.is_floating_point()} for part in (weights, given)
        )
        if own and other and not own & other:
            source = {
                "events": " from stage 'render'",
                "flow": " from stage 'events'",
                "estimate": " from stage 'flow'",
            }
            raise DomainError(
                f"stage '{self.name}' ({label(self.call)}) has weights of {' and '.join(sorted(own))} and gets "
                f"{' and '.join(sorted(other))}{source.get(self.name, '')}; bring one to the other, "
                "by .to(dtype) or .to(device) of the Module (frames have the dtype of the scene)."
            ) from error


def _kind(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} on {tensor.device.type}"
