"""Does it pay to design lens, mount, sensor and estimator of a robot's camera together?

One whole design is a vector: focal length, f-number and focus of the lens; place and pitch of the
mount; threshold and bandwidth of the pixels; the prior of the flow's estimator. It pays for what it
takes: light as 1 / N^2, noise events as thresholds fall, a bus of limited width, a mast that sways
(scenes/robots/costs.py). Arms start at the same designs and render as many drives: jointly, in
every order of the blocks, alternating, nested, by the book, and by searches without gradients.
Single events of the hard sensor in worlds that no arm saw judge them.
"""

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any, ClassVar

from torch import Tensor

from codesign import lens
from codesign.atomic import write_atomic
from codesign.errors import DomainError
from scenes.robots import pair as robot_pair
from scenes.robots.check import check_pair
from scenes.robots.pair import RobotPair
from scenes.robots.pairs import PAIRS
from studies.codesign import couplings, page, slopes
from studies.codesign.arms import ARMS
from studies.codesign.cells import CellsConfig
from studies.codesign.landscape import landscape
from studies.codesign.problem import Drawn
from studies.codesign.race import (
    Judge,
    check_sizes,
    compared,
    racing,
    space_of,
    start,
    taken_up,
    training,
)
from studies.frame.config import check_least
from studies.frame.files import check_same
from studies.frame.run import Run, main
from studies.frame.sweep import Row, sweep
from studies.placement.look import size_in_words
from studies.placement.race import fingerprints
from studies.placement.searches import SEARCHES, available

THIN = "thin"
SHORTLIST = 8  # answers that are looked at once more for the one that is handed over
LEAST_STEPS = 16  # of which an eighth is left to each block of eight sweeps


@dataclass(frozen=True)
class Config(CellsConfig):
    QUICK: ClassVar = {
        **CellsConfig.QUICK,
        "arms": ("joint", "lens > mount > read-out", "default"),
        "designs": 2,
        "grid": 2,
        "slopes": 0,
        "couplings": 0,
    }
    robot: Path | None = None
    """A robot of your own instead, described in a .yaml file (docs/robots_and_worlds.md)."""
    family: str = "retrofocus-4"
    """Family of traced lenses, or thin."""
    light: float = 1.0
    """Share of daylight."""
    speed: float = 1.0
    """Share of the drives' speed."""
    hold: tuple[str, ...] = ()
    """Numbers that are held elsewhere than the pair has them, such as fno=4."""
    free: tuple[str, ...] = ()
    """Numbers that are designed, the others being held as the pair has them; all when left out."""
    arms: tuple[str, ...] = tuple(ARMS)
    """Ways to a design that race."""
    seeds: int = 12
    """Paired starting designs; 0 looks at the landscape and races nothing."""
    near: bool = False
    """Start within a tenth of the bounds of the best design looked at, instead of all over them."""
    steps: int = 16
    """Steps of every descent, looks of every search: the budget, a multiple of 16."""
    designs: int = 64
    """Designs all over the bounds, and as many near the best, looked at before the race; 64 and
    more calibrate it."""
    grid: int = 5
    """Designs along each number, through the best."""
    slopes: int = 24
    """Draws by which the objective's slope is compared with rendered differences; 0: it is not."""
    couplings: int = 4
    """Draws by which the couplings of the parts are measured around the best joint answer; 0: they
    are not."""
    raw: Path | None = None
    """Answers of earlier runs (answers.jsonl of their folder, or race.jsonl of one that was cut):
    not raced again."""


def study(run: Run[Config]) -> None:
    size = run.config
    checked(size)
    family = None if size.family == THIN else size.family
    pair = str(size.robot) if size.robot else size.pair
    told = ("light", "speed", "worlds", "per_draw", "steps", "settling")
    setting: dict[str, Any] = {
        **{name: getattr(size, name) for name in told},
        "pair": pair,
        "family": family,
        "free": list(size.free),
        "held": held(size.hold),
        "judge": [size.judged_worlds, size.judged_drives],
    }
    space = space_of(setting)
    # of an own robot, and of the files that its page names
    setting["page"] = json.dumps(fingerprints(space.pair)) if space.pair.page else ""
    same_robot(run, space.pair)
    if size.raw is not None:
        taken_up(size.raw, setting)  # before hours of the rest
    if size.robot:
        run.say(size_in_words(space.pair))
        at = space.pair.design
        turned = (f"{math.degrees(getattr(at, name)):.3g}" for name in ("yaw_rad", "roll_rad"))
        run.say("held: {:.3g} m to the side, yaw {} and roll {} degrees".format(at.y_m, *turned))
        check_pair(space.pair, space.made(space.start).camera, (0, robot_pair.UNSEEN_FROM))
    for seed in range(size.seed, size.seed + size.seeds):
        start(space, seed)
    gates = landscape(run, space, size.designs)
    setting["calibration"] = list(astuple(gates.calibration))
    setting["near"] = gates.best.tolist() if size.near else None
    drawn = training(setting)
    if size.raw is not None and not run.path("race.jsonl").exists():
        for name, known in zip(("race", "answers"), taken_up(size.raw, setting), strict=True):
            write_atomic(run.path(f"{name}.jsonl"), known)
    judge = Judge(space, size.judged_worlds, size.judged_drives)
    rows = raced(run, judge, setting) if size.seeds else []
    said = page.lead(run, space, rows, judge)
    if rows:
        said += page.hand_over(run, space, judge, best_answer(drawn, rows))
    answer = best_joint(drawn, rows) if rows and (size.couplings or size.slopes) else gates.best
    if rows and size.couplings:
        around(run, drawn, rows, answer, setting["near"])
    page.looked(run, space, gates)
    if size.slopes:
        first = start(space, size.seed, setting["near"])
        places = {"answer" if rows else "best": answer, "start": first}
        slopes.show(run, space, slopes.slopes(run, space, drawn, places, size.slopes))
    if rows:
        page.designs(run, space, rows)
    run.record(seconds=run.seconds)
    run.finish("Lens, mount, sensor and estimator together", said)


