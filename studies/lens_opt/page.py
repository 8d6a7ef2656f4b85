"""The page of a lens_opt run: who wins, the rivals, layouts, spots, frames, event frames, curves,
junction table."""

import math
from collections.abc import Mapping
from dataclasses import replace
from statistics import fmean

import numpy as np
import torch

from codesign import events, render
from codesign.errors import MissingPackageError
from codesign.report.prose import counted
from scenes import worlds
from studies.frame.compare import Interval, log_ratio
from studies.frame.show import Panel, bars, panels, pictures, table
from studies.frame.sweep import column
from studies.lens_opt.task import DISTANCE_M, FIELDS, PITCH_MM, SENSOR, window_shares

DESIGNS = {"flow": "the flow design", "edge": "the edge design"}
RIVALS = {
    "refocused": "refocusing alone",
    "spots": "the spot designer",
    "edge": "the edge objective",
    "flow": "the flow objective",
}
LENSES = {
    "nominal": "published lens, in focus",
    "defocused": "detuned, with its focus error",
    "detuned": "detuned, in focus: the start",
    "after_spots": "flow steps after the spot designer",
}


def label(name, objective):
    """What a lens is called on the page."""
    if name == "optimised":
        return DESIGNS[objective].removeprefix("the ")
    return LENSES.get(name) or RIVALS[name].removeprefix("the ")


def verdict(design: str, rivals: Mapping[str, Interval]) -> str:
    """One sentence that says first who wins: the rivals that do, those that are undecided, or the
    design where it beats all.

    Args:
      design: what it is called, "the flow design".
      rivals: what each is called -> log ratio of the design over it.
    """
    alike = [name for name, pair in rivals.items() if pair.low == pair.high == 0]
    others = {name: pair for name, pair in rivals.items() if name not in alike}
    said = []
    undecided = ("is undecided", "are undecided")
    for outcome, words in (("loses", ("wins", "win")), (undecided[0], undecided)):
        found = {name: pair for name, pair in others.items() if pair.outcome == outcome}
        if found:
            several = len(found) > 1
            said.append(
                f"{' and '.join(found)} {words[several]}: the flow error of {design} against "
                f"{'them' if several else 'it'} is {' and '.join(pair.percent() for pair in found.values())}"
            )
    if others and not said:
        name, closest = max(others.items(), key=lambda item: item[1].value)
        said.append(
            f"{design} wins: its flow error against its best rival, {name}, is {closest.percent()}"
        )
    if alike:
        said.append(f"{' and '.join(alike)} and {design} err exactly alike")
    sentence = f"{'; '.join(said)} on {next(iter(rivals.values())).count} unseen cases."
    return sentence[0].upper() + sentence[1:]


def blank_wall(device):
    """A wall without texture: the negative control."""
    even = np.full((64, 64), 60.0, dtype=np.float32)
    return worlds.wall(even, texel_m=0.003, device=torch.device(device).type)


def write(run, course, lenses, junctions):
    config = run.config
    task = course.jobs["optimised"].task
    names = {name: label(name, config.objective) for name in lenses}
    errors = {name: column(rows, "flow_error_mrad") for name, rows in course.found.items()}
    pairs = {
        name: log_ratio(errors["optimised"], errors[name]) for name in lenses if name != "optimised"
    }
    rivals = [name for name in RIVALS if name in lenses]
    said = verdict(DESIGNS[config.objective], {RIVALS[name]: pairs[name] for name in rivals})
    _who_wins(run, names, pairs, rivals)
    for complaint in sorted(
        {v["complaint"] for rows in course.choices.values() for v in rows} - {""}
    ):
        run.text(f"**Note**: {complaint}")
    if "after_spots" in lenses:
        pair = log_ratio(errors["after_spots"], errors["spots"])
        run.text(
            f"{config.after_steps} steps of the flow objective from the spot designer's lens "
            f"change its flow error by {pair.percent()}: by its interval, it {pair.outcome}."
        )
    _by_window(run, course.found, names, rivals)
    _settings(run, course)
    shown = {names[name]: lenses[name] for name in ("nominal", "detuned", "spots", "optimised")}
    _lenses(run, task, shown)
    _seen_by_the_sensor(run, course.jobs["optimised"], shown)
    _way(run, course)
    run.section(
        "Gradient at every junction",
        "One pass at the end point: norms of value and gradient, and the share of gradient entries that are "
        "exactly zero.",
    )
    run.table("Junctions", *table(junctions))
    _cases(run, errors, names)
    m = run.metrics
    trained = ", the network trained with the lens" if config.train_network else ""
    pace = f" at {m['seconds_per_step']:.2f} s" if "seconds_per_step" in m else ""
    run.finish(
        "Lens optimisation for event flow",
        f"**{said}**\n\nAsked: what does an event-flow objective buy a lens designer over the best "
        f"spot-size designer? {config.lens}, curvatures detuned by seed {config.seed} and "
        f"refocused, objective {config.objective}, events {config.events}, flow "
        f"{config.flow}{trained}: {m['steps']} steps{pace}. Changes are of the geometric mean flow "
        "error, case by case, with 95 % intervals of Student's t.",
    )
    run.say(said)


