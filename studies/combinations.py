"""Every event layer with every flow estimator in the main job: which go together, what they cost, where they lead.

Each pair optimises the same detuned lens for the same few steps (studies.lens_opt) and is judged by the hard sensor on
held-out cases. Beside the outcome stand seconds per step, the gradient at every junction, and a certificate: autograd
against differences with the smooth form of the event layer. Pairs that make no sense are listed with the reason.
"""

import sys
import time
from dataclasses import dataclass, replace
from statistics import fmean, median
from typing import ClassVar

from codesign import events
from codesign.errors import CodesignError, DomainError
from codesign.grad import certify
from codesign.grad.modules import by_group
from codesign.system import Batch, check
from scenes import textures, worlds
from studies.frame.config import configured
from studies.frame.run import Run, StudyConfig, main
from studies.lens_opt import __main__ as lens_opt
from studies.lens_opt.stages import ESTIMATORS, WEIGHTS
from studies.lens_opt.task import HELD_OUT, SENSOR, draw_case, make_worlds

SMOOTH = {"sigmoid": "sigmoid", "expected": "expected", "counts": "counts"}
"""Layers that are smooth themselves; of the others "counts", their mean account, is certified in the chain."""
JUNCTIONS = ("rays", "frames", "events", "flow")
STEPS_PX = (0.014, 0.01, 0.007, 0.005)  # of ray motion, where differences are taken
NETWORK_STEPS_PX = (0.1, 0.07, 0.05, 0.035)  # a network with random weights hardly feels the lens
SCORES = (
    "error_first_mrad",
    "error_last_mrad",
    "seconds_per_step",
    "cpu_seconds_per_step",
    "certificate_error",
    "certificate_cosine",
)


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {
        "steps": 3,
        "cases": 1,
        "judged": 2,
        "layers": ("memory", "srm"),
        "estimators": ("closed-form",),
    }
    layers: tuple[str, ...] = events.LAYERS
    """Event layers."""
    estimators: tuple[str, ...] = ESTIMATORS
    """Flow estimators; networks without delivered weights are trained with the lens, the refiner both ways."""
    steps: int = 12
    """Steps of each optimisation."""
    cases: int = 4
    """Samples per step."""
    judged: int = 8
    """Held-out cases for the hard error."""
    weights: int = 20_000
    """Weights of a flownet or spiking network."""
    directions: int = 4
    """Random directions of the lens's variables in which gradients are checked."""


def study(run: Run[Config]):
    config = run.config
    if min(config.steps, config.cases, config.judged, config.directions) < 1:
        raise DomainError("--steps, --cases, --judged and --directions must be at least 1.")
    pairs = [
        (layer, flow, train)
        for layer in config.layers
        for flow in config.estimators
        for train in (False, True)
    ]
    stored = run.load_state()
    found = dict(stored.numbers) if stored else {}
    with run.progress(len(pairs), "combinations", done=len(found)) as bar:
        for pair in (pair for pair in pairs if label(pair) not in found):
            found[label(pair)] = one(config, *pair)
            run.save_state({}, found)
            bar.advance()
    report(run, found)


def label(pair) -> str:
    layer, flow, train = pair
    return f"{layer} + {flow}{' trained' if train else ''}"


def one(config: Config, layer: str, flow: str, train: bool) -> dict:
    """Figures of one pair, or the reason why it makes no sense."""
    options = configured(
        lens_opt.Config,
        False,
        seed=config.seed,
        events=layer,
        flow=flow,
        train_network=train,
        steps=config.steps,
        cases=config.cases,
        scored=4,
        weights=config.weights,
    )
    try:
        job = lens_opt.prepare(options)
    except CodesignError as error:
        return {"reason": str(error)}
    probed = check(job.system, job.probe, job.loop.optimiser)
    probed.backward()
    junctions = {row["junction"]: row for row in probed.table()}
    job.loop.optimiser.zero_grad()
    row = certificate(job, layer, flow, config.directions)
    before = hard_error(job, config)
    paces = timed(job, config.steps)
    return {
        "error_first_mrad": before,
        "error_last_mrad": hard_error(job, config),
        **paces,
        "certificate_error": row.relative_error,
        "certificate_cosine": row.cosine,
        **{f"gradient_norm_{name}": junctions[name]["gradient_norm"] for name in JUNCTIONS},
        **{f"zero_share_{name}": junctions[name]["zero_share"] for name in JUNCTIONS},
    }


