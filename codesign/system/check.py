"""What to ask of a system before the first step: do its stages fit, and does every variable reach
an objective?"""

import contextlib
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from codesign.errors import CodesignError, DomainError, GradientError, NonFiniteError, ShapeError
from codesign.system.contents import hidden_tensors
from codesign.system.layout import warn
from codesign.system.result import Result
from codesign.system.run import Pass
from codesign.system.stage import label
from codesign.system.system import System
from codesign.system.through import STAGES, check_objective, check_stages, nudged

NUDGE = 1e-2  # relative step to a point beside, where variables without a gradient are asked again


def check(
    system: System,
    batch: Any,
    variables: "torch.optim.Optimizer | Iterable[Tensor] | None" = None,
    objectives: tuple[str, ...] | None = None,
    *,
    recorded: Mapping[str, Any] | None = None,
    may_cut: tuple[str, ...] = (),
) -> Result:
    """Run one pass, and raise or warn with one sentence where something does not fit.

    What a stage passes on is proven: one vector-Jacobian product from what it makes to what it
    gets, and where that is nothing, differences (the stage three times more). What that cost is
    ``check_passes`` of the Result, in passes. Args:
      variables: what will be optimised: an optimiser, or its tensors; the system's parameters that
        ask for gradients when None.
      objectives: names of those in use; all when None.
      recorded: as for the System.
      may_cut: stages that pass no gradient on, or not all of it, on purpose.
    Returns: the probed Result of the pass.
    Raises: ShapeError, DomainError where stages, batch and scene do not fit, or a stage changes in
      place what it is given; GradientError for a stage that cuts the gradient of what is optimised,
      tensors that a function hides from the system, a frozen variable, one that no objective
      depends on, or an objective that is no scalar or depends on none; NonFiniteError naming a
      junction.
    Warns: of variables whose gradient is exactly 0; of frames on 0 to 1 and times in milliseconds.
    """
    began = time.perf_counter()
    unknown = sorted(set(may_cut) - set(STAGES))
    if isinstance(may_cut, str) or unknown:
        raise DomainError(f"may_cut is {may_cut!r}; give a tuple of stages: {', '.join(STAGES)}.")
    names = {id(p): name for name, p in system.named_parameters()}
    wanted = _tensors(system, variables)
    for name, parameter in system.named_parameters():
        if parameter.is_meta:
            raise DomainError(
                f"'{name}' is on the device meta, without values; move it to cpu or cuda and fill it."
            )
    for number, variable in enumerate(wanted):
        if not variable.requires_grad:
            raise GradientError(
                f"{_name(names, variable, number)} is frozen but was handed to the optimiser; thaw it with "
                "requires_grad_(True), or leave it out."
            )
    _check_hidden(system, wanted, objectives)
    run = system.begin(batch, recorded)
    if hasattr(run["camera"], "check"):
        run["camera"].check()
    _check_fresh(system)
    start = time.perf_counter()
    run = system.begin(batch, recorded, probe=True)
    result = run.result({name: run.objective(name) for name in system.chosen(objectives)})
    pass_s = time.perf_counter() - start
    for name, value in result.objectives.items():
        if value.numel() != 1:
            raise ShapeError(
                f"objective '{name}' has shape {tuple(value.shape)}; reduce it to one number, for example by mean()."
            )
        if not bool(value.detach().isfinite()):
            raise NonFiniteError(
                f"objective '{name}' is {float(value.detach())}; the objective itself has the cause."
            )
    if wanted:
        check_stages(run, wanted, may_cut)
        _check_reach(run, result.objectives, wanted, names, variables is not None)
    return replace(result, check_passes=(time.perf_counter() - began) / pass_s)


