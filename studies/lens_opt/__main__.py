"""Optimise a lens for event flow, from glass to the flow error.

A published lens is scaled to a DAVIS346-like sensor, detuned in curvatures and focus by a stated seed, and optimised by
gradients through rays, frames, events and flow. Focal length and f-number are held, centre and edge thicknesses kept.
What counts is judged on textures and motions never optimised on, with a hard event sensor.

The event layer and the flow estimator can be any of the toolkit's; a network can be trained together with the lens.
"""

import sys
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import torch

from codesign import lens
from codesign.errors import DomainError, NonFiniteError
from codesign.events import HardSensor
from codesign.flow import checkpoint
from codesign.optimise import Descent, Loop
from codesign.system import System, check
from studies.frame.run import Run, StudyConfig, main
from studies.lens_opt import page as lens_opt_page
from studies.lens_opt.stages import estimator, event_layer, weights_of
from studies.lens_opt.task import (
    HELD_OUT,
    SENSOR,
    TRAINING,
    DesignedCamera,
    LensTask,
    draw_case,
    make_task,
    make_worlds,
)

PENALTY = 10.0  # of edges thinner than allowed, against the log error


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"steps": 10, "cases": 2, "judged": 4, "scored": 3}
    lens: str = "cooke-triplet"
    """Lens to start from: cooke-triplet, double-gauss, la1509, or a lens .json file."""
    objective: Literal["flow", "edge"] = "flow"
    """flow: log angular error of event flow; edge: the seed project's edge energy of event frames."""
    events: str = "memory"
    """Event layer: memory, sigmoid, counts, dense, expected, srm or physical."""
    flow: str = "closed-form"
    """Flow estimator: closed-form, refiner, flownet, spiking, or the file of a trained network."""
    train_network: bool = False
    """Train the network together with the lens."""
    weights: int = 100_000
    """Weights of a flownet or spiking network."""
    learning_rate: float = 1e-3
    """Step size of the network's weights (Adam); the lens then goes by Adam too."""
    steps: int = 50
    """Optimisation steps."""
    cases: int = 4
    """Samples (texture, motion, noise) per step."""
    samples: int = 16
    """Rays per pixel while optimising; twice as many when judging."""
    step_size: float = 0.3
    """Length of a step in pixels of ray motion per unit of clipped gradient."""
    detuned_px: float = 2.2
    """Mean RMS spot of the detuned start, pixels."""
    scored: int = 8
    """Training cases on which the hard sensor decides which lens is kept."""
    judged: int = 12
    """Held-out cases for the final figures."""


@dataclass
class History:
    """Curves for the page, by judgement: spots, curvatures, thicknesses of the best lens."""

    spot_um: list[list[float]] = field(default_factory=list)
    curvature: list[list[float]] = field(default_factory=list)
    thickness: list[list[float]] = field(default_factory=list)


@dataclass(frozen=True)
class Job:
    """The task, the camera at its variables, the smooth system and its optimisation."""

    task: LensTask
    camera: DesignedCamera
    system: System
    loop: Loop
    probe: Any

    def optics(self, variables: torch.Tensor) -> lens.GeoLens:
        return self.task.design.lens(variables)


def study(run: Run[Config]):
    config = run.config
    _check(config)
    job = prepare(config)
    history = History()
    stored = run.load_state()
    if stored is None:
        lens.save(job.task.nominal, run.path("lens_nominal.json"))
        lens.save(job.task.design.reference, run.path("lens_detuned.json"))
        check(job.system, job.probe, job.loop.optimiser)
    else:
        history = History(**stored.numbers.pop("history"))
        job.loop.resume(stored.tensors, stored.numbers)

    def save():
        tensors, numbers = job.loop.state()
        run.save_state(tensors, {**numbers, "history": vars(history)})

    def judged():
        optics = job.optics(job.loop.best[0])
        history.spot_um.append(job.task.rms_spot_um(optics).tolist())
        history.curvature.append(optics.curvature_per_mm.tolist())
        history.thickness.append(optics.thickness_mm.tolist())
        if job.loop.record.kept[-1]:
            lens.save(optics, run.path("lens_optimised.json"))
            if config.train_network:
                checkpoint.save(job.system.flow, run.path("network.safetensors"))
        save()

    run.on_interrupt(save)
    label = f"optimising {config.lens} for {config.objective}"
    try:
        with run.progress(config.steps, label, done=job.loop.step_number) as bar:

            def advance(loss, score):
                bar.advance(loss=loss, spot_um=sum(history.spot_um[-1]) / 3)

            job.loop.run(config.steps, advance, judged)
            seconds = bar.seconds_per_step
    except NonFiniteError as error:
        raise NonFiniteError(f"{error} The last good lens is {run.path('lens_optimised.json')}.") from error
    _finish(run, job, history, seconds)


def _check(config):
    for name in ("steps", "cases", "samples", "scored", "judged", "weights"):
        if getattr(config, name) < 1:
            raise DomainError(f"--{name} is {getattr(config, name)}; at least 1 is needed.")
    if not (config.step_size > 0 and config.learning_rate > 0 and config.detuned_px > 0):
        raise DomainError("--step-size, --learning-rate and --detuned-px must be above 0.")


