"""Training in one call."""

import dataclasses
import dis
import functools
import hashlib
import inspect
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from types import CodeType
from typing import Any

import torch
from torch import Tensor, nn

from codesign.checks import check_number, check_positive, check_whole
from codesign.errors import DomainError
from codesign.flow.entry import modes_kept
from codesign.interrupt import Interruption
from codesign.train import checkpoint, loop
from codesign.train.batches import Batches, Source, probe
from codesign.train.learner import Learner
from codesign.train.loop import Budget, Cosine, Progress
from codesign.train.objectives import Supervised, flow_predictions
from codesign.train.parallel import ALONE, Ranks

PLAIN = (bool, int, float, complex, str, bytes, type(None))


def fit(
    network: nn.Module,
    windows: Source | Sequence[tuple[float, Source]] | Callable[[int], Any],
    *,
    steps: int,
    batch: int = 8,
    loss: Callable[[Any, Any], Tensor] | None = None,
    predict: Callable[[Any, Any], Any] = flow_predictions,
    optimiser: torch.optim.Optimizer | None = None,
    schedule: Callable[[float], float] | None = None,
    clip: float = math.inf,
    average: float = 0.0,
    validate: Callable[[nn.Module], float] | None = None,
    validate_every: int = 1000,
    save_to: str | Path | None = None,
    save_every: int = 250,
    resume: bool = True,
    progress: Callable[[int, float], object] | None = None,
    seed: int = 0,
    ranks: Ranks = ALONE,
) -> Progress:
    """Train a flow network, or any nn.Module, in place.

    Ctrl-C ends the training between two steps, saved; the same call goes on from there and ends
    with the same weights bit for bit, on one machine with one number of threads, as long as
    ``windows`` gives the same batch at the same step.

    Args:
      network: nn.Module, on the device to train on. Flow networks have
        ``predictions(volume) -> [FlowField]`` or ``forward(volume) -> FlowField``.
      windows: a source, ``batch(indices) -> FlowWindows`` (codesign.flow.sources); a list of
        (share, source); or a function step -> batch of anything (codesign.train.Batches, to show
        windows several times).
      steps: number of steps, those of earlier calls included.
      batch: samples per step from a source.
      loss: (prediction, batch) -> scalar; ``Supervised()`` when None.
      predict: (network, batch) -> prediction.
      optimiser: torch optimiser over parameters of the network, all or some; AdamW with a step of
        2e-3 when None.
      schedule: share of the steps, 0 to 1 -> factor on its learning rates; ``Cosine()`` when None.
      clip: longest gradient; longer ones are shortened to it.
      average: decay of a running average of the weights, which is then judged and kept.
      validate: network, in evaluation mode -> score, lower is better (``error_ratio(source)``);
        called every ``validate_every`` steps and at the end. The network ends with the best weights
        that were judged, without ``validate`` with the last.
      validate_every: steps between judgements.
      save_to: folder of the checkpoint, written every ``save_every`` steps and at the end; None
        keeps none.
      save_every: steps between checkpoints.
      resume: go on from that checkpoint where there is one; it is started over when False.
      progress: told (steps made, loss) when a step is whole.
      seed: of what the network draws in a step (dropout).
      ranks: of several processes (``join()``, under torchrun); each takes its share of every batch
        of a source. A function of the step gives each process its share. The first process
        validates and saves.
    Returns: Progress: loss, gradient norm and learning rate by step, validation by step.
    Raises: DomainError for unfit numbers, optimisers or losses, FileFormatError for a checkpoint of
      another training: both before the first step. NonFiniteError when loss or gradient is not
      finite.

    >>> network, x = nn.Linear(1, 1), torch.linspace(-1, 1, 8)[:, None]
    >>> adam = torch.optim.Adam(network.parameters(), 0.1)
    >>> made = fit(network, lambda step: x, steps=300, predict=lambda network, x: network(x),
    ...            loss=lambda y, x: (y - 2 * x - 1).square().mean(), optimiser=adam)
    >>> [round(float(weight.detach()), 2) for weight in network.parameters()], made.step
    ([2.0, 1.0], 300)
    """
    numbers = {
        "steps": steps,
        "batch": batch,
        "validate_every": validate_every,
        "save_every": save_every,
    }
    for name, value in numbers.items():
        check_whole(value, name)
    if batch % ranks.count:
        raise DomainError(
            f"batch {batch} cannot be shared evenly by {ranks.count} processes; give a multiple."
        )
    if clip != math.inf:
        check_positive(clip, "clip")
    check_number(average, "average", 0.0, below=1.0)
    loss = loss or Supervised()
    schedule = schedule or Cosine()
    learner = Learner(
        network,
        loss,
        optimiser,
        predict=predict,
        clip=clip,
        average=average,
        validate=validate,
        ranks=ranks,
        seed=seed,
    )
    batches = _batches(windows, batch, loss, ranks)
    facts = _facts(learner, steps, batch, schedule)
    folder = None if save_to is None else Path(save_to)
    made = checkpoint.load(folder, learner, facts) if folder is not None and resume else None
    made = made or Progress()
    first = ranks.rank == 0

    def save():
        if folder is not None and first:
            checkpoint.save(folder, learner, made, facts)

    def after_step(share):
        if validate is not None and first and (made.step % validate_every == 0 or share >= 1.0):
            made.validation.append({"step": made.step, "score": learner.validate()})
        if made.step % save_every == 0 or share >= 1.0:
            save()
        if progress is not None and first:
            progress(made.step, made.loss[-1])
        # all stop at one step, whoever was asked
        if ranks.count > 1:
            interruption.requested = ranks.sum(float(interruption.requested))[0] > 0
        interruption.safe_point()

    with modes_kept(network), Interruption() as interruption:
        if not network.training:  # of one that trains, parts in evaluation stay there
            network.train()
        interruption.in_loop = True
        interruption.save = save
        loop.run(learner, batches, made, Budget(steps), schedule, after_step=after_step)
    learner.settle()
    return made


