"""Does it pay to design lens, mount, sensor and estimator together, over all robots raced?

Takes the judged answers of races (answers.jsonl of studies.codesign), and holds two ways of joint
design, one descent along all numbers and nested, against the best order of single blocks and every
other arm that was raced there: on each robot, and over all of them. Races nothing.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import torch

from codesign.errors import DomainError
from studies.codesign.page import best_order
from studies.codesign.race import ENOUGH, answers, paired
from studies.frame.compare import Interval, crossed, holm, sign_flip
from studies.frame.run import Run, StudyConfig, main
from studies.frame.show import bars
from studies.frame.sweep import Row, column, plain, select

WAYS = {"nested": "nested", "joint": "one descent"}
ORDER = "best order"


@dataclass(frozen=True)
class Config(StudyConfig):
    raw: tuple[Path, ...] = (
        Path("docs/joint_race_outdoors.jsonl"),
        Path("docs/joint_race_corridor.jsonl"),
        Path("docs/joint_race_flight.jsonl"),
    )
    """Tables of judged answers, one for each robot."""


def study(run: Run[Config]) -> None:
    robots = [read(path) for path in run.config.raw]
    if not robots:
        raise DomainError("--raw names no table; give answers.jsonl of one run or more.")
    found: dict[tuple[str, str], Interval] = {}
    outcomes: dict[tuple[str, str], str] = {}
    lines = []
    arms = [{row["arm"]: None for row in rows} for _, rows, _ in robots]
    others = [arm for arm in arms[0] if arm not in WAYS and all(arm in each for each in arms)]
    for way in WAYS:
        logs = {
            each: [paired(rows, way, best if each == ORDER else each) for _, rows, best in robots]
            for each in (ORDER, *others)
        }
        p = holm([sign_flip(torch.cat([each.mean(1) for each in of])) for of in logs.values()])
        for (rival, of), chance in zip(logs.items(), p, strict=True):
            over = crossed(*of)
            found[way, rival], outcomes[way, rival] = over.ratio(), over.outcome
            line: Row = {"over": f"{WAYS[way]} over {rival}"}
            for (robot, *_), each in zip(robots, of, strict=True):
                alone = crossed(each).ratio()
                line[robot] = f"{alone:.2f}"
                run.record(**alone.metrics(plain(way, "over", rival, robot)))
            ahead = sum(int((each.mean(1) < 0).sum()) for each in of)
            line |= {"all": f"{found[way, rival]:.2f}", "p": chance, "ahead": ahead}
            lines.append(line)
            name = plain(way, "over", rival)
            told = {f"{name}_p": chance, f"{name}_ahead": ahead}
            run.record(**found[way, rival].metrics(name), **told)
    run.section(
        "Over all robots",
        "Errors over those of a rival from the same start, in the same unseen worlds: geometric mean over worlds, median over "
        "starts; over all robots the mean of their logarithms. Intervals are 95 % of resampled starts and worlds, p by signs of "
        "all starts after Holm over the rivals of a way. Signs do not know how worlds differ, so p may be small where the interval "
        "holds 1. Best order: the one of the raced orders that errs least itself.",
    )
    starts = found["nested", ORDER].count
    titles = {"over": "error of", **{robot: robot for robot, *_ in robots}, "all": "all"}
    titles |= {"p": "p", "ahead": f"ahead, of {starts}"}
    cells = [list(line.values()) for line in lines]
    run.table("Joint design over its rivals", list(titles.values()), cells)
    logs = {f"{WAYS[way]} over {rival}": of for (way, rival), of in found.items()}
    run.figure(
        bars(logs, "error over the rival's", log=True, level=1.0),
        "all",
        "Error over that of each rival, over all robots (95 % of resampled starts and worlds).",
    )
    said = " ".join(
        f"{name.capitalize()} leaves {found[way, ORDER]:.2f} of the error of the best order that was raced: "
        f"it {outcomes[way, ORDER]}."
        for way, name in WAYS.items()
    )
    few = " So few starts decide nothing." if starts < ENOUGH * len(robots) else ""
    where = ", ".join(robot for robot, *_ in robots)
    run.finish("Joint design, all robots", f"Over {starts} starts ({where}): {said}{few}")


def read(path: Path) -> tuple[str, list[Row], str]:
    """The robot that answers are of, the rows of the arms that were raced from every start, and
    the best order among them.

    Raises: FileFormatError for what is no such table; DomainError where those are too few arms.
    """
    setting, rows = answers(path)
    starts = len({row["seed"] for row in rows})
    whole = [row for row in rows if len(select(rows, arm=row["arm"])) == starts]
    best = best_order(whole)
    if not {*WAYS} <= set(column(whole, "arm")) or ">" not in best:
        raise DomainError(
            f"'{path}' has not raced {', '.join(WAYS)} and an order of single blocks from all of its {starts} starts."
        )
    return str(setting["pair"]), whole, best


if __name__ == "__main__":
    sys.exit(main(study, Config))