def prepare(config: Config) -> Job:
    """Everything a run of lens_opt needs before its first step.

    Raises: DomainError for an event layer and an estimator that make no sense together, with the reason.
    """
    layer = event_layer(config.events)
    stage = estimator(config.flow, config.train_network, config.objective, config.weights, config.seed)
    task = make_task(config.lens, config.seed, config.detuned_px)
    pool = make_worlds(TRAINING)
    camera = DesignedCamera(task, config.samples)
    every_px = 2 if config.train_network else 8  # a network is taught at more pixels than a lens needs
    system = task.system(camera, layer, stage, config.objective, every_px)
    hard = system.replaced(events=HardSensor(SENSOR, system.bins))
    scored = [draw_case(pool, 7_000_000 + i) for i in range(config.scored)]

    def penalty():
        return PENALTY * task.design.penalty(camera.optics())

    def samples(step):
        first = (config.seed + 1) * 100_000 + step * config.cases
        return (system(draw_case(pool, first + k)).loss + penalty() for k in range(config.cases))

    def score():
        return sum(float(hard(case).loss) for case in scored) / len(scored) + float(penalty())

    return Job(
        task, camera, system, Loop(_optimiser(config, system, scored[0]), samples, judge=score), scored[0]
    )


def _optimiser(config, system, case):
    """Descent on the design; with a network, Adam on both, for the weights that the objective sees."""
    variables = system.camera.variables
    if not config.train_network:
        return Descent([variables], config.step_size)
    weights = weights_of(system.flow)
    slopes = torch.autograd.grad(system(case).loss, weights, allow_unused=True)
    seen = [weight for weight, slope in zip(weights, slopes, strict=True) if slope is not None]
    return torch.optim.Adam(
        [{"params": [variables], "lr": config.step_size / 6}, {"params": seen, "lr": config.learning_rate}]
    )


def _finish(run, job, history, seconds):
    """Judge nominal, detuned and optimised lenses on held-out cases, record, and write the page."""
    task = job.task
    optimised = lens.load(run.path("lens_optimised.json")).freeze()
    lenses = {"nominal": task.nominal, "detuned": task.design.reference, "optimised": optimised}
    found = judge_all(run, job, lenses)
    judged = run.config.judged
    for name, optics in lenses.items():
        mean = {key: sum(row[key] for row in found[name]) / judged for key in found[name][0]}
        first_order = optics.first_order()
        run.record(
            **{
                f"rms_spot_um_{name}": task.rms_spot_um(optics).mean(),
                f"flow_error_mrad_hard_{name}": mean["flow_error_mrad"],
                f"edge_energy_hard_{name}": mean["edge_energy"],
                f"events_per_pixel_hard_{name}": mean["events_per_pixel"],
                f"efl_mm_{name}": first_order.efl_mm.detach(),
                f"fno_{name}": first_order.fno.detach(),
            }
        )
    blank = draw_case([lens_opt_page.blank_wall()], 9_000_000, frames=17)
    for name in ("detuned", "optimised"):
        error = task.judge(lenses[name], blank, job.system.flow)["flow_error_mrad"]
        run.record(**{f"flow_error_mrad_hard_control_{name}": error})
    m = run.metrics
    for key, label in (("flow_error_mrad_hard", "flow_error"), ("rms_spot_um", "rms_spot")):
        lost = m[f"{key}_detuned"] - m[f"{key}_nominal"]
        won = m[f"{key}_detuned"] - m[f"{key}_optimised"]
        run.record(
            **{
                f"{label}_recovered_share": won / lost,
                f"{label}_lost_share_of_nominal": lost / m[f"{key}_nominal"],
            }
        )
    result = job.system(job.probe, probe=True)
    result.backward()
    rows = result.table()
    for row in rows:
        run.record(
            **{
                f"gradient_norm_{row['junction']}": row["gradient_norm"],
                f"zero_share_{row['junction']}": row["zero_share"],
            }
        )
    record = job.loop.record
    run.record(
        loss_first=record.score[0],
        loss_last=job.loop.best_score,
        steps=len(record.loss),
        seconds_total=run.seconds,
    )
    if seconds is not None:  # unknown when the run was killed before a timed step was stored
        run.record(seconds_per_step=seconds)
    lens_opt_page.write(run, job, lenses, history, rows, found)


def judge_all(run, job, lenses):
    """Hard errors of every lens on the held-out cases, by name: list of dict (see LensTask.judge)."""
    pool = make_worlds(HELD_OUT)
    found = {name: [] for name in lenses}
    with run.progress(run.config.judged * len(lenses), "judging on held-out textures and motions") as bar:
        for i in range(run.config.judged):
            case = draw_case(pool, 9_000_000 + i, frames=17)
            for name, optics in lenses.items():
                found[name].append(job.task.judge(optics, case, job.system.flow, 2 * run.config.samples))
                bar.advance()
    return found


if __name__ == "__main__":
    sys.exit(main(study, Config))
