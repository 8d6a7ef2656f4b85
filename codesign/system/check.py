"""What to ask of a system before the first step: do its stages fit, and does every variable reach an objective?"""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from codesign.errors import GradientError, ShapeError
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
    result = system(batch, objectives=objectives, probe=True)
    reached = [False] * len(wanted)
    for name, value in result.objectives.items():
        if value.numel() != 1:
            raise ShapeError(
                f"objective '{name}' has shape {tuple(value.shape)}; reduce it to one number, for example by mean()."
            )
        if not wanted:
            continue
        found = [None] * len(wanted)
        if value.requires_grad:
            found = torch.autograd.grad(value, wanted, retain_graph=True, allow_unused=True)
        if all(g is None for g in found):
            raise GradientError(
                f"objective '{name}' depends on none of the variables; {_where_cut(result)} Leave it out, or "
                "optimise something that it sees."
            )
        reached = [yes or g is not None for yes, g in zip(reached, found, strict=True)]
    for number, variable in enumerate(wanted):
        if not reached[number]:
            raise GradientError(
                f"no objective ({', '.join(result.objectives)}) depends on {_name(names, variable, number)}; leave "
                "it out of the optimiser, or add an objective that sees it."
            )
    return result


def _tensors(system: System, variables: Any) -> list[Tensor]:
    if variables is None:
        return [p for p in system.parameters() if p.requires_grad]
    if isinstance(variables, torch.optim.Optimizer):
        return [p for group in variables.param_groups for p in group["params"]]
    return list(variables)


def _name(names: dict[int, str], variable: Tensor, number: int) -> str:
    return f"variable '{names[id(variable)]}'" if id(variable) in names else f"variable {number}"


def _where_cut(result: Result) -> str:
    """A sentence that names the first junction without a gradient behind one that has it."""
    junctions = result.junctions or {}
    present = [name for name in JUNCTIONS if junctions.get(name)]
    had = False
    for name in present:
        has = any(t.requires_grad for t in junctions[name])
        if had and not has and name != "pose":
            return f"the graph is cut in the stage before junction '{name}'."
        had = had or has
    return (
        "no junction carries a gradient."
        if not had
        else "the objective itself does not use what carries one."
    )
