"""Where does a lens designed by event flow beat spots and mean MTF, when the motion has a
direction?

A cheap fast lens with few free numbers looks at textured walls from a drive with statistics of its
own: forward, a turn, hovering, any motion, or a file of poses. Six designers with the same
variables, light and limits place and bend it: the film alone, RMS spots, mean MTF at 0.15 cycles
per pixel, the same MTF along the motion of every window, and, on development cases with hard
events, the edge energy and the flow error itself. Held-out cases judge, once as they are and once,
where the motion has a direction, with the motion turned by 90 degrees.
"""

import csv
import math
import statistics
import sys
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, ClassVar

import scipy
import torch

from codesign import flow, lens, render
from codesign.checks import check_positive
from codesign.errors import DomainError, FileFormatError
from codesign.events import HardSensor
from codesign.report.prose import counted
from codesign.system import System
from codesign.system.objectives import angular_error_mrad, edge_energy
from studies.frame.compare import Interval, grouped, log_ratio, log_ratios
from studies.frame.config import check_least
from studies.frame.run import Run, StudyConfig, main
from studies.frame.show import bars, table
from studies.frame.sweep import Row, column, plain, select, sweep
from studies.lens_motion import page, rivals
from studies.lens_motion.forms import Form, make_form
from studies.lens_motion.motions import TALL_PX, WIDE_PX, Motion, drawn_world
from studies.lens_opt.page import verdict
from studies.lens_opt.task import BINS, LIGHT, PITCH_MM, SENSOR, log_error, make_worlds

SAMPLES = 24  # rays per pixel, six of each wavelength
DEVELOPMENT = ("coffee", "chelsea", "rocket", "speckle-101", "speckle-102", "speckle-103")
HELD_OUT = ("camera", "gravel", "grass", "speckle-201", "speckle-202", "speckle-203")
DEVELOPED = 31_000_000  # first seeds of the cases
JUDGED = 32_000_000
# the designers that are judged with the motion turned
TURNED = ("spots", "mtf", "mtf_along", "flow")
POWER = 0.8  # with which the smallest detectable difference would have been seen


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"steps": 15, "developed": 2, "judged": 3, "judged_turned": 2}
    motion: str = "forward"
    """Drives: any, forward, turn, hover, or a file of camera poses (TUM format)."""
    lens: str = "achromat"
    """Lens form: singlet, achromat, pair (two elements) or triplet."""
    fno: float | None = None
    """F-number; the form's own when left out."""
    steps: int = 60
    """Most evaluations of a descent of the designers without frames."""
    developed: int = 24
    """Development cases on which flow and edge energy choose."""
    judged: int = 80
    """Held-out cases."""
    judged_turned: int = 40
    """Held-out cases with the motion turned by 90 degrees."""
    raw: Path | None = None
    """Table of finished runs (docs/lens_motion.csv): draw its figure again and run nothing."""


def study(run: Run[Config]):
    config = run.config
    if config.raw is not None:
        return _redraw(run)
    check_least(config, 1, "steps", "developed")
    check_least(config, 2, "judged", "judged_turned")
    form = make_form(config.lens, config.fno)
    motion = Motion(config.motion, form.efl_mm)
    motion.directions_rad()  # a file that cannot be read is refused here
    answers = {row["designer"]: row["variables"] for row in _designs(run, form, motion)}
    answers |= _chosen(run, form, motion, answers)
    lenses = {name: form.optics(torch.tensor(point)).freeze() for name, point in answers.items()}
    for name, optics in lenses.items():
        lens.save(optics, run.path(f"lens_{name}.json"))
    _finish(run, lenses, motion, _judged(run, lenses, motion))


def _designs(run, form, motion):
    """A row for every designer without frames: its variables, as text of one line in the sweep's
    table."""

    def cell(designer):
        run.say(f"designing: {designer}")
        point = rivals.design(designer, form, motion, run.config.seed, run.config.steps)
        return {f"v{k}": value for k, value in enumerate(point)}

    rows = sweep(run, cell, "designs", designer=rivals.NAMES)
    return [
        {"designer": row["designer"], "variables": [v for k, v in row.items() if k != "designer"]}
        for row in rows
    ]


def judge(optics: lens.GeoLens, motion: Motion, case) -> dict[str, float]:
    """Hard flow error of a lens on one case, geometric mean over the windows in mrad, and its edge
    energy."""
    camera = render.Camera(
        optics, WIDE_PX, TALL_PX, PITCH_MM, SAMPLES, 0, motion.film(), spectrum=LIGHT
    )
    system = System(
        camera=camera,
        events=HardSensor(SENSOR, BINS),
        flow=flow.estimate_lk,
        objectives={"flow": log_error()},
        bins=BINS,
    )
    with torch.no_grad():
        seen = system.begin(case)
        error = angular_error_mrad(
            seen["field"], seen["camera"], seen["scene"], seen["T_world_cam"]
        )
        return {
            "error_mrad": float(error.log().mean().exp()),
            "edge_energy": float(edge_energy(seen["volume"])),
        }


