"""Whether the gradient passes through every stage.

One vector-Jacobian product from what each stage makes to each thing that it gets. Where that gives
nothing, differences
judge: an input is cut when the output follows it smoothly all the same. A mask or an argument that
is not used passes, and so does a zero-initialised layer, whose output does not follow yet.
"""

import copy
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor

from codesign.errors import CodesignError, GradientError
from codesign.pose import se3_exp
from codesign.system.contents import hidden_tensors, mapped
from codesign.system.result import tensors_of
from codesign.system.run import Pass
from codesign.system.stage import label, modules_of

# relative; metres and radians for poses. Over twice the step a smooth output changes twice as much
STEP = 1e-3
STRAIGHT = 0.2  # by how much, relative, it may differ from that
FAR = 0.5  # a step in which hard stages show, too, that they follow
STAGES = {
    "camera": ("rays", "rays"),
    "mount": ("T_body_cam", "pose"),
    "trajectory": ("T_world_body", "pose"),
    "render": ("frames", "frames"),
    "events": ("volume", "events"),
    "flow": ("field", "flow"),
    "estimate": ("estimate", "estimate"),
}
"""Stage -> what it makes, and the junction where that stands."""
_POSES = ("T_body_cam", "T_world_body", "T_world_cam")
_READ = ("estimate", "field", "volume", "frames", "rays", *_POSES)


class _Way(NamedTuple):
    """A way into a stage: its name, the tensor that the gradient should reach, the leaf that stands
    for it where others lie between, and where it is: the name of what is given, or of what is made
    anew from parameters."""

    name: str
    tensor: Tensor
    leaf: Tensor
    at: str | tuple[str, ...]


def check_stages(run: Pass, wanted: Sequence[Tensor], may_cut: Sequence[str]) -> None:
    """Raise GradientError naming a stage that passes no gradient on, or not from one of its inputs
    or parameters, although variables lie before it."""
    for stage, (output, junction) in STAGES.items():
        part = getattr(run.system, stage)
        made = output in run.made and junction not in run.recorded and stage not in may_cut
        if not made or (part is None and stage != "render") or not _main(output, run.made[output]):
            continue
        direct = _alone(run, stage, output)
        inputs, own = _ways(run, direct, stage, output, wanted)
        ways = [*inputs, *own]
        outputs = [t for t in _main(output, direct.made[output]) if t.requires_grad]
        found = dict(
            zip(
                (way.name for way in ways),
                _products(outputs, [way.leaf for way in ways]),
                strict=True,
            )
        )
        outer = {way.name for way in inputs}
        silent = [way for way in ways if not found[way.name] and _carries(way.tensor, wanted)]
        named = f"stage '{stage}'" if part is None else f"stage '{stage}' ({label(part)})"
        meant = f"say check(..., may_cut=('{stage}',)) where it is meant"
        if not any(found[way.name] for way in inputs) and any(way.name in outer for way in silent):
            before = f"the objectives cannot see what lies before junction '{junction}': {named} passes no gradient on"
            if all(found[way.name] is None for way in inputs):
                raise GradientError(
                    f"{before} (a detach, a no_grad, or a hard sensor); exchange that stage, or {meant}."
                )
            if any(
                _follows(run, output, (way.tensor,), way.at, FAR)
                for way in silent
                if way.name in outer
            ):
                raise GradientError(
                    f"{before}: it is exactly 0, though what it makes follows its input (rounding, a hard comparison, "
                    f"saturation, or thresholds that this batch does not reach); exchange that stage, or {meant}."
                )
            silent = [way for way in silent if way.name not in outer]
        # a zero-initialised layer silences all weights before it: first moved together, each alone
        # if that shows
        together = tuple(way.tensor for way in silent if not way.at)
        if together and not _follows(run, output, together, (), STEP):
            silent = [way for way in silent if way.at]
        cut = [
            way.name
            for way in silent
            if part is not None and _follows(run, output, (way.tensor,), way.at)
        ]
        if cut:
            raise GradientError(
                f"{named} cuts the gradient of {' and '.join(cut)}: what it makes follows them, but no gradient comes "
                f"back (a detach, a no_grad, a float()); mend it, or {meant}."
            )


def check_objective(run: Pass, name: str, value: Tensor, wanted: Sequence[Tensor]) -> None:
    """Raise GradientError for an objective that follows the last junction it reads, but passes no
    gradient to it."""
    latest = next((each for each in _READ[:5] if each in run.asked[f"objective {name}"]), None)
    tensors = (
        ()
        if latest is None
        else tuple(t for t in _main(latest, run.made[latest]) if t.requires_grad)
    )
    if latest is None or not value.requires_grad or any(_products([value], tensors)):
        return
    known = any(_carries(tensor, wanted) for tensor in tensors)
    if known and _follows(run, None, tensors, latest, ask=lambda twin: twin.objective(name)):
        raise GradientError(
            f"objective '{name}' cuts the gradient of its '{latest}': its value follows it, but no gradient comes back "
            "(a detach, a no_grad, a float()); mend the objective."
        )


