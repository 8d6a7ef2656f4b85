"""What to ask of a system before the first step: do its stages fit, and does every variable reach an objective?"""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from codesign.errors import GradientError, NonFiniteError, ShapeError
from codesign.system.result import JUNCTIONS, Result
from codesign.system.system import System


def check(
    system: System,
    batch: Any,
    variables: "torch.optim.Optimizer | Iterable[Tensor] | None" = None,
    objectives: tuple[str, ...] | None = None,
) -> Result:
    """Run one pass and raise one sentence where something does not fit.

    Args: variables: what will be optimised: an optimiser, or its tensors; the system's parameters that ask for
      gradients when None. objectives: names of those in use; all when None.
    Returns: the probed Result of the pass.
    Raises: ShapeError, DomainError where stages, batch and scene do not fit; GradientError for a frozen variable,
      one that no objective depends on, or an objective that is no scalar or depends on none; NonFiniteError
      naming a junction.
    """
    names = {id(p): name for name, p in system.named_parameters()}
    wanted = _tensors(system, variables)
    for number, variable in enumerate(wanted):
        if not variable.requires_grad:
            raise GradientError(
                f"{_name(names, variable, number)} is frozen but was handed to the optimiser; thaw it with "
                "requires_grad_(True), or leave it out."
            )
    run = system.begin(batch)
    if hasattr(run["camera"], "check"):
        run["camera"].check()
    _check_fresh(system)
    result = system(batch, objectives=objectives, probe=True)
    cut = _where_cut(result)
    reached = [False] * len(wanted)
    for name, value in result.objectives.items():
        if value.numel() != 1:
            raise ShapeError(
                f"objective '{name}' has shape {tuple(value.shape)}; reduce it to one number, for example by mean()."
            )
        if not bool(value.detach().isfinite()):
            raise NonFiniteError(
                f"objective '{name}' is {float(value.detach())}; the objective itself has the cause."
            )
        if not wanted:
            continue
        if cut is not None:
            raise GradientError(
                f"objective '{name}' cannot see what lies before junction '{cut}': the stage that makes it passes no "
                "gradient on (a detach, a no_grad, or a hard sensor); exchange that stage."
            )
        found = [None] * len(wanted)
        if value.requires_grad:
            found = torch.autograd.grad(value, wanted, retain_graph=True, allow_unused=True)
        if all(g is None for g in found):
            raise GradientError(
                f"objective '{name}' depends on none of the variables; optimise something that it sees, and make the "
                "optimiser after the variables (geo.variables, mount.variables)."
            )
        if all(g is None or not bool(g.any()) for g in found):
            raise GradientError(
                f"the gradient of objective '{name}' is exactly 0 for every variable: nothing moves or nothing is seen "
                "in this batch, or no event comes about; give motion, texture, or lower thresholds."
            )
        reached = [yes or g is not None for yes, g in zip(reached, found, strict=True)]
    for number, variable in enumerate(wanted if variables is not None else []):
        if not reached[number]:
            stale = (
                "" if id(variable) in names else " (no parameter of the system: made before its variables?)"
            )
            raise GradientError(
                f"no objective ({', '.join(result.objectives)}) depends on {_name(names, variable, number)}{stale}; "
                "leave it out of the optimiser, or add an objective that sees it."
            )
    return result


def _check_fresh(system: System) -> None:
    """Raise GradientError for a lens whose tensors were computed once from variables: a second backward pass would
    go through a graph that is gone."""
    lens = system.camera.lens if hasattr(system.camera, "rays") else None
    buffers = list(lens.buffers()) if isinstance(lens, torch.nn.Module) else []
    if any(tensor.grad_fn is not None for tensor in buffers):
        raise GradientError(
            "stage 'camera': its lens was computed once from other tensors (focus_at, replace), so only one step could "
            "go back through it; use variables(..., focus_at_m=...), or give camera as a function that makes it anew."
        )


def _tensors(system: System, variables: Any) -> list[Tensor]:
    if variables is None:
        return [p for p in system.parameters() if p.requires_grad]
    if isinstance(variables, torch.optim.Optimizer):
        return [p for group in variables.param_groups for p in group["params"]]
    return list(variables)


def _name(names: dict[int, str], variable: Tensor, number: int) -> str:
    return f"variable '{names[id(variable)]}'" if id(variable) in names else f"variable {number}"


def _where_cut(result: Result) -> str | None:
    """The first junction behind the lens without a gradient whose predecessor has one; None where there is none."""
    junctions = result.junctions or {}
    made = [name for name in JUNCTIONS[2:] if junctions.get(name)]
    had = any(t.requires_grad for name in JUNCTIONS[:2] for t in junctions.get(name, ()))
    for name in made:
        has = any(t.requires_grad for t in junctions[name])
        if had and not has:
            return name
        had = had or has
    return None
