"""The state of a training run: tensors in safetensors, numbers in JSON, kept so that a resumed run gives the
same numbers bit for bit."""

import contextlib
import copy
import json
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import nn

from codesign.atomic import write_atomic
from codesign.errors import FileFormatError
from codesign.flow import checkpoint

VERSION = 1
MOMENTS = ("step", "exp_avg", "exp_avg_sq")  # of AdamW


@dataclass
class Progress:
    """What a training run has done so far.

    step: steps made. data_s, training_s: processor seconds of all processes, for making windows and for the
      rest of the steps. validation_s: those of the
    first process for validation. clipped: steps whose gradient was shortened. blind: windows shown that had
      no pixel with known flow. loss, norm, rate: by step. validation: list of {"step", set: figures}.
    """

    step: int = 0
    data_s: float = 0.0
    training_s: float = 0.0
    validation_s: float = 0.0
    clipped: int = 0
    blind: int = 0
    loss: list[float] = field(default_factory=list)
    norm: list[float] = field(default_factory=list)
    rate: list[float] = field(default_factory=list)
    validation: list[dict] = field(default_factory=list)


class Learner:
    """A network with its optimiser and, where asked, a running average of its weights.

    Args: name: of the network. network: nn.Module with ``config``. average: decay of the running average per
      step, 0 for none.
    """

    def __init__(self, name, network, learning_rate, weight_decay, average=0.0):
        self.name = name
        self.network = network
        self.average = average
        self.parameters = [parameter for parameter in network.parameters() if parameter.requires_grad]
        matrices = [parameter for parameter in self.parameters if parameter.ndim > 1]
        others = [
            parameter for parameter in self.parameters if parameter.ndim <= 1
        ]  # biases and norms do not decay
        groups = [{"params": matrices, "weight_decay": weight_decay}, {"params": others, "weight_decay": 0.0}]
        self.optimiser = torch.optim.AdamW([group for group in groups if group["params"]], lr=learning_rate)
        self.averaged: nn.Module | None = (
            copy.deepcopy(network).requires_grad_(False) if average > 0 else None
        )

    @property
    def delivered(self):
        """The network to judge and to keep."""
        return self.network if self.averaged is None else self.averaged

    @torch.no_grad()
    def follow(self, step):
        """Move the running average; early on it spans a tenth of the steps made, so that the first weights
        fade."""
        if self.averaged is None:
            return
        decay = min(self.average, (1 + step) / (10 + step))
        for held, now in zip(
            self.averaged.state_dict().values(), self.network.state_dict().values(), strict=True
        ):
            held.copy_(held + (1 - decay) * (now - held) if held.is_floating_point() else now)

    def tensors(self):
        """All tensors of the state by name."""
        found = {f"weights/{name}": tensor for name, tensor in self.network.state_dict().items()}
        if self.averaged is not None:
            found |= {f"average/{name}": tensor for name, tensor in self.averaged.state_dict().items()}
        for name, parameter in self.network.named_parameters():
            for moment, tensor in self.optimiser.state.get(parameter, {}).items():
                found[f"optimiser/{moment}/{name}"] = tensor
        return found

    def fill(self, tensors, path):
        """Take over the tensors of a checkpoint.

        Raises: FileFormatError when they are not of this network and optimiser.
        """
        parts: dict[str, dict[str, torch.Tensor]] = {"weights": {}, "average": {}, "optimiser": {}}
        for name, tensor in tensors.items():
            kind, _, rest = name.partition("/")
            parts.setdefault(kind, {})[rest] = tensor
        checkpoint.fill(self.network, parts["weights"], path)
        if self.averaged is not None:
            checkpoint.fill(self.averaged, parts["average"], path)
        for name, parameter in self.network.named_parameters():
            held = {
                moment: parts["optimiser"][f"{moment}/{name}"]
                for moment in MOMENTS
                if f"{moment}/{name}" in parts["optimiser"]
            }
            missing = [moment for moment in MOMENTS if moment not in held]
            if missing and len(missing) < len(MOMENTS):
                raise FileFormatError(f"'{path}' lacks '{missing[0]}' of weight '{name}'; start a new run.")
            if not missing:
                self.optimiser.state[parameter] = {
                    moment: tensor.clone() if moment == "step" else tensor.to(parameter.device)
                    for moment, tensor in held.items()
                }


def save(folder: Path, learner: Learner, progress: Progress, facts: dict):
    """Write a checkpoint: tensors under a new name first, then checkpoint.json, which names them; a run cut
    short in between keeps the earlier one.

    Args: facts: plain values that say what the run is (seed, schedule, versions).
    Raises: CodesignError when the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    curves = {
        f"curve/{name}": torch.tensor(getattr(progress, name), dtype=torch.float64)
        for name in ("loss", "norm", "rate")
    }
    file = f"step_{progress.step:07d}.safetensors"
    checkpoint.write_tensors(
        folder / file, {**learner.tensors(), **curves}, {"kind": "training", "step": progress.step}
    )
    numbers = {
        name: getattr(progress, name)
        for name in ("step", "data_s", "training_s", "validation_s", "clipped", "blind", "validation")
    }
    stored = {
        "version": VERSION,
        "tensors": file,
        "network": learner.name,
        "config": learner.network.config,
        "progress": numbers,
        **facts,
    }
    write_atomic(folder / "checkpoint.json", json.dumps(stored, indent=2, allow_nan=False).encode())
    for old in folder.glob("step_*.safetensors"):
        if old.name != file:
            with contextlib.suppress(OSError):  # a file too many does no harm
                old.unlink()


def load(folder: Path, learner: Learner, facts: dict):
    """Fill ``learner`` from a checkpoint; returns its Progress, or None when the folder has none.

    Raises: FileFormatError when it is damaged, of another version, of another network, or of a run with other
      facts.
    """
    path = folder / "checkpoint.json"
    if not path.exists():
        return None
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        version = stored["version"]
        file = str(stored["tensors"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FileFormatError(
            f"'{path}' is damaged ({type(error).__name__}: {error}); start a new run."
        ) from error
    if version != VERSION:
        raise FileFormatError(
            f"'{path}' has format version {version}, this codesign reads version {VERSION}; go on with the "
            "codesign that wrote it, or start a new run."
        )
    expected = {"network": learner.name, "config": json.loads(json.dumps(learner.network.config)), **facts}
    for name, value in expected.items():
        if stored.get(name) != value:
            raise FileFormatError(
                f"'{path}' was written with {name} {stored.get(name)}, this run has {value}; start a new run."
            )
    if Path(file).name != file:
        raise FileFormatError(f"'{path}' names a file outside its folder ('{file}'); start a new run.")
    tensors, content = checkpoint.read_tensors(folder / file)
    try:
        progress = Progress(**stored["progress"])
        curves = {name: tensors.pop(f"curve/{name}").tolist() for name in ("loss", "norm", "rate")}
    except (KeyError, TypeError) as error:
        raise FileFormatError(
            f"'{path}' is damaged ({type(error).__name__}: {error}); start a new run."
        ) from error
    if content.get("step") != progress.step or any(len(curve) != progress.step for curve in curves.values()):
        raise FileFormatError(f"'{path}' and '{file}' are of different steps; start a new run.")
    learner.fill(tensors, folder / file)
    progress.loss = curves["loss"]
    progress.norm = curves["norm"]
    progress.rate = curves["rate"]
    return progress
