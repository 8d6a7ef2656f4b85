"""The race of the arms: from the same starts at equal rendered drives, judged by single events in
worlds that none saw."""

import json
import math
import time
from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from codesign import backend, shipped
from codesign.errors import DomainError, FileFormatError
from codesign.mount import VelocityHead
from codesign.mount.requirements import first_missed
from scenes.robots import pair as robot_pair
from studies.codesign.arms import ARMS, Task, Way, read_out
from studies.codesign.calibration import Calibration
from studies.codesign.design import BLOCKS, Space, Whole
from studies.codesign.objective import Objective
from studies.codesign.problem import Drawn
from studies.frame import workers
from studies.frame.compare import Interval, crossed, holm, sign_flip
from studies.frame.config import check_least
from studies.frame.sweep import Row, column
from studies.placement.problem import DRIVES, check_drives

EDGE = 0.1  # of the cube, that starts keep from its walls
NEAR = 0.1  # of the cube, that near starts lie away at most
TRIES = 10_000
SPACE = ("pair", "family", "light", "speed", "free", "held")  # of a setting (``Space.of``)
PER_SEED = 10_000  # draws of one start
MOST_SEEDS = 500  # then come draws that measure slopes, and the judge's
MOST_WORLDS = 200  # from 500 on are those of the landscape
ENOUGH = 6  # starts, below which nothing is decided
JUDGED = 7_700_000  # number of the judge's draw


def space_of(setting: Mapping[str, Any]) -> Space:
    """Designs of a setting."""
    return Space.of(**{name: setting[name] for name in SPACE})


def start(space: Space, seed: int, near: Sequence[float] | None = None) -> Tensor:
    """Shares [V] at random, sensor and estimator as they are by default, that keep what is
    required; those of ``near`` [V], each moved by NEAR at most, where it is given. All numbers of
    a design are drawn, whichever are free: spaces that share some are asked to begin alike in them.

    Raises: DomainError where none of TRIES does.
    """
    generator = torch.Generator().manual_seed(1000 + seed)
    requirements = space.pair.requirements()
    held = space.part("read-out")
    names = [name for block in BLOCKS.values() for name in block]
    for _ in range(TRIES):
        every = torch.rand(len(names), generator=generator, dtype=torch.float64)
        drawn = every[[names.index(name) for name in space.free]]
        share = EDGE + (1 - 2 * EDGE) * drawn
        share[held] = space.start[held]
        if near is not None:
            share = (torch.tensor(near, dtype=torch.float64) + NEAR * (2 * drawn - 1)).clamp(0, 1)
        if kept(space, share, requirements):
            return share
    raise DomainError(
        f"none of {TRIES} designs of '{space.pair.name}' keeps what is required; widen the bounds."
    )


@backend.threads(most=1)
def kept(space: Space, share: Tensor, requirements: Sequence[Any]) -> bool:
    """Whether a design keeps what is required, by the hard answer."""
    whole = space.made(share)
    return first_missed(requirements, whole.T_body_cam, whole.camera) is None


def last_kept(drawn: Drawn, shares: Sequence[Tensor]) -> Tensor:
    """The last of some shares [V] that keeps what is required; the first, a start, does."""
    return next(share for share in reversed(shares) if kept(drawn.space, share, drawn.requirements))


def settled_and_kept(task: Task, answer: Tensor, way: Way) -> tuple[Tensor, bool]:
    """An answer [V], or the last lens and mount on its way that keep what is required (the start
    does), with sensor and estimator settled on the drives recorded last; whether it is the
    answer's."""
    drawn = task.objective.drawn
    settled = read_out(task, answer, way)
    if kept(task.space, settled, drawn.requirements):
        return settled, True
    if not way.shares:
        raise DomainError(
            "the pair's own design, as it is held, misses a requirement, so there is no default; leave its arm out."
        )
    return read_out(task, last_kept(drawn, [task.start, *way.shares]), way), False