def _check_reach(run: Pass, objectives: dict[str, Tensor], wanted, names, given: bool) -> None:
    """Raise GradientError for objectives and variables that have nothing to do with one another;
    warn of variables that move nothing in this batch."""
    reached = [False] * len(wanted)
    felt = [False] * len(wanted)
    for name, value in objectives.items():
        check_objective(run, name, value, wanted)
        found = _gradients(value, wanted)
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
        felt = [
            yes or (g is not None and bool(g.any())) for yes, g in zip(felt, found, strict=True)
        ]
    for number, variable in enumerate(wanted if given else []):
        if not reached[number]:
            stale = (
                ""
                if id(variable) in names
                else " (no parameter of the system: made before its variables?)"
            )
            raise GradientError(
                f"no objective ({', '.join(objectives)}) depends on {_name(names, variable, number)}{stale}; "
                "leave it out of the optimiser, or add an objective that sees it."
            )
    still = [number for number, yes in enumerate(felt) if reached[number] and not yes]
    if still:  # beside the point as well? Layers behind a zero-initialised one wake up there
        beside = run.system.begin(run["batch"], run.recorded)
        totals = []
        # a point that stages refuse tells nothing
        with (
            nudged(wanted, NUDGE),
            contextlib.suppress(CodesignError),
        ):
            totals = [_gradients(beside.objective(name), wanted) for name in objectives]
        still = [n for n in still if not any(g[n] is not None and bool(g[n].any()) for g in totals)]
    if still:
        more = f" and {len(still) - 1} more" if len(still) > 1 else ""
        warn(
            f"the gradient of {_name(names, wanted[still[0]], still[0])}{more} is exactly 0, here and beside: nothing "
            "that it moves is seen in this batch; leave it out, or give a batch that shows it."
        )


def _gradients(value: Tensor, wanted) -> list[Tensor | None]:
    if not value.requires_grad:
        return [None] * len(wanted)
    return list(torch.autograd.grad(value, wanted, retain_graph=True, allow_unused=True))


def _check_hidden(system: System, wanted: list[Tensor], objectives: tuple[str, ...] | None) -> None:
    """Raise GradientError for a stage with tensors of its own that the system does not know, unless
    they are optimised all the same, or only some of the system's are."""
    learnable = {id(p) for p in system.parameters() if p.requires_grad}
    if not learnable <= {id(tensor) for tensor in wanted}:
        return
    known = {id(p) for p in (*system.parameters(), *wanted)}
    parts = {name: getattr(system, name) for name in STAGES}
    parts |= {
        f"objective {name}": system.named_objectives[name] for name in system.chosen(objectives)
    }
    for name, part in parts.items():
        found = [
            (owner, tensor) for owner, tensor in hidden_tensors(part) if id(tensor) not in known
        ]
        if found:
            raise GradientError(
                f"stage '{name}' ({label(part)}) holds {found[0][0]} where the system does not see it "
                f"({len(found)} tensor(s) that ask for gradients): hand over the Module itself, its method, or "
                "functools.partial(function, module); or freeze it, or give it to the optimiser."
            )


def _check_fresh(system: System) -> None:
    """Raise GradientError for a lens whose tensors were computed once from variables: a second
    backward pass would go through a graph that is gone."""
    lens = system.camera.lens if hasattr(system.camera, "rays") else None
    buffers = list(lens.buffers()) if isinstance(lens, torch.nn.Module) else []
    if any(tensor.grad_fn is not None for tensor in buffers):
        raise GradientError(
            "stage 'camera': its lens was computed once from other tensors (focus_at, replace), so only one step could "
            "go back through it; use variables(..., focus_at_m=...), or give camera as a function that makes it anew."
        )


def _tensors(system: System, variables: Any) -> list[Tensor]:
    if variables is None:
        return [p for p in system.parameters() if p.requires_grad and p.numel()]
    if isinstance(variables, torch.optim.Optimizer):
        # a lens without aspheres has a parameter without numbers for them
        return [p for group in variables.param_groups for p in group["params"] if p.numel()]
    found = [variables] if torch.is_tensor(variables) else list(variables)
    other = next((each for each in found if not torch.is_tensor(each)), None)
    if other is not None or not found:
        given = "no variable" if not found else f"a {type(other).__name__} among the variables"
        raise DomainError(f"check was given {given}; give an optimiser, or its tensors.")
    return found


def _name(names: dict[int, str], variable: Tensor, number: int) -> str:
    return f"variable '{names[id(variable)]}'" if id(variable) in names else f"variable {number}"
