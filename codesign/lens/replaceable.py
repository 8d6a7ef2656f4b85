"""What every lens is as a torch Module: tensors that can be replaced, driven by variables, converted, saved and
copied without touching another lens."""

import copy
import functools
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

import torch
from torch import Tensor, nn

from codesign.errors import DomainError, ShapeError
from codesign.lens.variables import make_variables

P = ParamSpec("P")
R = TypeVar("R")
DRIVER = "from_variables"  # name of the child that makes tensors from variables


def settled(method: Callable[Concatenate[Any, P], R]) -> Callable[Concatenate[Any, P], R]:
    """A method that computes the tensors of a lens from its variables once, however often it reads them."""

    @functools.wraps(method)
    def once(self: Any, *args: P.args, **kwargs: P.kwargs) -> R:
        return method(self.replace() if DRIVER in self._modules else self, *args, **kwargs)

    return once


class Replaceable(nn.Module):
    """Base of the lenses. A lens as it was built owns its numbers as Parameters; what ``replace`` returns owns
    none: its tensors are buffers, shared or given, through which gradients reach where they came from.

    tensor_names: the tensors that ``replace`` takes. parameter_names: those of them that are Parameters of a
      lens as it was built.
    Conversions (``to``, ``float``, ``double``) and ``load_state_dict`` make new tensors wherever a tensor may be
      shared, so make optimisers after converting, as torch asks. ``copy.deepcopy`` gives a lens that owns its
      numbers, whatever it is a copy of.
    """

    tensor_names: tuple[str, ...] = ()
    parameter_names: tuple[str, ...] = ()

    def __getattr__(self, name: str) -> Any:
        if name in type(self).tensor_names:
            driver = self.__dict__.get("_modules", {}).get(DRIVER)
            if driver is not None and driver.makes(name):
                return self._made()[name]
        return super().__getattr__(name)

    def replace(self, **tensors: Tensor) -> Self:
        """A lens that shares everything with this one except the named tensors, which may depend on other
        tensors.

        The functional way to optimise: build curvatures and thicknesses from a design vector, put them in,
        trace, and go backward. It has no Parameters and no variables of its own.
        Raises: DomainError for a name that is not one of the lens's tensors; ShapeError for another shape.
        """
        for name, value in tensors.items():
            self._known(name)
            now = getattr(self, name)
            if value.shape != now.shape:
                raise ShapeError(f"{name} has shape {tuple(now.shape)}, got {tuple(value.shape)}.")
        return self._with(self._now() | tensors)

    def freeze(self, *names: str) -> Self:
        """Stop the gradient to the named tensors (all Parameters and variables when none is named); returns the
        lens."""
        driver = self._modules.get(DRIVER)
        if driver is not None and not names:
            driver.requires_grad_(False)
        for name in names or [n for n in self.parameter_names if driver is None or not driver.makes(n)]:
            self._known(name)
            if driver is not None and driver.makes(name):
                raise DomainError(
                    f"{name} is made from variables, so it cannot be frozen by itself; leave it out of "
                    "variables(...), or freeze all with freeze()."
                )
            if name in self._parameters:
                self._parameters[name].requires_grad_(False)
            elif name in self._buffers:
                self._buffers[name] = self._buffers[name].detach()
        return self

    def __deepcopy__(self, memo):
        twin = self._shell()
        memo[id(self)] = twin
        for key, value in vars(self).items():
            if key not in ("_parameters", "_buffers"):
                twin.__dict__[key] = copy.deepcopy(value, memo)
        twin._parameters = {name: copy.deepcopy(p, memo) for name, p in self._parameters.items()}
        twin._buffers = {
            name: b if b is None else b.detach().clone().requires_grad_(b.requires_grad)
            for name, b in self._buffers.items()
        }
        if DRIVER not in self._modules:
            for name in self.parameter_names:
                if twin._buffers.get(name) is not None:
                    value = twin._buffers.pop(name)
                    twin._parameters[name] = nn.Parameter(value.detach(), value.requires_grad)
        return twin

    def _apply(self, fn, recurse=True):
        for name, old in self._parameters.items():
            if old is not None:
                with torch.no_grad():
                    moved = fn(old)
                    slope = None if old.grad is None else fn(old.grad)
                if moved is not old:
                    self._parameters[name] = nn.Parameter(moved, old.requires_grad)
                    self._parameters[name].grad = slope
        return super()._apply(fn, recurse)

    def _load_from_state_dict(self, state_dict, prefix, *rest):
        for (
            name,
            value,
        ) in self._buffers.items():  # values are copied in place, so they must be this lens's own
            if value is not None:
                self._buffers[name] = value.detach().clone().requires_grad_(value.requires_grad)
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def _known(self, name):
        if name not in self.tensor_names:
            raise DomainError(
                f"{type(self).__name__} has no tensor '{name}'; it has {', '.join(self.tensor_names)}."
            )

    def _shell(self):
        """This object again, with dictionaries of its own."""
        twin = copy.copy(self)
        for key, value in vars(self).items():
            if isinstance(value, (dict, set)):
                twin.__dict__[key] = value.copy()
        return twin

    def _with(self, tensors):
        """This lens with these tensors as buffers, without variables."""
        twin = self._shell()
        for name in tensors:
            twin._parameters.pop(name, None)
        twin._buffers.update(tensors)
        twin._modules.pop(DRIVER, None)
        return twin

    def _now(self):
        """All tensors as they are now, by name."""
        made = self._made() if DRIVER in self._modules else {}
        return {name: made[name] if name in made else getattr(self, name) for name in self.tensor_names}

    def _made(self):
        """The tensors that variables make, by name."""
        driver = self._modules[DRIVER]
        return self._solved(driver(), driver.held)

    def _make_variables(self, names, **options):
        """Make the named numbers variables, hold all others, and return the variables."""
        driver = make_variables(self, names, **options)
        made = self._made() if DRIVER in self._modules else {}
        self._modules.pop(DRIVER, None)
        for name in self.parameter_names:
            parameter = self._parameters.pop(name, None)
            value = made.get(name, parameter if parameter is not None else self._buffers.pop(name, None))
            if not driver.makes(name):
                self._buffers[name] = None if value is None else value.detach()
        self.add_module(DRIVER, driver)
        return [getattr(driver, name) for name in names]

    def _fixed(self):
        """A copy at the values of the variables as they are now."""
        made = self._made() if DRIVER in self._modules else {}
        return copy.deepcopy(self._with(made))

    def _solved(self, tensors, held):
        """Tensors after the solves that hold something."""
        return tensors