def run_arm(
    drawn: Drawn,
    arm: str,
    seed: int,
    steps: int,
    settling: int,
    near: Sequence[float] | None = None,
) -> dict[str, Any]:
    """One arm from one start (``settled_and_kept``)."""
    begun, rendered = time.process_time(), drawn.rendered
    space = drawn.space
    task = Task(Objective(drawn), start(space, seed, near), steps, PER_SEED * seed, seed, settling)
    answer, way = ARMS[arm](task)
    chosen, keeps = settled_and_kept(task, answer, way)
    return {
        "share": chosen.tolist(),
        "kept": keeps,
        "expected": way.expected,
        "trail": [round(error, 5) for error in way.errors],
        "drives": drawn.rendered - rendered,
        "cpu_s": time.process_time() - begun,
        **{name: value for name, value in space.numbers(chosen).items() if name in space.free},
    }


def racing(seed: int, arm: str, setting: Mapping[str, Any], threads: int = 0) -> dict[str, Any]:
    """``run_arm`` in a process that may know nothing yet.

    setting: of the race, plain values. threads: that the process may use, beside others; 0: as it
      is.
    """
    workers.with_threads(threads)
    sizes = setting["steps"], setting["settling"], setting.get("near")
    found = run_arm(training(setting), arm, seed, *sizes)
    return {**found, "setting": dict(setting)}


def taken_up(path: Path, setting: Mapping[str, Any]) -> tuple[bytes, bytes]:
    """Lines of a table of answers (race.jsonl, answers.jsonl), all of them and those that the same
    judge has judged.

    Raises: FileFormatError for what is no such table; DomainError for answers of another setting.
    """
    lines = path.read_bytes().splitlines(keepends=True)
    judged = []
    for line in lines:
        rows = _parsed(path, line)
        for each in (row["setting"] for row in rows):
            other = [
                name
                for name in setting
                if name != "judge" and not _alike(each.get(name), setting[name])
            ]
            if other:
                raise DomainError(
                    f"'{path}' has answers of another setting: {other[0]} is {each.get(other[0])} there and {setting[other[0]]} here."
                )
        if all(
            "head_errors" in row and row["setting"].get("judge") == setting["judge"] for row in rows
        ):
            judged.append(line)
    return b"".join(lines), b"".join(judged)


