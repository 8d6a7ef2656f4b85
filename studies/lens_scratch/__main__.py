"""Design a triplet from plane plates: does it reach a published lens, from how many starts, and
what does each method take?

Three plates of N-SK16, F2 and N-SK16, plane but for radii of some two metres drawn from the seed,
become a 50 mm f/5 triplet of 40 degrees by real rays alone: ray errors in F, d and C and hinges on
centres, edges, gaps, length and back focus, in one damped least-squares problem of 11 variables.
The yardstick is the published Cooke triplet: success is a mean RMS spot within twice its own, over
fields 0, 0.7 and 1 with the whole unvignetted pupil, every ray passing and every limit held.
"""

import math
import statistics
import sys
from dataclasses import dataclass
from statistics import fmean
from typing import ClassVar

import matplotlib.pyplot as plt
import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.lens.design.constraints import active
from codesign.report import lens_figures
from codesign.report.prose import counted
from studies.frame.compare import share
from studies.frame.run import Run, StudyConfig, main
from studies.frame.show import table
from studies.frame.sweep import sweep
from studies.lens_scratch.search import METHODS, search
from studies.lens_scratch.task import JUDGED_FIELDS, judge, polychromatic_spots_um

YARDSTICK = "cooke-triplet"
ALLOWED = 2.0  # mean RMS spot over that of the yardstick
TIGHT = 0.2  # share of a limit's scale within which it is said to bind


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"seeds": 3, "methods": ("curriculum",)}
    seeds: int = 10
    """Starts per method, seeded by --seed and the numbers after it."""
    methods: tuple[str, ...] = ("curriculum", "direct")
    """Methods to compare, out of curriculum and direct; the first is the one that counts."""


def study(run: Run[Config]):
    config = run.config
    if config.seeds < 1 or not config.methods or set(config.methods) - set(METHODS):
        raise DomainError(
            f"{config.seeds} seeds and methods {config.methods}: give at least one seed, and methods out of "
            f"{', '.join(METHODS)}."
        )
    seeds = range(config.seed, config.seed + config.seeds)
    published = lens.load(YARDSTICK).freeze()
    published_um = fmean(polychromatic_spots_um(published))
    goal_um = ALLOWED * published_um
    run.say(f"{YARDSTICK}: mean RMS spot {published_um:.2f} um in F, d, C; goal {goal_um:.2f} um")
    given = {"goal_um": goal_um, "shorten": 2 if config.quick else 1}
    rows = sweep(run, search, "searches", given=given, method=config.methods, seed=seeds)
    found = [(row, judge(torch.tensor(row["variables"], dtype=torch.float64))) for row in rows]
    for method in config.methods:
        record_method(run, method, [pair for pair in found if pair[0]["method"] == method])
    run.record(
        published_mean_spot_um=published_um,
        published_mean_spot_d_um=fmean(polychromatic_spots_um(published, ("d",))),
        goal_mean_spot_um=goal_um,
    )
    show(run, published, found)


def record_method(run, method, found):
    """Figures of one method into metrics.json, and its card."""
    wins = [row for row, _ in found if row["succeeded"]]
    succeeded = share(len(wins), len(found))
    figures = {
        "seeds": len(found),
        "seeds_succeeded": len(wins),
        "success_low": succeeded.low,
        "success_high": succeeded.high,
        "seeds_succeeded_at_first_attempt": sum(row["attempts"] == 1 for row in wins),
        "seconds_total": sum(row["seconds"] for row, _ in found),
        "evaluations_total": sum(row["evaluations"] for row, _ in found),
    }
    spots = [v.mean_um for _, v in found if v is not None and math.isfinite(v.mean_um)]
    if spots:
        for name, statistic in (("best", min), ("median", statistics.median), ("worst", max)):
            figures[f"{name}_mean_spot_um"] = statistic(spots)
    run.record(**{f"{method}_{name}": value for name, value in figures.items()})
    run.card(
        method.capitalize(),
        f"{len(wins)} of {len(found)} seeds",
        f"{METHODS[method]}; 95 % interval {succeeded.low:.0%} to {succeeded.high:.0%}",
    )


def show(run, published, found):
    """The page: success by method, the designs of the first one, all searches."""
    published_um, goal_um = (run.metrics[f"{name}_mean_spot_um"] for name in ("published", "goal"))
    run.card(
        "Published lens",
        f"{published_um:.2f} µm",
        f"mean RMS spot in F, d, C; the goal is {goal_um:.2f} µm",
    )
    first = [pair for pair in found if pair[0]["method"] == run.config.methods[0]]
    run.figure(
        layouts(published, first),
        "layouts",
        "The published lens and the design of every seed of the first method, with the rays of fields 0, 0.7 and 1.",
    )
    rows = []
    for row, v in found:
        shown = {name: value for name, value in row.items() if name != "variables"}
        if v is not None:
            tight = [f"{c.name} ({c.state(TIGHT)})" for c in active(v.limits, TIGHT)]
            shown |= {
                "mean spot (µm)": v.mean_um,
                "limits that bind or fail": "; ".join(tight) or "none",
            }
        rows.append(shown)
    run.table("Seeds", *table(rows))
    run.finish(
        "A lens from plane plates",
        f"{answer(run)} Three glasses in a given order, a stop, a focal length and limits; no start design, no drawing "
        "from known lenses.",
    )


def answer(run):
    """Whether the published lens is reached, and from how many starts."""
    of = [
        f"{run.metrics[f'{method}_seeds_succeeded']} of {counted(run.metrics[f'{method}_seeds'], 'start')} ({method})"
        for method in run.config.methods
    ]
    return f"{ALLOWED:g} times the spot of {YARDSTICK} or less is reached from {', '.join(of)}."


def layouts(published, found):
    """Small layouts, the published lens first."""
    shown = [("published", published)]
    shown += [
        (f"seed {row['seed']}: {v.mean_um:.1f} µm", v.geo) for row, v in found if v and v.rays_pass
    ]
    count = math.ceil(len(shown) / 3)
    figure, axes = plt.subplots(
        count, 3, figsize=(13, 2.6 * count), squeeze=False, layout="constrained"
    )
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, (title, geo) in zip(axes.flat, shown, strict=False):
        lens_figures.draw_layout(axis, geo, JUDGED_FIELDS, rays=3)
        axis.set_title(title, loc="left", fontsize=9)
    return figure


if __name__ == "__main__":
    sys.exit(main(study, Config))
