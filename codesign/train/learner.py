"""A network in training: steps on batches, a running average of the weights, and the best weights
seen."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from codesign.errors import DomainError, FileFormatError, NonFiniteError, ShapeError
from codesign.flow import checkpoint
from codesign.flow.entry import modes_kept
from codesign.optimise.gradients import scaled_rates
from codesign.train.batches import to_device
from codesign.train.objectives import flow_predictions
from codesign.train.parallel import ALONE, Ranks


@dataclass(frozen=True)
class Step:
    """What a step saw: loss and norm of the gradient before the weights moved, means over all
    processes; whether the gradient was shortened; the learning rate (of the optimiser's first
    group)."""

    loss: float
    norm: float
    clipped: bool
    rate: float


@dataclass(frozen=True)
class Best:
    """The lowest score so far, the number of steps before it, and the weights that had it."""

    score: float
    step: int
    weights: dict[str, Tensor]


def adamw(
    network: nn.Module, learning_rate: float = 2e-3, weight_decay: float = 1e-4
) -> torch.optim.Optimizer:
    """AdamW over the trainable weights of a network; biases and norms (one axis or none) do not
    decay."""
    trained = [parameter for parameter in network.parameters() if parameter.requires_grad]
    if not trained:
        raise DomainError(
            "the network has no weight that takes a gradient; unfreeze what is to be trained."
        )
    matrices = [parameter for parameter in trained if parameter.ndim > 1]
    others = [parameter for parameter in trained if parameter.ndim <= 1]
    groups = [
        {"params": matrices, "weight_decay": weight_decay},
        {"params": others, "weight_decay": 0.0},
    ]
    return torch.optim.AdamW([group for group in groups if group["params"]], lr=learning_rate)


class Learner:
    """A network with its optimiser, its loss and, where asked, a running average of its weights.

    A step depends on the learner's state and the batch alone: what a step draws from torch's global
    random numbers (dropout) is drawn from the seed and the step's number, and they are left as they
    were. Args:
      network: nn.Module, on the device to train on.
      loss: (prediction, batch) -> scalar.
      optimiser: over the network's parameters, all or some; ``adamw(network)`` when None.
      predict: (network, batch) -> prediction.
      clip: longest gradient; longer ones are shortened to it.
      average: decay per step of a running average of the weights, which is then what is judged and
        kept; 0 for none.
      validate: network, in evaluation mode -> score, lower is better; None when nobody judges.
      ranks: this process among those that train.
      seed: of the random numbers within a step.
      mixed_precision: bfloat16 where it is safe, in ``predict`` alone; CUDA only.
    Raises: DomainError for an optimiser of other or frozen parameters.
    """

    def __init__(
        self,
        network: nn.Module,
        loss: Callable[[Any, Any], Tensor],
        optimiser: torch.optim.Optimizer | None = None,
        *,
        predict: Callable[[Any, Any], Any] = flow_predictions,
        clip: float = math.inf,
        average: float = 0.0,
        validate: Callable[[nn.Module], float] | None = None,
        ranks: Ranks = ALONE,
        seed: int = 0,
        mixed_precision: bool = False,
    ):
        if ranks.count > 1:  # gradients are averaged, so all begin with the same weights
            network.load_state_dict(ranks.tell(network.state_dict()))
        self.network = network
        self.loss = loss
        self.predict = predict
        self.optimiser = optimiser or adamw(network)
        self.clip = clip
        self.average = average
        self.ranks = ranks
        self.steps = 0
        self.best: Best | None = None
        self._judge = validate
        self.seed = seed
        self._mixed_precision = mixed_precision
        self._names = _names(network, self.optimiser)
        self.parameters = [p for name, p in network.named_parameters() if name in set(self._names)]
        self.device = self.parameters[0].device
        self.averaged: nn.Module | None = (
            copy.deepcopy(network).requires_grad_(False) if average > 0 else None
        )

    @property
    def delivered(self) -> nn.Module:
        """The network to judge and to keep: the running average where there is one."""
        return self.network if self.averaged is None else self.averaged

    def step(self, batch: Any, factor: float = 1.0) -> Step:
        """One step of the optimiser on a batch, with its learning rates times ``factor``.

        Raises: NonFiniteError when loss or gradient is not finite; the weights are then those
          before the step. DomainError or ShapeError for a loss without gradient or of several
          values.
        """
        batch = to_device(batch, self.device)
        loss = self._loss(batch)
        self.optimiser.zero_grad()  # a weight that the loss does not reach has none and stays
        loss.backward()
        self.ranks.average_gradients(self.parameters)
        norm = float(torch.nn.utils.clip_grad_norm_(self.parameters, self.clip))
        (mean,) = self.ranks.sum(float(loss.detach()) / self.ranks.count)
        if not (math.isfinite(norm) and math.isfinite(mean)):
            raise NonFiniteError(
                f"step {self.steps}: loss {mean:.4g}, gradient norm {norm:.4g}; lower the learning rate, or "
                "look for the window that causes it."
            )
        with scaled_rates(self.optimiser, factor):
            rate = float(self.optimiser.param_groups[0]["lr"])
            made = Step(mean, norm, norm > self.clip, rate)
            self.optimiser.step()
        self._follow()
        self.steps += 1
        return made

    def validate(self) -> float:
        """Score of the delivered network; the best one so far is kept.

        Raises: NonFiniteError for a score that is not finite.
        """
        if self._judge is None:
            raise DomainError("this learner has nothing to judge by; give it validate=.")
        network = self.delivered
        with torch.no_grad(), modes_kept(network):
            score = float(self._judge(network.eval()))
        if not math.isfinite(score):
            raise NonFiniteError(
                f"step {self.steps}: the validation gave {score}; lower the learning rate."
            )
        if self.best is None or score < self.best.score:
            weights = {
                name: tensor.detach().clone() for name, tensor in network.state_dict().items()
            }
            self.best = Best(score, self.steps, weights)
        return score

    def settle(self) -> None:
        """Give the network the weights to keep: the best that were judged, else the running
        average, on every process."""
        kept = None if self.best is None else self.best.weights
        if kept is None and self.averaged is not None:
            kept = self.averaged.state_dict()
        kept = self.ranks.tell(kept)
        if kept is not None:
            self.network.load_state_dict(kept)

    def state_dict(self) -> dict[str, Tensor]:
        """All tensors of the state by name."""
        found = {f"weights/{name}": tensor for name, tensor in self.network.state_dict().items()}
        if self.averaged is not None:
            found |= {
                f"average/{name}": tensor for name, tensor in self.averaged.state_dict().items()
            }
        for index, moments in self.optimiser.state_dict()["state"].items():
            for moment, value in moments.items():
                if isinstance(value, Tensor):
                    found[f"optimiser/{moment}/{self._names[index]}"] = value
                elif value is not None:
                    raise DomainError(
                        f"{type(self.optimiser).__name__} keeps '{moment}', which is no tensor and cannot be "
                        "stored; choose another optimiser, or do not save."
                    )
        if self.best is not None:
            found |= {f"best/weights/{name}": tensor for name, tensor in self.best.weights.items()}
            found["best/score"] = torch.tensor(self.best.score, dtype=torch.float64)
            found["best/step"] = torch.tensor(self.best.step)
        found["steps"] = torch.tensor(self.steps)
        rates = [float(group["lr"]) for group in self.optimiser.param_groups]
        found["rates"] = torch.tensor(rates, dtype=torch.float64)
        found["kind"] = torch.tensor(
            list(type(self.optimiser).__name__.encode()), dtype=torch.uint8
        )
        return found

    def load_state_dict(self, tensors: dict[str, Tensor], path: Any = "the state") -> None:
        """Take over what ``state_dict`` gave; ``path`` is named in errors.

        Raises: FileFormatError when it is not of this network and optimiser.
        """
        kind = type(self.optimiser).__name__
        stored = (
            bytes(tensors["kind"].tolist()).decode(errors="replace") if "kind" in tensors else kind
        )
        if stored != kind:
            raise FileFormatError(
                f"'{path}' is of the optimiser {stored}, this run has {kind}; go on with the same one."
            )
        parts: dict[str, dict[str, Tensor]] = {
            "weights": {},
            "average": {},
            "optimiser": {},
            "best": {},
        }
        for name, tensor in tensors.items():
            kind, _, rest = name.partition("/")
            parts.setdefault(kind, {})[rest] = tensor
        checkpoint.fill(self.network, parts["weights"], path)
        if self.averaged is not None:
            checkpoint.fill(self.averaged, parts["average"], path)
        elif parts["average"]:
            raise FileFormatError(
                f"'{path}' has a running average of the weights, this learner keeps none; give it average=."
            )
        self._fill_optimiser(parts["optimiser"], path)
        for group, rate in zip(
            self.optimiser.param_groups, tensors.get("rates", torch.empty(0)).tolist(), strict=False
        ):
            group["lr"] = rate
        try:
            self.steps = int(tensors["steps"])
            best = parts["best"]
            if best:
                weights = {name: best[f"weights/{name}"] for name in self.network.state_dict()}
                self.best = Best(float(best["score"]), int(best["step"]), weights)
        except KeyError as error:
            raise FileFormatError(f"'{path}' lacks {error}; start a new run.") from error

    def _loss(self, batch):
        cards = [self.device] if self.device.type == "cuda" else []
        with torch.random.fork_rng(devices=cards):
            seed = (1_000_003 * self.seed + self.steps) * self.ranks.count + self.ranks.rank
            torch.default_generator.manual_seed(seed % 2**63)
            if cards:
                torch.cuda.manual_seed(seed % 2**63)
            with torch.autocast(self.device.type, torch.bfloat16, enabled=self._mixed_precision):
                prediction = self.predict(self.network, batch)
            loss = self.loss(prediction, batch)
        if loss.numel() != 1:
            raise ShapeError(
                f"the loss has shape {tuple(loss.shape)}; it must be one number, such as a mean."
            )
        if not loss.requires_grad:
            raise DomainError(
                "the loss does not depend on the network's weights; look for a detach, a no_grad or an "
                "integer on the way."
            )
        return loss

    @torch.no_grad()
    def _follow(self):
        """Move the running average; early on it spans a tenth of the steps made, so that the first
        weights fade."""
        if self.averaged is None:
            return
        decay = min(self.average, (1 + self.steps) / (10 + self.steps))
        pairs = zip(
            self.averaged.state_dict().values(), self.network.state_dict().values(), strict=True
        )
        # a weight under two names moves once
        of = {(held.data_ptr(), held.shape, held.stride()): (held, now) for held, now in pairs}
        for held, now in of.values():
            held.copy_(held + (1 - decay) * (now - held) if held.is_floating_point() else now)

    def _fill_optimiser(self, tensors, path):
        held: dict[str, dict[str, Tensor]] = {}
        moved = _moved(self.optimiser)
        axes = {name: weight.ndim for name, weight in zip(self._names, moved, strict=True)}
        for name, tensor in tensors.items():
            moment, _, weight = name.partition("/")
            held.setdefault(weight, {})[moment] = tensor
        # of weights of as many axes: Adafactor keeps others of a matrix than of a vector
        moments: dict[int | None, set[str]] = {}
        for weight, found in held.items():
            moments.setdefault(axes.get(weight), set()).update(found)
        for weight, found in held.items():
            lost = sorted(moments[axes.get(weight)] - set(found))
            if weight not in self._names or lost:
                raise FileFormatError(
                    f"'{path}' does not fit this optimiser (weight '{weight}', "
                    f"{f'without {lost[0]}' if lost else 'which it does not move'}); start a new run."
                )
        state = {index: held[name] for index, name in enumerate(self._names) if name in held}
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": state})
        # numbers keep their dtype, which torch takes from the weights
        for index, own in state.items():
            numbers = {name: value.clone() for name, value in own.items() if value.ndim == 0}
            self.optimiser.state[moved[index]].update(numbers)


def _moved(optimiser):
    return [parameter for group in optimiser.param_groups for parameter in group["params"]]


def _names(network, optimiser):
    """Names of the weights that an optimiser moves, in its order."""
    if isinstance(optimiser, torch.optim.LBFGS):
        raise DomainError(
            "LBFGS asks for the loss several times a step; choose an optimiser that asks once."
        )
    known = {id(parameter): name for name, parameter in network.named_parameters()}
    moved = _moved(optimiser)
    if any(id(parameter) not in known for parameter in moved):
        raise DomainError(
            "the optimiser has parameters that are not the network's; put all that is trained into one "
            "nn.Module, and make the optimiser of its parameters."
        )
    frozen = [known[id(parameter)] for parameter in moved if not parameter.requires_grad]
    if frozen:
        raise DomainError(
            f"the optimiser has the frozen weight '{frozen[0]}'; leave it out, or let it take a gradient "
            "with requires_grad_(True)."
        )
    return [known[id(parameter)] for parameter in moved]
