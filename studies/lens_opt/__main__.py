"""Optimise a lens for event flow, from glass to the flow error.

A published lens is scaled to a DAVIS346-like sensor, detuned in curvatures and focus by a stated seed, and
optimised by gradients
through rays, frames, events (hard counts, straight-through) and closed-form flow. Focal length and f-number
are held, centre and
edge thicknesses kept. What counts is judged on textures and motions never optimised on, with a hard event
sensor.
"""

import sys
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import torch

from codesign import lens
from codesign.errors import DomainError, NonFiniteError
from codesign.optimise.descent import Descent
from studies.frame.run import Run, StudyConfig, main
from studies.lens_opt import page as lens_opt_page
from studies.lens_opt.task import HELD_OUT, TRAINING, draw_case, make_task, make_worlds


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"steps": 10, "cases": 2, "judged": 4}
    lens: str = "cooke-triplet"
    """Lens to start from: cooke-triplet, double-gauss, la1509, or a lens .json file."""
    objective: Literal["flow", "edge"] = "flow"
    """flow: log angular error of event flow; edge: the seed project's edge energy of event frames."""
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
    judged: int = 12
    """Held-out cases for the final figures."""


@dataclass
class History:
    """Curves kept for the page and for resuming, one entry per step (loss, norm) or per check (the rest)."""

    loss: list[float] = field(default_factory=list)
    gradient: list[float] = field(default_factory=list)
    checked_step: list[int] = field(default_factory=list)
    score: list[float] = field(default_factory=list)
    spot_um: list[list[float]] = field(default_factory=list)
    curvature: list[list[float]] = field(default_factory=list)
    thickness: list[list[float]] = field(default_factory=list)


def study(run: Run[Config]):
    config = run.config
    if config.steps < 1 or config.cases < 1 or config.samples < 1 or config.judged < 1:
        raise DomainError(
            f"steps {config.steps}, cases {config.cases}, samples {config.samples} and judged "
            f"{config.judged} must all be at least 1."
        )
    steps = config.steps
    cases = config.cases
    task = make_task(config.lens, config.seed, config.detuned_px)
    pool = make_worlds(TRAINING)
    chain = task.chain(config.samples, objective=config.objective)
    scored = [draw_case(pool, 7_000_000 + i) for i in range(3 if config.quick else 8)]
    lens.save(task.nominal, run.path("lens_nominal.json"))
    lens.save(task.design.reference, run.path("lens_detuned.json"))
    descent, history, first = _restore(run, task, config)

    def save():
        tensors = {"variables": descent.variables, "velocity": descent.velocity, "best": descent.best}
        run.save_state(
            tensors,
            {
                "step": len(history.loss),
                "step_size": descent.step_size,
                "best_score": descent.best_score,
                **vars(history),
            },
        )

    def score():
        with torch.no_grad():
            value = sum(
                float(chain({"variables": descent.variables, "case": case}).loss) for case in scored
            ) / len(scored)
            optics = task.design.lens(descent.variables)
            value += 10 * float(task.design.penalty(optics))
        kept = descent.check(value)
        optics = task.design.lens(descent.best)
        history.checked_step.append(len(history.loss))
        history.score.append(value)
        history.spot_um.append(task.rms_spot_um(optics).tolist())
        history.curvature.append(optics.curvature_per_mm.tolist())
        history.thickness.append(optics.thickness_mm.tolist())
        if kept:
            lens.save(optics, run.path("lens_optimised.json"))
        save()

    run.on_interrupt(save)
    if not history.score:
        score()
    try:
        with run.progress(steps, f"optimising {config.lens} for {config.objective}", done=first) as bar:
            for step in range(first, steps):
                gradients = []
                losses = []
                for k in range(cases):
                    variables = descent.variables.clone().requires_grad_(True)
                    result = chain(
                        {
                            "variables": variables,
                            "case": draw_case(pool, (config.seed + 1) * 100_000 + step * cases + k),
                        }
                    )
                    total = result.loss + 10 * task.design.penalty(result.camera.lens)
                    gradients.append(torch.autograd.grad(total, variables)[0])
                    losses.append(float(total.detach()))
                    if not bool(gradients[-1].isfinite().all()):
                        raise NonFiniteError(
                            "the gradient of the design became infinite or NaN at junction 'lens'."
                        )
                norms = descent.step(gradients)
                history.loss.append(sum(losses) / cases)
                history.gradient.append(sum(norms) / cases)
                if (step + 1) % 5 == 0 or step + 1 == steps:
                    score()
                bar.advance(loss=history.loss[-1], spot_um=sum(history.spot_um[-1]) / 3)
            seconds = bar.seconds_per_step
    except NonFiniteError as error:
        raise NonFiniteError(
            f"{error} Optimisation stopped at step {len(history.loss) + 1}; the last good design is "
            f"{run.path('lens_optimised.json')}."
        ) from error
    _finish(run, task, chain, descent, history, scored[0], config.judged, seconds)