def answers(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Setting and rows of a table of judged answers, each with its seed and arm. A path is looked
    for beside the studies too, where the published answers lie.

    Raises: FileFormatError for what is no such table.
    """
    if not path.is_file():
        path = shipped.FOLDER / path
    if not path.is_file():
        raise FileFormatError(f"no such file: '{path}'; give answers.jsonl of a run.")
    rows = [row for line in path.read_bytes().splitlines() for row in _parsed(path, line)]
    if not rows or not all("errors" in row for row in rows):
        raise FileFormatError(f"'{path}' has no judged answers; give answers.jsonl of a run.")
    setting = rows[0]["setting"]
    if not all(_alike(row["setting"][name], setting[name]) for row in rows for name in SPACE):
        raise FileFormatError(f"'{path}' has answers of several settings; give those of one run.")
    if len({(row["seed"], row["arm"]) for row in rows}) < len(rows):
        raise FileFormatError(f"'{path}' has an answer twice; give answers.jsonl of a run.")
    return setting, rows


def _parsed(path, line):
    """Rows of a line, with the seed and the arm that they are of."""
    try:
        axes, rows = json.loads(line)
        found = [{**axes, **row, "setting": dict(row["setting"])} for row in rows]
        for row in found:
            numbers = [*row["share"], *row.get("errors", ()), *row.get("head_errors", ())]
            whole = (
                len(row["share"]) == _count(json.dumps(row["setting"]))
                and {"seed", "arm"} <= row.keys()
            )
            if not whole or not all(0 <= number <= 1 for number in numbers):
                raise ValueError
        return found
    except (ValueError, TypeError, KeyError) as error:
        raise FileFormatError(
            f"'{path}' is no table of answers, or damaged; give answers.jsonl of a run."
        ) from error


@lru_cache(maxsize=1)
def _count(told):
    """How many numbers of a setting are free: built once for all rows of a table."""
    return len(space_of(json.loads(told)).free)


def _alike(one, other):
    """The same, numbers but for rounding on another machine."""
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        return all(_alike(*pair) for pair in zip(one, other, strict=True))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-6)
    return one == other


def training(setting: Mapping[str, Any]) -> Drawn:
    """Training worlds of a setting; built once in a process."""
    return _training(json.dumps(setting))


@lru_cache(maxsize=1)
def _training(told):
    setting = json.loads(told)
    space = space_of(setting)
    spread = spread_over(setting["worlds"], setting["per_draw"])
    calibration = Calibration(*setting["calibration"])
    return Drawn(space, robot_pair.training(setting["worlds"]), *spread, calibration)


def spread_over(worlds: int, drives: int) -> tuple[int, int]:
    """Worlds of a draw, and drives in each."""
    each = min(worlds, drives)
    return each, drives // each


def check_sizes(size: Any) -> None:
    """Raise DomainError for sizes of a configuration that no race can have."""
    if size.worlds > MOST_WORLDS:
        raise DomainError(
            f"--worlds is {size.worlds}; at most {MOST_WORLDS} (others are for calibration)."
        )
    if size.seed + size.seeds > MOST_SEEDS:
        raise DomainError(
            f"--seeds {size.seeds} from --seed {size.seed}: starts are below {MOST_SEEDS} in all; later draws judge."
        )
    check_least(
        size, 1, "steps", "worlds", "per_draw", "judged_worlds", "judged_drives", "settling"
    )
    if size.per_draw % min(size.worlds, size.per_draw):
        raise DomainError(
            f"--per-draw {size.per_draw} drives cannot be spread evenly over --worlds {size.worlds}; give a multiple."
        )
    spread, each = spread_over(size.worlds, size.per_draw)
    if each > DRIVES:
        raise DomainError(
            f"--per-draw {size.per_draw} over --worlds {spread} are {each} drives in each; a world has {DRIVES}."
        )
    check_drives(judged_drives=size.judged_drives)
    workers.check_cluster(size.cluster)


class Judge:
    """Single events in unseen worlds, the same drives for every design; nothing that searched has
    seen them."""

    def __init__(self, space: Space, worlds: int, per_world: int) -> None:
        self.drawn = Drawn(space, robot_pair.unseen(worlds), worlds, per_world)
        self.worlds = worlds

    def __call__(self, share: Sequence[float]) -> dict[str, list[float]]:
        """Of shares [V] the mean bounded errors in each world: ``errors`` of least squares, and
        ``head_errors`` of the delivered velocity head on the same flow."""
        return self.of(self.drawn.space.made(torch.tensor(share, dtype=torch.float64)))

    def of(self, whole: Whole) -> dict[str, list[float]]:
        """The same, of a design."""
        looked = self.drawn.looked(whole, self.drawn.draw(JUDGED), "sensor")
        return {name: self._by_world(looked.hard(head)) for name, head in self._heads.items()}

    @cached_property
    def _heads(self):
        return {"errors": None, "head_errors": VelocityHead.pretrained(self.drawn.estimate)}

    def _by_world(self, errors):
        return [
            round(error, 6) for error in errors.unflatten(0, (self.worlds, -1)).mean(1).tolist()
        ]


def paired(rows: Sequence[Row], ours: str, theirs: str, of: str = "errors") -> Tensor:
    """Logs [starts, worlds] of an arm's error over another's, from the same starts."""
    by_start = sorted(rows, key=lambda row: row["seed"])
    one, other = (
        torch.tensor(column(by_start, of, arm=arm), dtype=torch.float64) for arm in (ours, theirs)
    )
    return (one / other).log()


def compared(
    rows: Sequence[Row], ours: str = "joint", of: str = "errors"
) -> dict[str, tuple[Interval, float]]:
    """The log ratio of our error to each rival's over paired seeds and worlds, and its p after
    Holm."""
    rivals = dict.fromkeys(row["arm"] for row in rows if row["arm"] != ours)
    logs = {arm: paired(rows, ours, arm, of) for arm in rivals}
    adjusted = holm([sign_flip(each.mean(1)) for each in logs.values()])
    return {arm: (crossed(each), p) for (arm, each), p in zip(logs.items(), adjusted, strict=True)}
