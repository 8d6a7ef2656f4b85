"""What does an event-flow objective buy a lens designer over the best spot-size designer?

A published lens is scaled to a DAVIS346-like sensor and focused on the wall it looks at; a stated
seed detunes its curvatures, and it is focused again, so that what is left no focusing takes away.
From there it is optimised by gradients through rays, frames, events and flow, beside rivals with
the same free variables, focal length, f-number and
limits: refocused alone, damped least squares on spots, and the seed project's edge energy. All are
judged on textures and motions never optimised on, with a hard event sensor, case by case.

With --motion any, forward, turn, hover or a file of poses, the lens is designed for a motion of
that kind: another study with options of its own (python -m studies.lens_motion --help).

The event layer and the flow estimator can be any of the toolkit's; a network can be trained
together with the lens.
"""

import sys
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any, ClassVar, Literal

from codesign import flow, lens
from codesign.errors import DomainError, NonFiniteError
from codesign.flow import checkpoint
from codesign.lens.design import edge_thickness_mm
from codesign.system import check
from studies.frame.compare import log_ratio
from studies.frame.config import check_least, check_unused
from studies.frame.run import Run, StudyConfig, main
from studies.frame.sweep import column
from studies.lens_opt import page as lens_opt_page
from studies.lens_opt import rivals
from studies.lens_opt.descend import (
    JUDGED,
    PER_SEED,
    TRAINED,
    Job,
    development_error,
    prepare,
)
from studies.lens_opt.page import label
from studies.lens_opt.task import HELD_OUT, LIGHT, draw_case, make_task, make_worlds


@dataclass(frozen=True)
class Config(StudyConfig):
    GPU: ClassVar = True
    QUICK: ClassVar = {
        "steps": 10,
        "after_steps": 2,
        "cases": 2,
        "judged": 4,
        "scored": 3,
        "developed": 1,
        "spot_steps": 8,
        "spot_starts": 1,
    }
    device: Literal["auto", "cpu", "cuda"] = "cpu"
    """Where rays, events and flow are computed; auto takes CUDA where there is one."""
    lens: str = "cooke-triplet"
    """Lens to start from: cooke-triplet, double-gauss, la1509, or a lens file (.zmx, .seq, .json)."""
    objective: Literal["flow", "edge"] = "flow"
    """flow: log angular error of event flow; edge: the seed project's edge energy of event frames.
    The other of the two is a rival."""
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
    steps: int = 40
    """Optimisation steps of either objective."""
    after_steps: int = 12
    """Steps of the flow objective from the spot designer's lens."""
    cases: int = 4
    """Samples (texture, motion, noise) per step."""
    samples: int = 16
    """Rays per pixel while optimising, a multiple of the 4 wavelengths; twice as many when
    judging."""
    step_size: float = 0.3
    """Flow objective: length of a step in pixels of ray motion."""
    edge_step_size: float = 0.3
    """Edge objective: length of a step in pixels of ray motion."""
    spot_steps: int = 60
    """Most steps of the spot designer from one start."""
    spot_starts: int = 2
    """Starts of the spot designer."""
    detuned_px: float = 1.5
    """Mean RMS spot of the detuned lens at its best focus, pixels."""
    scored: int = 8
    """Training cases on which the hard sensor decides which lens is kept."""
    developed: int = 6
    """Development cases on which the rivals choose their settings."""
    judged: int = 24
    """Held-out cases for the final figures."""


AFTER_PART = 0.5  # of the step size, for the flow steps from the spot designer's lens
MEANS = ("flow_error_mrad", "edge_energy", "events_per_pixel")


class Course:
    """How far a run has come: what the rivals chose, the designs by gradients, what was judged. All
    of it is stored."""

    def __init__(self, run: Run[Config]):
        stored = run.load_state()
        numbers = stored.numbers if stored else {"choices": {}, "found": {}, "jobs": {}}
        self.run = run
        self.fresh = stored is None
        self.jobs: dict[str, Job] = {}
        self.choices: dict[str, list[dict[str, Any]]] = numbers["choices"]
        self.found: dict[str, list[dict[str, float]]] = numbers["found"]
        self._left = numbers["jobs"]
        self._tensors = stored.tensors if stored else {}

    def add(self, name: str, job: Job):
        """A design by gradients, which goes on from where the stored run left it."""
        self.jobs[name] = job
        if name in self._left:
            mine = f"{name}."
            own = {k.removeprefix(mine): v for k, v in self._tensors.items() if k.startswith(mine)}
            job.resume(own, self._left[name])

    def save(self):
        tensors = {}
        numbers = {}
        for name, job in self.jobs.items():
            own, numbers[name] = job.state()
            tensors |= {f"{name}.{key}": value for key, value in own.items()}
        self.run.save_state(
            tensors, {"choices": self.choices, "found": self.found, "jobs": numbers}
        )