def _chosen(run, form: Form, motion, answers):
    """What flow and edge energy choose on the development cases: among the answers of the others
    and what lies between them, then among film places around flow's best."""
    pool = make_worlds(DEVELOPMENT)

    def tried(name, points):
        lenses = {
            label: form.optics(torch.tensor(point)).freeze() for label, point in points.items()
        }

        def cell(case):
            drawn = motion.case(pool, DEVELOPED + case)
            return [
                {"lens": label, **judge(optics, motion, drawn)} for label, optics in lenses.items()
            ]

        return sweep(run, cell, name, case=range(run.config.developed))

    answers = {name: answers[name] for name in ("spots", "mtf", "mtf_along")}

    def mrad(label):
        return _geometric(column(rows, "error_mrad", lens=label))

    points = answers | rivals.between(answers)
    rows = tried("development", points)
    best = min(points, key=mrad)
    around = {
        f"{best}, film {step:+g}": [points[best][0] + step, *points[best][1:]]
        for step in (-2.0, -1.0, 1.0, 2.0)
    }
    rows += tried("refined", around)
    points |= around
    by_flow = min(points, key=mrad)
    by_edge = max(points, key=lambda label: sum(column(rows, "edge_energy", lens=label)))
    run.say(f"flow chooses: {by_flow}; edge energy chooses: {by_edge}")
    run.section(
        "What flow and edge energy chose from",
        f"{run.config.developed} development cases, hard events. Flow: {by_flow}. Edge: {by_edge}.",
    )
    shown = [(label, mrad(label)) for label in points]
    run.table("Development cases", ("lens", "flow error (mrad)"), shown)
    return {"edge": points[by_edge], "flow": points[by_flow]}


def _judged(run, lenses, motion):
    """Errors of every lens on the held-out cases, the motion as it is and turned."""
    pool = make_worlds(HELD_OUT)
    wanted = [("judged", motion, lenses)]
    if motion.directed:
        shown = {name: lenses[name] for name in TURNED}
        wanted.append(("turned", replace(motion, turned=True), shown))
    rows = []
    for turned, (name, drives, shown) in enumerate(wanted):

        def cell(case, drives=drives, shown=shown):
            drawn = drives.case(pool, JUDGED + case)
            return [
                {"lens": name, **judge(optics, drives, drawn)} for name, optics in shown.items()
            ]

        count = run.config.judged_turned if turned else run.config.judged
        rows += [{"turned": turned, **row} for row in sweep(run, cell, name, case=range(count))]
    return rows


def ratios(rows, design: str, turned: int = 0) -> dict[str, Interval]:
    """Log ratio of the flow error of a design over every other lens, case by case; the wider of two
    intervals: of independent cases, and of the textures that cases share redrawn."""
    rows = select(rows, turned=turned)
    own = column(rows, "error_mrad", lens=design)
    seeds = [JUDGED + int(case) for case in column(rows, "case", lens=design)]
    drawn = [drawn_world(len(HELD_OUT), torch.Generator().manual_seed(seed)) for seed in seeds]
    found = {}
    for name in dict.fromkeys(row["lens"] for row in rows if row["lens"] != design):
        other = column(rows, "error_mrad", lens=name)
        pairs = log_ratio(own, other), grouped(log_ratios(own, other), drawn)
        wider = max(pairs, key=lambda pair: pair.high - pair.low)
        found[name] = replace(wider, count=len(own))
    return found


def detectable(pair: Interval) -> float:
    """The smallest change that the cases would have shown with a power of 80 %, as a log ratio."""
    free = pair.count - 1
    at_95 = float(scipy.stats.t.ppf(0.975, free))
    return (pair.high - pair.low) / 2 / at_95 * (at_95 + float(scipy.stats.t.ppf(POWER, free)))


def _geometric(values):
    return statistics.geometric_mean(values)