def _ways(run, direct, stage, output, wanted) -> tuple[list[_Way], list[_Way]]:
    """Ways in from what the stage gets, and from its own parameters."""
    part = getattr(run.system, stage)
    asked = ("camera",) if stage == "camera" else run.asked.get(stage, ())
    ways = []
    if "camera" in asked:
        lens = run["camera"].lens
        named = lens.named_parameters() if isinstance(lens, torch.nn.Module) else ()
        names = {id(p): name for name, p in named}
        anew = ("camera", "rays") if output == "rays" or "rays" not in asked else ("camera",)
        ways = [
            _Way(f"the lens ({names.get(id(t), 'computed')})", t, t, anew)
            for t in run.junctions["lens"]
        ]
    for name in (name for name in asked if name in _READ and name in run.made):
        pairs = zip(_main(name, run.made[name]), _main(name, direct.made[name]), strict=True)
        for number, (tensor, leaf) in enumerate(pairs):
            field = (".origin_m", ".direction", ".weight")[number] if name == "rays" else ""
            ways.append(_Way(f"'{name}{field}'", tensor, leaf, name))
    learnt = {id(tensor) for tensor in wanted} - {id(way.tensor) for way in ways}
    named = [pair for module in modules_of(part) for pair in module.named_parameters()]
    named = named or hidden_tensors(part)
    own = [
        _Way(f"its own '{name}'", tensor, tensor, ())
        for name, tensor in named
        if id(tensor) in learnt
    ]
    return [way for way in ways if way.tensor.requires_grad], own


def _main(name: str, value: Any) -> tuple[Tensor, ...]:
    return tensors_of({"volume": "events", "field": "flow"}.get(name, name), value)


def _products(outputs: Sequence[Tensor], inputs: Sequence[Tensor]) -> list[bool | None]:
    """Whether a random vector's product with the Jacobian is other than 0, per input; None without
    a way back."""
    if not outputs or not inputs:
        return [None] * len(inputs)
    draw = torch.Generator().manual_seed(0)
    vectors = [torch.randn(t.shape, generator=draw, dtype=torch.float64).to(t) for t in outputs]
    found = torch.autograd.grad(outputs, inputs, vectors, retain_graph=True, allow_unused=True)
    return [None if gradient is None else bool(gradient.any()) for gradient in found]


def _carries(tensor: Tensor, wanted: Sequence[Tensor]) -> bool:
    """Whether a tensor depends on a variable, or is one."""
    return any(tensor is each for each in wanted) or (
        not tensor.is_leaf and any(found is not None for found in _products([tensor], wanted))
    )


def _alone(run: Pass, stage: str, output: str) -> Pass:
    """The pass whose output has its own way to every input. Where one input is made of another, the
    stage runs once more, on leaves."""
    names = [name for name in run.asked.get(stage, ()) if name in _READ and name in run.made]
    if stage not in ("events", "flow", "estimate") or len(names) < 2:
        return run
    leaves = {
        name: mapped(run.made[name], lambda t: t.detach().requires_grad_(t.requires_grad))
        for name in names
    }
    twin = _twin(run, output, leaves, ())
    with torch.random.fork_rng(devices=[]):
        twin[output]
    return twin


def _twin(run: Pass, output: str | None, instead: dict[str, Any], anew: tuple[str, ...]) -> Pass:
    """The pass before an output was made, with other values in it."""
    twin = copy.copy(run)
    twin.junctions = None
    twin.made = {
        key: v for key, v in run.made.items() if key not in (output, "generator", *anew)
    } | instead
    return twin


def _follows(
    run: Pass,
    output: str | None,
    tensors: tuple[Tensor, ...],
    at: str | tuple[str, ...],
    far: float | None = None,
    ask: Callable[[Pass], Tensor] | None = None,
) -> bool:
    """Whether an output changes in proportion to a small step of tensors; with ``far``, whether it
    changes at all."""

    def moved(step: float) -> Tensor:
        instead = {}
        if isinstance(at, str):
            chosen = {id(tensor) for tensor in tensors}
            instead[at] = mapped(
                run.made[at], lambda t: _step(at, t, step) if id(t) in chosen else t
            )
        twin = _twin(run, output, instead, () if isinstance(at, str) else at)
        with nudged(() if instead else tensors, step), torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            found = twin[output or ""] if ask is None else ask(twin)
        return torch.cat([t.detach().double().flatten() for t in _main(output or "", found)])

    try:
        steps = (0.0, STEP, 2 * STEP) if far is None else (0.0, far)
        start, *others = map(moved, steps)
    except CodesignError:  # moved out of what the stage takes: nothing is proven
        return False
    if any(other.shape != start.shape for other in others) or not bool((others[0] - start).any()):
        return False
    once, twice = others[0] - start, others[-1] - start
    return far is not None or float((twice - 2 * once).norm()) <= STRAIGHT * float(twice.norm())


def _step(name: str, tensor: Tensor, step: float) -> Tensor:
    """A tensor moved: poses as rigid motions, unit vectors turned, others in proportion, so that
    what is 0 or positive stays so."""
    draw = torch.Generator().manual_seed(1)
    if name in _POSES:
        return tensor.detach() @ se3_exp(
            min(step, 0.05) * torch.randn(6, generator=draw).double()
        ).to(tensor)
    noise = 2 * torch.rand(tensor.shape, generator=draw, dtype=torch.float64).to(tensor) - 1
    moved = tensor.detach() * (1 + step * noise)
    turned = (
        name == "rays" and tensor.ndim == 2 and bool((tensor.norm(dim=1) - 1).abs().max() < 1e-3)
    )
    return moved / moved.norm(dim=1, keepdim=True) if turned else moved


@contextmanager
def nudged(tensors: Sequence[Tensor], step: float) -> Iterator[None]:
    """Parameters moved by a step of their size, for a while; torch counts no change, so graphs stay
    whole."""
    draw = torch.Generator().manual_seed(2)
    kept = [tensor.data.clone() for tensor in tensors]
    try:
        for tensor, value in zip(tensors, kept, strict=True):
            size = float(value.double().square().mean().sqrt()) or 1.0
            tensor.data += (
                step
                * size
                * torch.randn(value.shape, generator=draw, dtype=torch.float64).to(value)
            )
        yield
    finally:
        for tensor, value in zip(tensors, kept, strict=True):
            tensor.data.copy_(value)
