"""The page of a lens_opt run: who wins, the rivals, layouts, spots, frames, event frames, curves, junction table."""

import numpy as np
import torch

from codesign import events, render
from codesign.errors import MissingPackageError
from codesign.report import chain_figures, lens_figures
from scenes import worlds
from studies.frame.compare import log_ratio
from studies.lens_opt import comparison
from studies.lens_opt.comparison import DESIGNS, RIVALS, label
from studies.lens_opt.task import DISTANCE_M, FIELDS, PITCH_MM, SENSOR


def blank_wall():
    """A wall without texture: the negative control."""
    return worlds.wall(np.full((64, 64), 60.0, dtype=np.float32), texel_m=0.003)


def write(run, course, lenses, junctions):
    """Fill and finish the run's page."""
    config = run.config
    job = course.jobs["optimised"]
    found = course.found
    design = DESIGNS[config.objective]
    errors = {name: [row["flow_error_mrad"] for row in rows] for name, rows in found.items()}
    pairs = {name: log_ratio(errors["optimised"], errors[name]) for name in RIVALS if name in lenses}
    said = comparison.verdict(design, {RIVALS[name]: pair for name, pair in pairs.items()})
    complaints = {v["complaint"] for rows in course.choices.values() for v in rows if v["complaint"]}
    comparison.cards(run, pairs)
    comparison.who_wins(run, course, lenses, errors, complaints)
    comparison.settings(run, course)
    _lenses(run, job.task, lenses)
    _seen_by_the_sensor(run, job, lenses)
    _way(run, course)
    _junctions(run, junctions)
    _cases(run, errors, lenses)
    m = run.metrics
    trained = ", the network trained with the lens" if config.train_network else ""
    pace = f" at {m['seconds_per_step']:.2f} s" if "seconds_per_step" in m else ""
    lead = (
        f"**{said}**\n\nAsked: what does an event-flow objective buy a lens designer over the best spot-size designer? "
        f"{config.lens}, curvatures detuned by seed {config.seed} and refocused, objective {config.objective}, events "
        f"{config.events}, flow {config.flow}{trained}: {m['steps']} steps{pace}. Changes are of the geometric mean "
        "flow error, case by case, with 95 % intervals of Student's t."
    )
    run.finish("Lens optimisation for event flow", lead)
    run.say(said)


def _lenses(run, task, lenses):
    run.section("The lenses", "Cross-sections with meridional rays at the three fields, and their spots.")
    named = {
        label(name, run.config.objective): optics
        for name, optics in lenses.items()
        if name in ("nominal", "detuned", "spots", "optimised")
    }
    run.figure(
        lens_figures.layouts(named, task.fields_rad),
        "lens_layout",
        "Light comes from the left. Colours are fields 0, 0.7 and 1 of the half diagonal.",
    )
    run.figure(
        lens_figures.spot_diagrams(named, task.fields_rad, PITCH_MM, DISTANCE_M),
        "spot_diagrams",
        f"Spots of the wall at {DISTANCE_M:g} m and 587.6 nm about their mean; the red square is one pixel.",
    )


def _seen_by_the_sensor(run, job, lenses):
    run.section(
        "What the sensor sees",
        "One training scene through the detuned, the spot designer's and the optimised lens: first frame and signed "
        "event counts over the whole interval, at the three windows.",
    )
    run.figure(
        _seen(
            job.task,
            {name: lenses[name] for name in ("detuned", "spots", "optimised")},
            job.probe,
            run.config,
        ),
        "frames_and_events",
        "Top of each pair: frame; below: ON minus OFF events (red minus blue).",
    )
    _seed_emulator(run, job.task, lenses["optimised"], job.probe)