def _finish(run, lenses, motion, rows):
    config = run.config
    rays = {name: rivals.rays_at(optics, motion.points_px(), 32) for name, optics in lenses.items()}
    directions = motion.directions_rad()
    around = rivals.ALL_ROUND.expand(len(directions), -1)
    shown = []
    flown, along = ratios(rows, "flow"), ratios(rows, "mtf_along")
    turned = ratios(rows, "flow", 1) if motion.directed else {}
    for name, found in rays.items():
        figures = {
            "rms_px": rivals.rms_px(found),
            "mtf_mean": float(rivals.mtf(found, around).mean()),
            "mtf_along": float(rivals.mtf(found, directions).mean()),
            "error_mrad": _geometric(column(rows, "error_mrad", turned=0, lens=name)),
        }
        run.record(**{f"{key}_{name}": value for key, value in figures.items()})
        row = {"lens": page.LABELS[name], **figures}
        if name in flown:
            row |= {
                "flow": flown[name].percent(),
                "least": f"{100 * math.expm1(detectable(flown[name])):.1f} %",
            }
        if name in along:
            row["along"] = along[name].percent()
        if name in turned:
            row["turned"] = turned[name].percent()
        shown.append(row)
    for prefix, pairs in (
        ("log_ratio", flown),
        ("along_log_ratio", along),
        ("turned_log_ratio", turned),
    ):
        for name, pair in pairs.items():
            run.record(
                **pair.metrics(f"{prefix}_{name}"),
                **{f"{prefix}_{name}_detectable": detectable(pair)},
            )
    said = verdict("the flow design", {page.LABELS[name]: pair for name, pair in flown.items()})
    spots_and_mtf = {page.LABELS[name]: along[name] for name in ("spots", "mtf")}
    said += " " + verdict("the design by MTF along the motion", spots_and_mtf)
    run.section("Who wins", page.EXPLAINED)
    if not motion.directed:
        run.text(f"Motion {config.motion} has no direction, so none is turned: no --judged-turned.")
    titles = {
        "lens": "designer",
        "rms_px": "RMS spot (px)",
        "mtf_mean": "MTF at .15, mean",
        "mtf_along": "along the motion",
        "error_mrad": "flow error (mrad)",
        "flow": "flow over it",
        "least": "smallest detectable",
        "along": "MTF along over it",
        "turned": "flow over it, motion turned",
    }
    run.table("Designers on held-out cases", *table(shown, **titles))
    run.figure(page.point_images(lenses, motion), "point_images", page.IMAGES)
    run.finish(
        "A lens for the motion",
        f"**{said}**\n\n{config.lens} at f/{lenses['flow'].first_order().fno:.3g}, motion {config.motion}.",
    )
    run.say(said)


def _read(path: Path) -> list[Row]:
    """Rows of a table of finished runs by setting, motion, case and lens.

    Raises: FileFormatError where a number is none, or a lens lacks a case or has one twice.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = [
                {**row, "case": int(row["case"]), "turned": int(row["turned"])}
                | {"error_mrad": check_positive(float(row["error_mrad"]), "error_mrad")}
                for row in csv.DictReader(file)
            ]
    except (KeyError, TypeError, ValueError, DomainError) as error:
        raise FileFormatError(
            f"--raw {path} is no table of this study, or damaged: {error}."
        ) from error
    if not rows:
        raise FileFormatError(f"--raw {path} has no row.")
    rows.sort(key=lambda row: row["case"])
    cases: dict[tuple[Any, ...], list[int]] = {}
    for row in rows:
        cases.setdefault((row["setting"], row["turned"], row["lens"]), []).append(row["case"])
    for (setting, turned, name), own in cases.items():
        if own != cases.get((setting, turned, "spots")) or len(set(own)) < len(own):
            raise FileFormatError(f"--raw {path}: '{setting}' has not every case of '{name}' once.")
    return rows


def _redraw(run):
    """The figure of all settings out of the table of finished runs: ratios of the design along the
    motion."""
    if not run.config.raw.is_file():
        raise DomainError(f"--raw {run.config.raw}: there is no such file.")
    rows = _read(run.config.raw)
    values, lines = {}, []
    for setting in dict.fromkeys(row["setting"] for row in rows):
        own = select(rows, setting=setting)
        for turned, design, name in product((0, 1), ("mtf_along", "flow"), ("spots", "mtf")):
            pair = ratios(own, design, turned)[name]
            words = (setting, "turned" if turned else "as it is")
            run.record(**pair.metrics(f"log_ratio_{plain(*words, design, name)}"))
            lines.append(
                {"setting": setting, "motion": words[1], "design": page.LABELS[design]}
                | {"over": page.LABELS[name], "ratio": f"{pair.ratio():.3f}"}
            )
            if design == "mtf_along":
                values[f"{setting}{', turned' if turned else ''}: over {page.LABELS[name]}"] = (
                    pair.ratio()
                )
    run.figure(
        bars(values, "flow error of MTF along the motion, ratio", log=True, level=1.0),
        "lens_motion",
        "Ratios with 95 % intervals.",
    )
    run.section(
        "Every setting",
        f"Cases share {counted(len(HELD_OUT), 'texture')}. Of two intervals the wider one is shown: cases taken as independent, "
        "and textures redrawn with their cases, as far as so few can tell.",
    )
    run.table("Ratios of flow error", *table(lines))
    as_is, turned = ([r for n, r in values.items() if ("turned" in n) == t] for t in (False, True))
    better, worse = sum(r.high < 1 for r in as_is), sum(r.low > 1 for r in turned)
    run.finish(
        "A lens for the motion: all settings",
        f"Seen as it was designed for, the lens by MTF along the motion has less flow error in {better} of "
        f"{counted(len(as_is), 'comparison')} (by the interval); where the motion is turned, it has more in {worse} of {len(turned)}. "
        f"Drawn from {run.config.raw.name}.",
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