def _batches(windows: Any, batch, loss, ranks) -> Callable[[int], Any]:
    """A function of the step. Sources are looked at for what the loss needs."""
    if hasattr(windows, "batch") and not isinstance(windows, Batches):
        windows = [(1.0, windows)]
    if not isinstance(windows, Sequence):
        return windows
    for _, source in windows:
        if hasattr(loss, "check"):
            loss.check(probe(source))
    return Batches(windows, batch, mine=ranks.mine)


def _facts(learner, steps, batch, schedule):
    """What the numbers of a training depend on, as far as it can be written down."""
    network = learner.network
    groups = [
        {name: str(value) for name, value in group.items() if name != "params"}
        for group in learner.optimiser.param_groups
    ]
    return {
        "network": type(network).__qualname__,
        "config": {name: str(value) for name, value in getattr(network, "config", {}).items()},
        "seed": learner.seed,
        "schedule": {
            "steps": steps,
            "batch": batch,
            "loss": _name(learner.loss),
            "predict": _name(learner.predict),
            "optimiser": type(learner.optimiser).__name__,
            "groups": groups,
            "schedule": _name(schedule),
            "clip": str(learner.clip),
            "average": learner.average,
        },
        "functions": _told((learner.loss, learner.predict, schedule)),
        "torch": torch.__version__,
    }


def _name(value):
    """A name that another process gives to an equal thing."""
    if dataclasses.is_dataclass(value):
        return repr(value)
    return getattr(value, "__qualname__", type(value).__qualname__)


def _told(value):
    """What an equal thing of another process says of itself too: partials by their parts, functions
    by code, defaults and the plain values around them that they do not write; of others the name."""
    if isinstance(value, functools.partial):
        value = value.func, value.args, value.keywords
    if isinstance(value, CodeType):
        value = value.co_code, value.co_names, value.co_consts
    if isinstance(value, (dict, set, frozenset)):
        value = sorted(value.items() if isinstance(value, dict) else value, key=repr)
    if isinstance(value, (list, tuple)):
        return f"({', '.join(map(_told, value))})"
    if isinstance(value, PLAIN) or not hasattr(value, "__code__"):
        return repr(value) if isinstance(value, PLAIN) else _name(value)
    around = inspect.getclosurevars(value)
    plain = {n: v for n, v in (around.globals | around.nonlocals).items() if isinstance(v, PLAIN)}
    written = {op.argval for op in dis.get_instructions(value) if op.opname.startswith("STORE")}
    read = {n: v for n, v in plain.items() if n not in written}
    inside = _told((value.__code__, value.__defaults__, value.__kwdefaults__, read))
    return f"{_name(value)} {hashlib.sha256(inside.encode()).hexdigest()[:12]}"