def _who_wins(run, names, pairs, rivals):
    """Cards, and table and bars of the paired differences over all windows."""
    design = names["optimised"]
    m = run.metrics
    for name in ("optimised", *rivals):
        change = "mean of held-out cases"
        if name in pairs:
            change = f"the design against it: {pairs[name].percent()}"
        error, spot = m[f"flow_error_mrad_hard_{name}"], m[f"rms_spot_um_{name}"]
        run.card(
            f"Flow error, {names[name]}", f"{error:.3f} mrad", f"RMS spot {spot:.1f} µm; {change}"
        )
    run.section(
        "Who wins",
        "Hard events from the physical sensor, textures and motions never optimised on, the same "
        f"cases for every lens. A change below 0 says that the {design} errs less than the lens of "
        "the row; where the interval holds 0, it is undecided. All lenses have the same free "
        "variables, focal length, f-number and floors of thickness; the published lens is a "
        "yardstick that no design here knows.",
    )
    columns = {
        "flow_error_mrad_hard": "flow error (mrad)",
        "rms_spot_um": "RMS spot (µm)",
        "edge_below_floor_mm": "edge below its floor (mm)",
    }
    rows = []
    for name, title in names.items():
        change = (pairs[name].percent(), pairs[name].outcome) if name in pairs else ("", "")
        rows.append([title, *(m[f"{key}_{name}"] for key in columns), *change])
    run.table(
        "Lenses on held-out cases",
        ["lens", *columns.values(), f"change by the {design}", "it"],
        rows,
        f"RMS spot: mean over three fields of a wall at {DISTANCE_M:g} m, four wavelengths; a pixel is "
        f"{PITCH_MM * 1e3:g} µm.",
    )
    ratios = {
        names[name]: replace(
            pair, **{k: math.exp(min(getattr(pair, k), 4.0)) for k in ("value", "low", "high")}
        )
        for name, pair in pairs.items()
        if name not in ("nominal", "defocused")
    }
    run.figure(
        bars(ratios, f"flow error of the {design} / flow error of the lens", log=True, level=1.0),
        "pairs",
        f"Flow error of the {design} over that of each lens: mean and 95 % interval.",
    )


def _by_window(run, found, names, rivals):
    rows = []
    for h, share in zip(FIELDS, window_shares(), strict=True):
        key = f"flow_error_mrad_field_{h:g}"
        own, *others = (column(found[name], key) for name in ("optimised", *rivals))
        changes = (log_ratio(own, other).percent() for other in others)
        rows.append([f"{share:.2f}", fmean(own), *changes])
    run.table(
        "Where: by window",
        [
            "middle of the window, of the way to the corner",
            f"{names['optimised']} (mrad)",
            *(names[name] for name in rivals),
        ],
        rows,
        "Change of flow error by the design against each rival, in one window.",
    )


def _settings(run, course):
    config = run.config
    run.section(
        "The rivals at their best",
        "Refocusing moves the film alone. The spot designer minimises the weighted mean square "
        "spot of the wall in the camera's own light by damped least squares, from "
        f"{counted(config.spot_starts, 'start')}. Both choose among the settings below by the geometric mean "
        f"flow error on {counted(config.developed, 'development case')}, of other textures than those "
        "optimised on and those judged on. The other gradient objective runs from the same start, "
        "for as many steps, with a clip and a step size of its own, the best of a few on "
        "development cases.",
    )
    error = "flow error on development cases (mrad), the least is chosen"
    for name, rows in course.choices.items():
        title = f"Settings: {label(name, config.objective)}"
        run.table(title, *table(rows, setting="setting", error_mrad=error))