def study(run: Run[Config]):
    config = run.config
    _check(config)
    job = prepare(config, make_task(config.lens, config.seed, config.detuned_px, run.device))
    course = Course(run)
    if course.fresh:
        lens.save(job.task.nominal, run.path("lens_nominal.json"))
        lens.save(job.task.design.reference, run.path("lens_detuned.json"))
        check(job.system, job.probe, job.loop.optimiser)
    made = designed_without_frames(course, job)
    other = "edge" if config.objective == "flow" else "flow"
    course.add("optimised", job)
    course.add(other, prepare(config, job.task, other, job.system.flow))
    if not config.train_network:
        begun = replace(job.task, design=job.task.around(made["spots"]))
        course.add("after_spots", prepare(config, begun, "flow", job.system.flow, part=AFTER_PART))
    run.on_interrupt(course.save)
    seconds = {name: descend(course, name) for name in course.jobs}
    lenses = {
        "nominal": job.task.nominal,
        "defocused": job.task.defocused,
        "detuned": job.task.design.reference,
        **made,
        **{name: done.best() for name, done in course.jobs.items()},
    }
    _finish(run, course, lenses, seconds["optimised"])


def _check(config):
    check_least(
        config,
        1,
        "steps",
        "after_steps",
        "cases",
        "samples",
        "scored",
        "developed",
        "judged",
        "weights",
        "spot_steps",
        "spot_starts",
    )
    steps = max(config.steps, config.after_steps)
    if (config.seed + 1) * PER_SEED + steps * config.cases > TRAINED:
        raise DomainError(
            f"--seed is {config.seed}, whose training cases are those that judge; give 0 to 60."
        )
    if config.train_network:
        check_unused(config, "with --train-network", "after_steps")
    else:
        check_unused(config, "without --train-network", "weights", "learning_rate")
    if config.samples % len(LIGHT.weights):
        raise DomainError(
            f"--samples is {config.samples}; the light has {len(LIGHT.weights)} wavelengths, so give a multiple of that."
        )
    for name in ("step_size", "edge_step_size", "learning_rate", "detuned_px"):
        if not getattr(config, name) > 0:
            raise DomainError(f"--{name.replace('_', '-')} must be above 0.")


def designed_without_frames(course, job):
    """The refocused lens and the spot designer's, stored as files; what they chose from goes into
    the course."""
    run = course.run
    config = run.config
    names = ("refocused", "spots")
    if not course.choices:
        # a network that is yet to be trained cannot choose
        stage = flow.estimate_lk if config.train_network else job.system.flow
        error = development_error(job.task, stage, config.developed, config.samples)
        run.say(
            "refocusing, and shrinking spots by damped least squares; settings by development cases"
        )
        found = (
            rivals.refocus(job.task, error),
            rivals.shrink_spots(
                job.task, error, config.spot_steps, config.spot_starts, config.seed
            ),
        )
        for name, variants in zip(names, found, strict=True):
            best = rivals.least(variants)
            run.say(f"{name}: {best.setting}, {best.error_mrad:.3f} mrad on development cases")
            if best.complaint:
                run.say(f"note: {best.complaint}")
            lens.save(best.optics, run.path(f"lens_{name}.json"))
            course.choices[name] = [v.numbers() for v in variants]
        course.save()
    return {name: lens.load(run.path(f"lens_{name}.json")).freeze() for name in names}


