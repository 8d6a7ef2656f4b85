"""What every lens is as a torch Module: tensors that can be replaced, driven by variables,
converted, saved and copied without touching another lens."""

import copy
import functools
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

import torch
from torch import Tensor, nn

from codesign.errors import DomainError, ShapeError
from codesign.lens.variables import Variables, make_variables

P = ParamSpec("P")
R = TypeVar("R")
DRIVER = "from_variables"  # name of the child that makes tensors from variables


def settled(method: Callable[Concatenate[Any, P], R]) -> Callable[Concatenate[Any, P], R]:
    """A method that computes the tensors of a lens from its variables once, however often it reads
    them."""

    @functools.wraps(method)
    def once(self: Any, *args: P.args, **kwargs: P.kwargs) -> R:
        return method(self.replace() if DRIVER in self._modules else self, *args, **kwargs)

    return once


class Replaceable(nn.Module):
    """Base of the lenses. A lens as it was built owns its numbers as Parameters; what ``replace``
    returns owns none: its tensors are buffers, shared or given, through which gradients reach where
    they came from.

    tensor_names: the tensors that ``replace`` takes. parameter_names: those of them that are
      Parameters of a lens as it was built.
    A saved state also says what its tensors belong to (pupil, glasses, kinds of surfaces):
      ``load_state_dict`` refuses that of another lens before it copies anything.
    Conversions (``to``, ``float``, ``double``) and ``load_state_dict`` make new tensors wherever a
      tensor may be shared, so make optimisers after converting, as torch asks. ``copy.deepcopy``
      gives a lens that owns its numbers, whatever it is a copy of.
    """

    tensor_names: tuple[str, ...] = ()
    parameter_names: tuple[str, ...] = ()
    borrows = False  # whether its plate is that of the lens it was made from

    def __getattr__(self, name: str) -> Any:
        if name in type(self).tensor_names:
            driver = self._driver
            if driver is not None and driver.makes(name):
                return self._made(driver)[name]
        return super().__getattr__(name)

    @property
    def _driver(self) -> Variables | None:
        return self.__dict__.get("_modules", {}).get(DRIVER)

    def replace(self, **tensors: Tensor) -> Self:
        """A lens that shares everything with this one except the named tensors, which may depend on
        other tensors.

        The functional way to optimise: build curvatures and thicknesses from a design vector, put
        them in, trace, and go backward. It has no Parameters and no variables of its own.
        Raises: DomainError for a name that is not one of the lens's tensors; ShapeError for another
          shape.
        """
        for name, value in tensors.items():
            self._known(name)
            shape = getattr(self, name).shape
            if (
                not isinstance(value, Tensor)
                or not value.is_floating_point()
                or value.shape != shape
            ):
                given = tuple(value.shape) if isinstance(value, Tensor) else repr(value)[:60]
                kind = getattr(value, "dtype", type(value).__name__)
                raise ShapeError(
                    f"{name} has shape {tuple(shape)}, got {given} ({kind}); give real numbers."
                )
        return self._with(self._now() | tensors)

    def freeze(self, *names: str) -> Self:
        """Stop the gradient to the named tensors (all Parameters and variables when none is named);
        returns the lens."""
        driver = self._driver
        if driver is not None and not names:
            driver.requires_grad_(False)
        for name in names or [
            n for n in self.parameter_names if driver is None or not driver.makes(n)
        ]:
            self._known(name)
            if driver is not None and driver.makes(name):
                raise DomainError(
                    f"{name} is made from variables, so it cannot be frozen by itself; leave it out of "
                    "variables(...), or freeze all with freeze()."
                )
            parameter = self._parameters.get(name)
            buffer = self._buffers.get(name)
            if parameter is not None:
                parameter.requires_grad_(False)
            elif buffer is not None:
                self._buffers[name] = buffer.detach()
        return self

    def __deepcopy__(self, memo):
        twin = self._shell()
        memo[id(self)] = twin
        for key, value in vars(self).items():
            if key not in ("_parameters", "_buffers"):
                twin.__dict__[key] = copy.deepcopy(value, memo)
        twin.borrows = False
        twin._parameters = {name: copy.deepcopy(p, memo) for name, p in self._parameters.items()}
        twin._buffers = {name: _own(b) for name, b in self._buffers.items()}
        for name in self.parameter_names if self._driver is None else ():
            if name in twin._buffers:
                value = twin._buffers.pop(name)
                twin._parameters[name] = (
                    None if value is None else nn.Parameter(value.detach(), value.requires_grad)
                )
        return twin

    def _apply(self, fn, recurse=True):
        for name, child in self._modules.items():
            if isinstance(child, Replaceable):
                self._modules[name] = child._shell()
        for name, old in self._parameters.items():
            if old is not None:
                with torch.no_grad():
                    moved = fn(old)
                    slope = None if old.grad is None else fn(old.grad)
                if moved is not old:
                    new = nn.Parameter(moved, old.requires_grad)
                    new.grad = slope
                    self._parameters[name] = new
        return super()._apply(fn, recurse)

    def get_extra_state(self) -> Tensor:
        """What the tensors of a saved state belong to, beside their shapes: the numbers of
        ``_identity``."""
        return torch.tensor([*self._identity().values()], dtype=torch.float64)

    def set_extra_state(self, state: Tensor) -> None:
        """Checked in ``_load_from_state_dict``, before any tensor is copied."""

    def _identity(self) -> dict[str, float]:
        """What is no tensor of this object, but what its tensors belong to: {what: number}."""
        raise NotImplementedError

    def _check_state(self, state):
        """Raise DomainError where a saved state is that of another object."""
        own = self._identity()
        remedy = "build the same one and load again; files of lens.save hold a lens whole"
        given = state.tolist() if torch.is_tensor(state) and state.ndim == 1 else []
        if len(given) != len(own):
            raise DomainError(
                f"the state is of another {type(self).__name__} ({len(given)} numbers describe it, "
                f"{len(own)} this one); {remedy}."
            )
        eps = 4 * torch.finfo(state.dtype if state.is_floating_point() else torch.float64).eps
        for (name, here), there in zip(own.items(), given, strict=True):
            if not abs(there - here) <= eps * abs(here):
                raise DomainError(
                    f"the state is of another {type(self).__name__}: its {name} is {there:.9g}, here "
                    f"{here:.9g}; {remedy}."
                )

    def _load_from_state_dict(self, state_dict, prefix, local_metadata, strict, missing, *rest):
        key = f"{prefix}_extra_state"
        if key in state_dict:
            self._check_state(state_dict[key])
        # values are copied in place, so the buffers, and a plate of another lens, must be this
        # lens's own
        self._buffers.update({name: _own(value) for name, value in self._buffers.items()})
        if self.borrows:
            parts = {
                name: child
                for name, child in self._modules.items()
                if isinstance(child, Replaceable)
            }
            self._modules.update(copy.deepcopy(parts))
            self.borrows = False
        super()._load_from_state_dict(state_dict, prefix, local_metadata, strict, missing, *rest)
        if key in missing:  # torch names it in its error, unless it is asked not to be strict
            missing[missing.index(key)] = (
                f"{key} (pupil, glasses and kinds of surfaces; states of earlier versions lack them: "
                "strict=False loads one that you know to be of this very lens)"
            )

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
        twin.borrows = True
        return twin

    def _now(self):
        """All tensors as they are now, by name."""
        made = self._made(self._driver)
        return {
            name: made[name] if name in made else getattr(self, name) for name in self.tensor_names
        }

    def _made(self, driver):
        """The tensors that variables make, by name; none without variables."""
        return {} if driver is None else self._solved(driver(), driver.held)

    def _make_variables(self, names, **options):
        """Make the named numbers variables, hold all others, and return the variables."""
        made = self._made(self._driver)
        driver = make_variables(self, names, **options)
        self._modules.pop(DRIVER, None)
        for name in self.parameter_names:
            held = [found.pop(name, None) for found in (made, self._parameters, self._buffers)]
            value = next((v for v in held if v is not None), None)
            if not driver.makes(name):
                self._buffers[name] = None if value is None else value.detach()
        self.add_module(DRIVER, driver)
        return [driver.get_parameter(name) for name in names]

    def _fixed(self):
        """A copy at the values of the variables as they are now."""
        return copy.deepcopy(self._with(self._made(self._driver)))

    def _solved(self, tensors, held):
        """Tensors after the solves that hold something."""
        return tensors


def _own(tensor):
    """The same values in memory of their own, without a history."""
    return None if tensor is None else tensor.detach().clone().requires_grad_(tensor.requires_grad)