def _lenses(run, task, shown):
    from codesign.report import lens_figures

    run.section(
        "The lenses", "Cross-sections with meridional rays at the three fields, and their spots."
    )
    run.figure(
        lens_figures.layouts(shown, task.fields_rad),
        "lens_layout",
        "Light comes from the left. Colours are fields 0, 0.7 and 1 of the half diagonal.",
    )
    run.figure(
        lens_figures.spot_diagrams(shown, task.fields_rad, PITCH_MM, DISTANCE_M),
        "spot_diagrams",
        f"Spots of the wall at {DISTANCE_M:g} m and 587.6 nm about their mean; the red square is one pixel.",
    )


def _seen_by_the_sensor(run, job, shown):
    case = job.probe
    rows, seen = {}, {}
    for title, optics in shown.items():
        with torch.no_grad():
            camera = job.task.camera(optics, run.config.samples, case.seed)
            frames = render.frames(camera, case.scene, case.T_world_body)
            on, off = events.memory(frames, SENSOR.theta_on, SENSOR.theta_off)[0].sum(0)
        seen[title] = frames.cpu()
        balance = (on - off).cpu().numpy()
        for h, frame, count in zip(FIELDS, seen[title][0].numpy(), balance, strict=True):
            rows.setdefault(title, {}).update({f"field {h:g}": frame, f"events {h:g}": count})
    run.section(
        "What the sensor sees",
        "One training scene: first frame and signed event counts over the whole interval, at the "
        "three windows.",
    )
    run.figure(
        pictures(rows, signed=[f"events {h:g}" for h in FIELDS]),
        "frames_and_events",
        "Frames, and ON minus OFF events (red minus blue).",
    )
    _fading_events(run, seen[label("optimised", run.config.objective)], case.t_s)


def _fading_events(run, frames, t_s):
    """Events as a frame-difference emulator makes them of frames: a CSV file, and a video in which
    they fade."""
    stream = events.naive(frames.flatten(1, 2), t_s, SENSOR.theta_on)
    events.write(run.path("events_naive.csv"), stream)
    try:
        events.decay_video(run.path("events_decay.mp4"), stream, t_s, 0.015, fps=8)
    except MissingPackageError as error:
        run.text(f"**Left out**: the video of fading events. {error}")
        return
    run.video(
        "events_decay.mp4",
        f"{len(stream)} events of frame differences (events_naive.csv), fading over 15 ms; the "
        "three windows above one another.",
    )


def _way(run, course):
    run.section("The way there")
    objective = run.config.objective
    for name, job in course.jobs.items():
        record = job.loop.record
        of = "flow" if name == "after_spots" else objective if name == "optimised" else name
        losses = {
            "each step, its own cases": (range(1, len(record.loss) + 1), record.loss),
            "fixed training cases, hard sensor": (record.judged_step, record.score),
        }
        title = (
            "mean log angular error (log mrad)" if of == "flow" else "−(edge energy − λ activity)"
        )
        caption = f"Loss while optimising: {label(name, objective)}."
        run.figure(panels(Panel(losses, "step", title), width=7), f"loss_curve_{name}", caption)
    job = course.jobs["optimised"]
    steps = job.loop.record.judged_step
    charts = []
    for name, unit in (("curvature", "1/mm"), ("thickness", "mm")):
        rows = np.array(getattr(job.history, name))
        series = {
            f"surface {k + 1}": (steps, column) for k, column in enumerate((rows - rows[0]).T)
        }
        charts.append(Panel(series, "step", f"change of {name} ({unit})"))
    spots = zip(FIELDS, np.array(job.history.spot_um).T, strict=True)
    charts.append(
        Panel({f"field {h:g}": (steps, row) for h, row in spots}, "step", "RMS spot (µm)")
    )
    run.figure(
        panels(*charts),
        "design_curves",
        "The best design so far: change since the detuned start (the last curvature holds the "
        "focal length), and spots.",
    )


def _cases(run, errors, names):
    m = run.metrics
    run.section("Case by case", "The control is a wall without texture, where no lens can help.")
    cases = zip(*(errors[name] for name in names), strict=True)
    rows = [[i, *(round(error, 3) for error in case)] for i, case in enumerate(cases, 1)]
    run.table("Angular flow error per held-out case (mrad)", ["case", *names.values()], rows)
    keys = ("edge_energy_hard", "events_per_pixel_hard", "efl_mm", "fno")
    run.table(
        "Means",
        ["lens", "edge energy", "events per pixel", "focal length (mm)", "f-number"],
        [[title, *(m[f"{key}_{name}"] for key in keys)] for name, title in names.items()],
    )
    detuned, optimised = (
        m[f"flow_error_mrad_hard_control_{name}"] for name in ("detuned", "optimised")
    )
    run.text(
        f"Control without texture: detuned {detuned:.2f} mrad, optimised {optimised:.2f} mrad."
    )
