"""Event layers and flow estimators of lens_opt by name, and which of them make no sense
together."""

from pathlib import Path
from typing import Any

from torch import nn

from codesign import events, flow, shipped
from codesign.errors import DomainError
from studies.lens_opt.task import SENSOR

WEIGHTS = {"flownet": flow.FlowNetEvents, "spiking": flow.SpikeFlowNet}
SPIKING_STEPS = 8  # of the spiking layer per interval: so many events it can give there
ESTIMATORS = ("closed-form", "refiner", *WEIGHTS)


def event_layer(name: str) -> events.EventLayer:
    """The event layer of that name with the task's sensor, thresholds held."""
    options = {"steps": SPIKING_STEPS} if name == "srm" else {}
    return events.layer(name, SENSOR, learn=(), **options)


def estimator(name: str, train: bool, objective: str, weights: int, seed: int) -> Any:
    """The flow stage of that name, or from a network file; its weights ask for gradients only when
    trained.

    Raises: DomainError for what does not go together, with the reason; FileFormatError for a file
      that is no network.
    """
    if train and name == "closed-form":
        raise DomainError(
            "--flow closed-form has no weights, so there is nothing to train; leave --train-network out."
        )
    if name in WEIGHTS and objective == "edge":
        raise DomainError(
            f"--objective edge looks at event frames only, so --flow {name} would keep its random weights, whose flow "
            "means nothing; choose closed-form, refiner or the file of a trained network."
        )
    if train and objective == "edge":
        raise DomainError(
            "--objective edge looks at event frames only, so it gives a network no gradient; leave --train-network "
            "out, or optimise for flow."
        )
    if name == "closed-form":
        return flow.estimate_lk
    if name in WEIGHTS:
        if not train:
            raise DomainError(
                f"--flow {name} starts with random weights, whose flow means nothing; add --train-network, or give "
                f"the file of a trained network ({shipped.command('train_flow')} makes one)."
            )
        return WEIGHTS[name].with_weights(weights, seed=seed)
    if name != "refiner" and not Path(name).is_file():
        raise DomainError(
            f"--flow {name} is neither a network file nor one of {', '.join(ESTIMATORS)}."
        )
    return flow.load(name).requires_grad_(train)


def weights_of(stage: Any) -> list[nn.Parameter]:
    return (
        [p for p in stage.parameters() if p.requires_grad] if isinstance(stage, nn.Module) else []
    )
