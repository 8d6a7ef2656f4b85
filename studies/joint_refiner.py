"""Does a camera that is designed together with the refiner that reads its events, all numbers and
weights in one optimiser, beat one that is designed first?

Lens, mount and sensor of a robot's camera move by the slopes of studies.codesign, through the
refiner's flow; its weights by the gradient of the velocity's error through least squares and flow.
Both are parameters of one torch.optim.Adam. The rivals have the same starts, drives and updates.
"""

import sys
from dataclasses import dataclass
from typing import ClassVar

from studies.codesign.cells import CellsConfig, setting, space_of
from studies.codesign.race import ENOUGH, compared
from studies.codesign.refined import AFTERWARDS, JOINT, raced
from studies.frame.config import check_least
from studies.frame.run import Run, main
from studies.frame.show import tabulate
from studies.frame.sweep import plain, select, sweep, typical

OWN = ("judged_worlds", "judged_drives", "rate", "updates")


@dataclass(frozen=True)
class Config(CellsConfig):
    QUICK: ClassVar = {"seeds": 1, "steps": 2, "worlds": 2, "per_draw": 2, "judged_worlds": 2}
    seeds: int = 12
    """Paired starting designs."""
    rate: float = 3e-4
    """Of Adam, for the weights."""
    updates: int = 4
    """Of the weights, on every round of drives."""


def study(run: Run[Config]) -> None:
    config = run.config
    check_least(config, 1, "updates")
    check_least(config, 0, "rate")
    free = space_of(setting(config)).free
    # the closed form's prior is nothing to a refiner
    cell = setting(config, free=[name for name in free if name != "prior_px"])
    cell |= {name: getattr(config, name) for name in OWN}
    beside = {"processes": config.processes, "cluster": config.cluster}
    given = {"setting": cell, "threads": 1 if any(beside.values()) else 0}
    seeds = range(config.seed, config.seed + config.seeds)
    rows = sweep(run, raced, "answers", given=given, **beside, seed=seeds)
    over = compared(rows, JOINT)
    trained = compared(rows, AFTERWARDS)["design alone"][0].ratio()
    run.record(**trained.metrics("training_over_none"))
    lines = []
    for arm in dict.fromkeys(row["arm"] for row in rows):
        mine = select(rows, arm=arm)
        line = {"arm": arm, "refiner": typical(mine)}
        line["closed_form"] = typical(mine, "closed_form_errors")
        if arm in over:
            ratio, p = over[arm][0].ratio(), over[arm][1]
            run.record(**ratio.metrics(plain("joint over", arm)))
            line |= {"over": f"{ratio:.2f}", "p": p}
        lines.append(line)
    run.section(
        "Judged by single events in unseen worlds",
        f"Medians of bounded errors over {len(seeds)} starts, the same answers read by the arm's refiner and by the closed form; "
        "ratios with 95 % of resampled starts and worlds, p by signs of the starts after Holm.",
    )
    titles = {"arm": "arm", "refiner": "refiner", "closed_form": "closed form"}
    titles |= {"over": "joint over it", "p": "p"}
    tabulate(run, "Arms", lines, "arm", prefix="arm", **titles)
    found, _ = over[AFTERWARDS]
    few = " So few starts decide nothing." if config.quick or len(seeds) < ENOUGH else ""
    run.finish(
        "The refiner in the joint optimiser",
        f"Designed together with its refiner, the camera of '{config.pair}' {found.outcome} against the same design followed by "
        f"training: errors {found.ratio():.2f} of it. Training leaves {trained:.2f} of the error.{few}",
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