def _way(run, course):
    run.section("The way there")
    for name, job in course.jobs.items():
        objective = "flow" if name == "after_spots" else run.config.objective if name == "optimised" else name
        record = job.loop.record
        done = list(range(1, len(record.loss) + 1))
        losses = {
            "each step, its own cases": (done, record.loss),
            "fixed training cases, hard sensor": (record.judged_step, record.score),
        }
        run.figure(
            chain_figures.curves(losses, _loss_label(objective)),
            f"loss_curve_{name}",
            f"Loss while optimising: {label(name, run.config.objective)}.",
        )
    job = course.jobs["optimised"]
    steps = job.loop.record.judged_step
    spots = {f"field {h:g}": (steps, [row[k] for row in job.history.spot_um]) for k, h in enumerate(FIELDS)}
    run.figure(
        chain_figures.curves(spots, "RMS spot (µm)"), "spot_curve", "RMS spot of the best design so far."
    )
    for name, unit in (("curvature", "1/mm"), ("thickness", "mm")):
        rows = np.array(getattr(job.history, name))
        series = {f"surface {k + 1}": (steps, rows[:, k] - rows[0, k]) for k in range(rows.shape[1])}
        run.figure(
            chain_figures.curves(series, f"change of {name} ({unit})"),
            f"{name}_curves",
            f"Change of each {name} since the detuned start; the last curvature holds the focal length.",
        )


def _junctions(run, junctions):
    run.section(
        "Gradient at every junction",
        "One pass at the end point: norms of value and gradient, and the share of gradient entries that are "
        "exactly zero.",
    )
    run.table(
        "Junctions",
        ["junction", "value norm", "gradient norm", "zero share"],
        [[r["junction"], r["value_norm"], r["gradient_norm"], r["zero_share"]] for r in junctions],
    )


def _cases(run, errors, lenses):
    m = run.metrics
    objective = run.config.objective
    run.section("Case by case", "The control is a wall without texture, where no lens can help.")
    rows = [[i + 1, *(round(errors[name][i], 3) for name in lenses)] for i in range(len(errors["optimised"]))]
    names = [label(name, objective) for name in lenses]
    run.table("Angular flow error per held-out case (mrad)", ["case", *names], rows)
    run.table(
        "Means",
        ["lens", "edge energy", "events per pixel", "focal length (mm)", "f-number"],
        [
            [
                label(n, objective),
                *(m[f"{key}_{n}"] for key in ("edge_energy_hard", "events_per_pixel_hard", "efl_mm", "fno")),
            ]
            for n in lenses
        ],
    )
    run.text(
        f"Control without texture: detuned {m['flow_error_mrad_hard_control_detuned']:.2f} mrad, optimised "
        f"{m['flow_error_mrad_hard_control_optimised']:.2f} mrad."
    )


def _seed_emulator(run, task, optics, case):
    """The seed project's view of the same scene: naive frame-difference events as CSV, and their
    exponential-decay video."""
    with torch.no_grad():
        frames = render.frames(
            task.camera(optics, run.config.samples, case.seed), case.scene, case.T_world_body
        )
    tall = frames.reshape(frames.shape[0], -1, frames.shape[-1])  # the windows above one another
    stream = events.naive(tall, case.t_s, SENSOR.theta_on)
    events.write(run.path("events_naive.csv"), stream)
    try:
        events.decay_video(run.path("events_decay.mp4"), stream, case.t_s, 0.015, fps=8)
    except MissingPackageError as error:
        run.text(f"**Left out**: the video of fading events. {error}")
        run.say(f"left out: the video of fading events; {error}")
        return
    run.video(
        "events_decay.mp4",
        f"{len(stream)} events of the naive frame-difference emulator (events_naive.csv), fading over 15 "
        "ms; the three windows above one another.",
    )


def _loss_label(objective):
    return "mean log angular error (log mrad)" if objective == "flow" else "−(edge energy − λ activity)"


def _seen(task, lenses, case, config):
    rows = []
    labels = []
    signed = []
    for name, optics in lenses.items():
        with torch.no_grad():
            camera = task.camera(optics, config.samples, case.seed)
            frames = render.frames(camera, case.scene, case.T_world_body)
            counts, _ = events.memory(frames, SENSOR.theta_on, SENSOR.theta_off)
        total = counts.sum(0)
        rows += [list(frames[0].numpy()), list((total[0] - total[1]).numpy())]
        labels += [f"{label(name, config.objective)}: {what}" for what in ("frame", "events")]
        signed += [False, True]
    return chain_figures.strips(rows, [f"field {h:g}" for h in FIELDS], signed, labels)