def hard_error(job, config) -> float:
    """Mean hard flow error on held-out cases at the design as it is, mrad."""
    pool = make_worlds(HELD_OUT)
    optics = job.optics(job.camera.variables.detach())
    cases = [draw_case(pool, 9_000_000 + i, frames=17) for i in range(config.judged)]
    return fmean(job.task.judge(optics, case, job.system.flow)["flow_error_mrad"] for case in cases)


def timed(job, steps: int) -> dict[str, float]:
    """Run the loop; median seconds of a step by the clock and of the processor, judgements and the first step left
    out."""
    spent = []
    began = [time.perf_counter(), time.process_time()]

    def restart():
        began[:] = [time.perf_counter(), time.process_time()]

    def advance(**shown):
        spent.append((time.perf_counter() - began[0], time.process_time() - began[1]))
        restart()

    job.loop.run(steps, advance, restart)
    wall, processor = zip(*(spent[1:] or spent), strict=True)
    return {"seconds_per_step": median(wall), "cpu_seconds_per_step": median(processor)}


def certificate(job, layer: str, flow: str, directions: int):
    """Row of the objective's gradient to the lens's variables, on a band-limited wall, with smooth events.

    With hardly any noise the flow comes within hundredths of a pixel, where the gradient is that of rounding; shot
    noise of 40 Hz leaves an error that the lens can change.
    """
    wall = worlds.wall(textures.speckle(5, size_px=1024, finest_px=32.0, coarsest_px=128.0), texel_m=0.002)
    case: Batch = draw_case([wall], 61)
    noisy = replace(SENSOR, shot_rate_hz=40.0)
    system = job.system.replaced(events=events.layer(SMOOTH.get(layer, "counts"), noisy, learn=()))
    fn, params = by_group(system, lambda call: call(case).loss, {"lens": "camera."})
    ladder = NETWORK_STEPS_PX if flow in WEIGHTS else STEPS_PX
    (row,) = certify(fn, params, ladder=ladder, tolerance=0.05, directions=directions)
    return row


def report(run, found):
    done = {name: row for name, row in found.items() if "reason" not in row}
    for name, row in done.items():
        key = name.replace(" + ", "_").replace(" ", "_").replace("-", "_")
        run.record(**{f"{key}_{figure}": value for figure, value in row.items()})
    run.record(combinations_run=len(done), combinations_refused=len(found) - len(done))
    best = min(done, key=lambda name: done[name]["error_last_mrad"])
    run.card("Combinations that run", f"{len(done)} of {len(found)}", "the rest say why not")
    run.card("Least hard flow error", f"{done[best]['error_last_mrad']:.3f} mrad", best)
    steps = run.config.steps
    run.section(
        "Outcome",
        f"{steps} steps from the same detuned lens. The hard error is that of the physical sensor on held-out "
        "textures and motions, with the same estimator. Certificate: autograd of the objective against differences "
        "in random directions of the lens's variables, with the layer itself where it is smooth (sigmoid, counts, "
        "expected) and with smooth counts in its place where it is not. A spiking network has no smooth form: its "
        "gradient is a surrogate's, and differences of its loss are those of single spikes.",
    )
    columns = [
        "combination",
        "error before (mrad)",
        "after (mrad)",
        "s/step",
        "CPU s/step",
        "certificate error",
        "cosine",
    ]
    run.table("Combinations", columns, [[name, *(row[key] for key in SCORES)] for name, row in done.items()])
    run.section(
        "Gradient at the junctions",
        "Norm of the objective's gradient, and share of entries that are exactly 0.",
    )
    columns = ["combination", *(f"{name}: {what}" for name in JUNCTIONS for what in ("norm", "zeros"))]
    rows = [
        [name, *(row[f"{what}_{at}"] for at in JUNCTIONS for what in ("gradient_norm", "zero_share"))]
        for name, row in done.items()
    ]
    run.table("Junctions", columns, rows)
    refused = [[name, row["reason"]] for name, row in found.items() if "reason" in row]
    run.section("What makes no sense")
    run.table("Refused", ["combination", "reason"], refused)
    run.finish(
        "Event layers and flow estimators in one chain",
        f"{len(done)} combinations run, {len(refused)} are refused with a reason; {best} ends lowest.",
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