def descend(course, name):
    """Take the steps of a design by gradients that are still to be made. Returns: seconds per step,
    None when none was timed."""
    run = course.run
    config = run.config
    job = course.jobs[name]
    steps = config.after_steps if name == "after_spots" else config.steps

    def judged():
        job.history.add(job.task, job.best())
        if job.loop.record.kept[-1]:
            lens.save(job.best(), run.path(f"lens_{name}.json"))
            if config.train_network and name == "optimised":
                checkpoint.save(job.system.flow, run.path("network.safetensors"))
        course.save()

    title = f"optimising {config.lens}: {label(name, config.objective)}"
    try:
        with run.progress(steps, title, done=job.loop.step_number) as bar:

            def advance(loss, score):
                bar.advance(loss=loss, spot_um=sum(job.history.spot_um[-1]) / 3)

            job.loop.run(steps, advance, judged)
            return bar.seconds_per_step
    except NonFiniteError as error:
        raise NonFiniteError(
            f"{error} The last good lens is {run.path(f'lens_{name}.json')}."
        ) from error


def _finish(run, course, lenses, seconds):
    """Judge every lens on held-out cases, record, and write the page."""
    job = course.jobs["optimised"]
    task = job.task
    found = judge_all(course, lenses)
    for name, optics in lenses.items():
        first_order = optics.first_order()
        thin = (task.design.edge_floor_mm - edge_thickness_mm(optics)).clamp_min(0).max()
        run.record(
            **{
                f"rms_spot_um_{name}": task.rms_spot_um(optics).mean(),
                **{f"{key}_hard_{name}": fmean(column(found[name], key)) for key in MEANS},
                f"efl_mm_{name}": first_order.efl_mm.detach(),
                f"fno_{name}": first_order.fno.detach(),
                f"edge_below_floor_mm_{name}": thin.detach(),
            }
        )
    for name, design, rival in pairs_of(lenses):
        pair = log_ratio(*(column(found[n], "flow_error_mrad") for n in (design, rival)))
        run.record(**pair.metrics(f"log_ratio_{name}"))
    blank = draw_case([lens_opt_page.blank_wall(task.device)], JUDGED, 17, task.device)
    for name in ("detuned", "optimised"):
        error = task.judge(lenses[name], blank, job.system.flow)["flow_error_mrad"]
        run.record(**{f"flow_error_mrad_hard_control_{name}": error})
    result = job.system(job.probe, probe=True)
    result.backward()
    rows = result.table()
    for row in rows:
        figures = ("gradient_norm", "zero_share")
        run.record(**{f"{figure}_{row['junction']}": row[figure] for figure in figures})
    record = job.loop.record
    run.record(
        loss_first=record.score[0],
        loss_last=job.loop.best_score,
        steps=len(record.loss),
        seconds_total=run.seconds,
    )
    if seconds is not None:  # unknown when the run was killed before a timed step was stored
        run.record(seconds_per_step=seconds)
    lens_opt_page.write(run, course, lenses, rows)


def pairs_of(lenses):
    """(name, design, rival) of the pairs that are compared: the design with every other lens, and
    the spot designer's lens after flow steps with itself before."""
    found = [(rival, "optimised", rival) for rival in lenses if rival != "optimised"]
    if "after_spots" in lenses:
        found.append(("after_spots_over_spots", "after_spots", "spots"))
    return found


def judge_all(course, lenses):
    """Hard errors of every lens on the held-out cases, by name: list of dict
    (see LensTask.judge)."""
    run = course.run
    job = course.jobs["optimised"]
    task = job.task
    pool = make_worlds(HELD_OUT, task.device)
    found = course.found
    done = min((len(found.get(name, [])) for name in lenses), default=0)
    with run.progress(
        run.config.judged, "judging on held-out textures and motions", done=done
    ) as bar:
        for i in range(done, run.config.judged):
            case = draw_case(pool, JUDGED + i, 17, task.device)
            for name, optics in lenses.items():
                row = task.judge(optics, case, job.system.flow, 2 * run.config.samples)
                found.setdefault(name, []).append(row)
            course.save()
            bar.advance()
    return found


def start(arguments: list[str] | None = None) -> int:
    """The command line; with --motion it is that of lens_motion. Returns: exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    if any(word.split("=")[0] == "--motion" for word in words):
        from studies.lens_motion import __main__ as lens_motion

        return main(lens_motion.study, lens_motion.Config, arguments)
    return main(study, Config, arguments)


if __name__ == "__main__":
    sys.exit(start())
