"""The race in many settings at once: light, speed, what is held and what is designed."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Any, ClassVar

import torch

from codesign.errors import DomainError
from scenes.robots.pairs import PAIRS
from studies.codesign import couplings
from studies.codesign.design import Space
from studies.codesign.race import Judge, check_sizes, racing, space_of, training
from studies.frame.config import check_least
from studies.frame.run import Run, StudyConfig
from studies.frame.sweep import Row, select, sweep


@dataclass(frozen=True)
class CellsConfig(StudyConfig):
    """Sizes of a race, of one setting or of many."""

    QUICK: ClassVar = {
        "seeds": 1,
        "worlds": 2,
        "per_draw": 2,
        "judged_worlds": 2,
        "settling": 6,
    }
    ANEW: ClassVar = ("processes", "cluster")
    pair: str = "outdoors"
    """Robot and worlds: outdoors, corridor or flight."""
    seeds: int = 6
    """Paired starting designs of every setting."""
    steps: int = 16
    """Steps of every descent: the budget."""
    worlds: int = 12
    """Training worlds."""
    per_draw: int = 12
    """Drives rendered in a step."""
    judged_worlds: int = 24
    """Unseen worlds."""
    judged_drives: int = 2
    """Drives in each."""
    settling: int = 24
    """Designs of sensor and estimator tried on recorded frames, wherever they are settled."""
    processes: int = 0
    """Races side by side, each in a process of its own; 0: one after the other in this one."""
    cluster: str = ""
    """Address of a Ray cluster on whose cores they run instead: "auto" for that of this machine,
    "here" for one of its own."""


def setting(
    config: CellsConfig,
    light: float = 1.0,
    speed: float = 1.0,
    held: Mapping[str, float] = MappingProxyType({}),
    free: Sequence[str] = (),
) -> dict[str, Any]:
    """A cell, as ``race.racing`` takes it, with the calibration of the race outdoors.

    Raises: DomainError for a pair that is unknown, sizes below 1, and what ``Space`` refuses.
    """
    if config.pair not in PAIRS:
        raise DomainError(f"--pair {config.pair}: choose from {', '.join(PAIRS)}.")
    check_least(config, 1, "seeds")
    check_sizes(config)
    told = {
        "pair": config.pair,
        "family": "retrofocus-4",
        "light": light,
        "speed": speed,
        "free": list(free),
        "held": dict(held),
    }
    space_of(told)
    sizes = ("worlds", "per_draw", "steps", "settling")
    return {**told, "calibration": [], **{name: getattr(config, name) for name in sizes}}


def answers(
    run: Run[Any], cells: Mapping[str, Mapping[str, Any]], arms: Sequence[str]
) -> list[Row]:
    """Rows of every cell, start and arm: the answer, and its errors in unseen worlds
    (``race.Judge``)."""
    size = run.config
    seeds = range(size.seed, size.seed + size.seeds)
    beside = {"processes": size.processes, "cluster": size.cluster}
    given = {"arms": list(arms), "threads": 1 if any(beside.values()) else 0}
    raced = sweep(run, _raced, "race", given=given, **beside, regime=cells, seed=seeds)
    found = {(row["regime"], row["seed"], row["arm"]): row for row in raced}

    def judged(regime, seed, arm):
        row = found[regime, seed, arm]
        told = {name: value for name, value in row.items() if name not in ("regime", "seed", "arm")}
        return {**told, **judged_errors(size, cells[regime], row["share"])}

    return sweep(run, judged, "answers", regime=list(cells), seed=seeds, arm=list(arms))


def _raced(regime, seed, arms, threads):
    """Rows of all arms of a cell from one start, in a process that may know nothing yet."""
    rows = [{"arm": arm, **racing(seed, arm, regime, threads)} for arm in arms]
    return [{name: value for name, value in row.items() if name != "setting"} for row in rows]


def pulls_of(
    run: Run[Any], cells: Mapping[str, Mapping[str, Any]], rows: Sequence[Row], draws: int
) -> list[Row]:
    """Second differences around the best joint answer of every cell (``couplings.curvatures``),
    with the shares that they are around."""
    size = run.config
    of = {}
    for cell, given in cells.items():
        shares = [row["share"] for row in select(rows, regime=cell, arm="joint")]
        of[cell] = {"setting": given, "shares": shares}
    beside = {"processes": size.processes, "cluster": size.cluster}
    return sweep(run, _pulled, "couplings", **beside, regime=of, draw=range(draws))


def _pulled(regime, draw):
    drawn = training(regime["setting"])
    best = couplings.best_of(drawn, [{"share": share} for share in regime["shares"]])
    at = couplings.share(best).clamp(couplings.STEP, 1 - couplings.STEP)
    return [{**row, "at": at.tolist()} for row in couplings.curvatures(drawn, at, draw)]


def judged_errors(
    config: CellsConfig, cell: Mapping[str, Any], share: Sequence[float]
) -> dict[str, list[float]]:
    """What the judge says of shares of a cell (``race.Judge``)."""
    of_worlds = {name: cell[name] for name in ("pair", "family", "light", "speed")}
    judge = _judge(json.dumps(of_worlds), config.judged_worlds, config.judged_drives)
    return judge.of(space_of(cell).made(torch.tensor(share, dtype=torch.float64)))


@lru_cache(maxsize=1)
def _judge(told, worlds, drives):
    return Judge(Space.of(**json.loads(told)), worlds, drives)