def _restore(run, task, config):
    """Descent, history and first step: fresh, or as an earlier session left them."""
    state = run.load_state()
    if state is None:
        return (
            Descent(torch.zeros(task.design.basis.shape[1], dtype=torch.float64), config.step_size),
            History(),
            0,
        )
    numbers = dict(state.numbers)
    first = numbers.pop("step")
    size = numbers.pop("step_size")
    best = numbers.pop("best_score")
    descent = Descent(
        state.tensors["variables"],
        size,
        velocity=state.tensors["velocity"],
        best=state.tensors["best"],
        best_score=best,
    )
    return descent, History(**numbers), first


def _finish(run, task, chain, descent, history, probe, judged, seconds):
    """Judge nominal, detuned and optimised lenses on held-out cases, record, and write the page."""
    optimised = lens.load(run.path("lens_optimised.json")).freeze()
    lenses = {"nominal": task.nominal, "detuned": task.design.reference, "optimised": optimised}
    pool = make_worlds(HELD_OUT)
    found = {name: [] for name in lenses}
    with run.progress(judged * 3, "judging on held-out textures and motions") as bar:
        for i in range(judged):
            case = draw_case(pool, 9_000_000 + i, frames=17)
            for name, optics in lenses.items():
                found[name].append(task.judge(optics, case, 2 * run.config.samples))
                bar.advance()
    mean = {
        name: {key: sum(row[key] for row in rows) / judged for key in rows[0]} for name, rows in found.items()
    }
    for name, optics in lenses.items():
        spot = task.rms_spot_um(optics)
        run.record(
            **{
                f"rms_spot_um_{name}": spot.mean(),
                f"flow_error_mrad_hard_{name}": mean[name]["flow_error_mrad"],
                f"edge_energy_hard_{name}": mean[name]["edge_energy"],
                f"events_per_pixel_hard_{name}": mean[name]["events_per_pixel"],
                f"efl_mm_{name}": optics.first_order().efl_mm.detach(),
                f"fno_{name}": optics.first_order().fno.detach(),
            }
        )
    blank = draw_case([lens_opt_page.blank_wall()], 9_000_000, frames=17)
    run.record(
        flow_error_mrad_hard_control_detuned=task.judge(task.design.reference, blank)["flow_error_mrad"],
        flow_error_mrad_hard_control_optimised=task.judge(optimised, blank)["flow_error_mrad"],
    )
    m = run.metrics
    for key, label in (("flow_error_mrad_hard", "flow_error"), ("rms_spot_um", "rms_spot")):
        lost = m[f"{key}_detuned"] - m[f"{key}_nominal"]
        run.record(
            **{
                f"{label}_recovered_share": (m[f"{key}_detuned"] - m[f"{key}_optimised"]) / lost,
                f"{label}_lost_share_of_nominal": lost / m[f"{key}_nominal"],
            }
        )
    result = chain({"variables": descent.best.clone().requires_grad_(True), "case": probe})
    result.backward()
    rows = result.table()
    run.record(
        **{
            f"gradient_norm_{row['junction']}": row["gradient_norm"]
            for row in rows
            if row["junction"] != "loss"
        }
    )
    run.record(
        loss_first=history.score[0],
        loss_last=descent.best_score,
        steps=len(history.loss),
        seconds_total=run.seconds,
    )
    if seconds is not None:  # unknown when the run was killed before a timed step was stored
        run.record(seconds_per_step=seconds)
    lens_opt_page.write(run, task, lenses, history, rows, probe, found)


if __name__ == "__main__":
    sys.exit(main(study, Config))