def same_robot(run: Run[Config], pair: RobotPair) -> None:
    """Raise DomainError where a run that goes on is of another robot than the one that it was
    begun with."""
    now, stored = fingerprints(pair), run.load_state()
    if stored:
        check_same(stored.numbers, now)
    run.save_state({}, now)


def best_joint(drawn: Drawn, rows: Sequence[Row]) -> Tensor:
    """The joint answer [V] of which least is expected."""
    return couplings.share(couplings.best_of(drawn, [row for row in rows if row["arm"] == "joint"]))


def best_answer(drawn: Drawn, rows: Sequence[Row]) -> Row:
    """The answer of which least is expected in drives of the training worlds: among the SHORTLIST of
    any arm and start that expected least on their own way there, and the default."""
    ways = [row for row in rows if row["expected"] is not None]
    still = [row for row in rows if row["expected"] is None]
    listed = sorted(ways, key=lambda row: row["expected"])[:SHORTLIST]
    return couplings.best_of(drawn, [*listed, *still[:1]])


def around(
    run: Run[Config],
    drawn: Drawn,
    rows: Sequence[Row],
    answer: Tensor,
    near: Sequence[float] | None,
) -> None:
    """Couplings around the best joint answer [V], and what the orders would leave
    by them."""
    at = answer.clamp(couplings.STEP, 1 - couplings.STEP)
    seeds = dict.fromkeys(row["seed"] for row in rows)
    starts = [start(drawn.space, seed, near) for seed in seeds]
    measured = {arm: math.exp(-over.value) for arm, (over, _) in compared(rows).items()}
    pulls = sweep(
        run,
        lambda draw: couplings.curvatures(drawn, at, draw),
        "couplings",
        draw=range(run.config.couplings),
    )
    couplings.show(run, drawn.space, pulls, at, starts, measured)


def raced(run: Run[Config], judge: Judge, setting: dict[str, Any]) -> list[Row]:
    """Every arm from every start, and its errors by the judge; those of ``raw`` are taken from
    there."""
    size = run.config
    axes = {"seed": range(size.seed, size.seed + size.seeds), "arm": size.arms}
    beside = {"processes": size.processes, "cluster": size.cluster}
    given = {"setting": setting, "threads": 1 if any(beside.values()) else 0}
    rows = sweep(run, racing, "race", given=given, **beside, **axes)
    found = {(row["seed"], row["arm"]): row for row in rows}

    def judged(seed, arm):
        row = {name: value for name, value in found[seed, arm].items() if name not in axes}
        return {**row, **judge(row["share"]), "setting": setting}

    return sweep(run, judged, "answers", **axes)


def held(told: Sequence[str]) -> dict[str, float]:
    """Numbers by name, from "name=number" each."""
    found = {}
    for each in told:
        name, _, value = each.partition("=")
        try:
            found[name] = float(value)
        except ValueError as error:
            raise DomainError(f"--hold {each}: give a number by name, such as fno=4.") from error
    if len(found) < len(told):
        raise DomainError(f"--hold {' '.join(told)}: give each number once.")
    return found


def checked(size: Config) -> None:
    """Raise DomainError for sizes that cannot be."""
    if size.robot is None and size.pair not in PAIRS:
        raise DomainError(
            f"--pair {size.pair}: choose from {', '.join(PAIRS)}, or give --robot and a .yaml file."
        )
    if size.family != THIN:
        lens.family(size.family)
    if size.seeds < 0:
        raise DomainError(f"--seeds is {size.seeds}; 0 or more are needed.")
    check_least(size, 2, "designs")
    check_sizes(size)
    if size.grid < 2 or 1 in (size.slopes, size.couplings) or min(size.slopes, size.couplings) < 0:
        raise DomainError(
            f"--grid needs 2 or more, --slopes and --couplings 0, or 2 and more; they are "
            f"{size.grid}, {size.slopes} and {size.couplings}."
        )
    if size.steps < LEAST_STEPS or size.steps % LEAST_STEPS:
        raise DomainError(f"--steps is {size.steps}; a multiple of {LEAST_STEPS} is needed.")
    unknown = [name for name in size.arms if name not in ARMS]
    if unknown:
        raise DomainError(f"--arms {unknown[0]}: choose from {', '.join(ARMS)}.")
    if "joint" not in size.arms or not 1 < len(size.arms) == len(set(size.arms)):
        raise DomainError(
            "--arms needs joint, with which all others are compared, another one, and each name once."
        )
    if size.processes < 0:
        raise DomainError(f"--processes is {size.processes}; 0 or more are needed.")
    if size.raw is not None and not size.raw.is_file():
        raise DomainError(f"--raw {size.raw}: there is no such file.")
    available(name for name in ("CMA-ES", *size.arms) if name in SEARCHES)


if __name__ == "__main__":
    sys.exit(main(study, Config))
