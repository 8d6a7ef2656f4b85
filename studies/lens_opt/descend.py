"""One design by gradients through rendered frames: the system of an objective, its optimiser, and
its way so far."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from statistics import fmean
from typing import Any

import torch
from torch import nn

from codesign import lens
from codesign.events import HardSensor
from codesign.optimise import Descent, Loop
from codesign.system import System
from studies.lens_opt.stages import estimator, event_layer, weights_of
from studies.lens_opt.task import (
    DEVELOPMENT,
    SENSOR,
    TRAINING,
    DesignedCamera,
    LensTask,
    draw_case,
    make_worlds,
)

PENALTY = 10.0  # of edges thinner than allowed, against the objective
PER_SEED = 100_000  # training cases
TRAINED = 7_000_000  # first seeds of the cases that decide which lens is kept
DEVELOPED = 8_000_000  # of the development cases
JUDGED = 9_000_000  # of the held-out cases


@dataclass
class History:
    """Curves for the page, by judgement: spots, curvatures, thicknesses of the best lens."""

    spot_um: list[list[float]] = field(default_factory=list)
    curvature: list[list[float]] = field(default_factory=list)
    thickness: list[list[float]] = field(default_factory=list)

    def add(self, task: LensTask, optics: lens.GeoLens) -> None:
        self.spot_um.append(task.rms_spot_um(optics).tolist())
        self.curvature.append(optics.curvature_per_mm.tolist())
        self.thickness.append(optics.thickness_mm.tolist())


@dataclass(frozen=True)
class Job:
    """The task, the camera at its variables, the smooth system and its optimisation."""

    task: LensTask
    camera: DesignedCamera
    system: System
    loop: Loop
    probe: Any
    history: History

    def optics(self, variables: torch.Tensor) -> lens.GeoLens:
        return self.task.design.lens(variables)

    def best(self) -> lens.GeoLens:
        """The lens of the best judgement so far, without gradients."""
        return self.optics(self.loop.best[0].detach()).freeze()

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        tensors, numbers = self.loop.state()
        return tensors, {**numbers, "history": vars(self.history)}

    def resume(self, tensors: dict[str, torch.Tensor], numbers: dict[str, Any]) -> None:
        vars(self.history).update(numbers["history"])
        self.loop.resume(tensors, numbers)


def prepare(
    config: Any,
    task: LensTask,
    objective: str | None = None,
    stage: Any = None,
    part: float = 1.0,
) -> Job:
    """Everything a design by gradients needs before its first step.

    Args:
      config: Config of lens_opt.
      task: where to start from.
      objective: "flow" or "edge", by default that of config.
      stage: flow stage to share.
      part: of the step size.
    Raises: DomainError for an event layer and an estimator that make no sense together, with the
      reason.
    """
    layer = event_layer(config.events).to(task.device)
    if stage is None:
        stage = estimator(
            config.flow, config.train_network, config.objective, config.weights, config.seed
        )
        stage = stage.to(task.device) if isinstance(stage, nn.Module) else stage
    chosen: str = objective or config.objective
    pool = make_worlds(TRAINING, task.device)
    camera = DesignedCamera(task, config.samples)
    train = config.train_network and chosen == "flow"
    every_px = 2 if train else 8  # a network is taught at more pixels than a lens needs
    system = task.system(camera, layer, stage, chosen, every_px)
    hard = system.replaced(events=HardSensor(SENSOR, system.bins))
    drawn = partial(draw_case, pool, device=task.device)
    scored = [drawn(TRAINED + i) for i in range(config.scored)]

    def penalty():
        return PENALTY * task.design.penalty(camera.optics())

    def samples(step):
        first = (config.seed + 1) * PER_SEED + step * config.cases
        return (system(drawn(first + k)).loss + penalty() for k in range(config.cases))

    def score():
        return fmean(float(hard(case).loss) for case in scored) + float(penalty())

    optimiser = _optimiser(config, system, chosen, train, part, scored[0])
    return Job(
        task, camera, system, Loop(optimiser, samples, clip=None, judge=score), scored[0], History()
    )


def _optimiser(config, system, objective, train, part, case):
    """Descent on the design; with a network, Adam on both, for the weights that the objective sees.

    A log error and an edge energy have no common scale: the gradients of each are clipped to the
    median length of the samples, and every step has a set length, each objective its own.
    """
    variables = system.camera.variables
    if not train:
        size = config.edge_step_size if objective == "edge" else config.step_size
        return Descent([variables], part * size, normalised=True)
    weights = weights_of(system.flow)
    slopes = torch.autograd.grad(system(case).loss, weights, allow_unused=True)
    seen = [weight for weight, slope in zip(weights, slopes, strict=True) if slope is not None]
    return torch.optim.Adam(
        [
            {"params": [variables], "lr": config.step_size / 6},
            {"params": seen, "lr": config.learning_rate},
        ]
    )


def development_error(
    task: LensTask,
    flow: Any,
    cases: int,
    samples: int,
) -> Callable[[lens.GeoLens], float]:
    """Function of a lens to its geometric mean hard flow error on the development cases, mrad."""
    pool = make_worlds(DEVELOPMENT, task.device)
    drawn = [draw_case(pool, DEVELOPED + i, 17, task.device) for i in range(cases)]

    def error(optics):
        found = [task.judge(optics, case, flow, samples)["flow_error_mrad"] for case in drawn]
        return float(torch.tensor(found, dtype=torch.float64).log().mean().exp())

    return error
