"""Where to mount the camera on a robot: gradient steps in the six numbers of its pose, beside
random search, CMA-ES and TPE at equal renders; with --look only the robot, what its camera sees,
and what it is blind to.

A robot drives through its worlds and reads its velocity off event flow (scenes/robots/pair.py, or a
robot of your own: --robot). The gradient is that of the error to be expected: from the covariance
that the flow's estimator claims, flow beyond its reach, wrong depths, and what the robot covers of
the picture. All searches begin at the same mounts, render as many samples, and are judged by single
events of the hard sensor in worlds and drives that none of them saw.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.fidelity import Task
from codesign.fidelity.levels import camera_at
from codesign.render import Camera
from scenes.robots import pair as robot_pair
from scenes.robots.check import check_pair
from scenes.robots.own import own_pair
from scenes.robots.pairs import PAIRS
from studies.frame.config import check_least, check_unused
from studies.frame.fidelity import Tolerant, chosen
from studies.frame.run import Run, main
from studies.placement.look import look, size_in_words
from studies.placement.outcome import Outcome
from studies.placement.problem import DRIVES, Problem, check_drives, traced_camera
from studies.placement.race import Race, feasible
from studies.placement.searches import SEARCHES, available

SPREAD = 12  # worlds of a step at most
HIGHEST_SEED = 1_000_000  # every start has a thousand of its own, and generators take 32 bits


@dataclass(frozen=True)
class Config(Tolerant):
    QUICK: ClassVar = {
        "seeds": 1,
        "steps": 6,
        "worlds": 4,
        "judged_worlds": 2,
        "judged_drives": 6,
        "searches": ("random", "TPE"),
    }
    pair: str = "outdoors"
    """Robot and world: outdoors, corridor or flight."""
    robot: Path | None = None
    """A robot of your own instead, described in a .yaml file (docs/robots_and_worlds.md)."""
    lens: str | None = None
    """A traced lens in place of the pair's thin one: a name in the catalogue or a lens file."""
    focal_mm: float | None = None
    """Focal length that the traced lens is scaled to; the pair's own when left out."""
    seeds: int = 3
    """Starting mounts, paired over all searches; the first is your own robot's own."""
    steps: int = 24
    """Steps of the gradient; other searches look at as many mounts as render as many samples."""
    worlds: int = 12
    """Training worlds."""
    per_world: int = 2
    """Drives in each of the worlds of a step, twelve of them at most."""
    searches: tuple[str, ...] = tuple(SEARCHES)
    """Searches beside the gradient."""
    judged_worlds: int = 12
    """Unseen worlds."""
    judged_drives: int = 8
    """Drives in each."""
    look: bool = False
    """Search nothing: draw the robot with its camera's view, and say what its mount keeps, sees and
    is blind to."""


# options of a search
SEARCHED = (
    *("seeds", "steps", "worlds", "per_world", "searches"),
    *("judged_worlds", "judged_drives", "tolerance"),
)


def study(run: Run[Config]) -> None:
    size = run.config
    checked(size)
    available(size.searches)
    pair = own_pair(size.robot) if size.robot else PAIRS[size.pair]()
    if size.robot:
        run.say(size_in_words(pair))
    camera = (
        traced_camera(pair, size.lens, size.focal_mm) if size.lens else pair.camera(pair.design)
    )
    if size.look:
        look(run, pair, camera)
        return
    check_pair(pair, camera, (0, robot_pair.UNSEEN_FROM) if size.robot else (0,))
    spread = min(SPREAD, size.worlds)
    problem = Problem(pair, robot_pair.training(size.worlds), spread, size.per_world, camera=camera)
    judged_in = robot_pair.unseen(size.judged_worlds)
    unseen = Problem(pair, judged_in, size.judged_worlds, size.judged_drives, camera=camera)
    race = Race(run, problem)
    starts = feasible(problem, size.seeds, size.seed, [problem.start] if size.robot else [])
    if size.tolerance:
        problem.camera = cheapest(run, problem, starts)
    for number, start in enumerate(starts):
        race.descent(number, start)
        for name in size.searches:
            race.search(number, name, start)
    from studies.placement.page import report

    report(run, Outcome(race, unseen, race.judge(unseen, starts)))


def cheapest(run: Run[Config], problem: Problem, starts: Sequence[Tensor]) -> Camera:
    """The camera that --tolerance allows the searches, chosen on drives of a training world from
    their first mounts; answers are judged by, and handed over with, the camera of the options."""
    samples = problem.draw(0)
    pair, number = problem.pair, samples.numbers[0]
    driven = pair.drive(number, DRIVES)[0][list(samples.which)]
    poses = torch.cat([driven @ problem.ranges.pose(start) for start in starts])
    task = Task(
        problem.camera, robot_pair.SENSOR, poses, robot_pair.times(), robot_pair.closed_form
    )
    found = chosen(run, pair.world(number), task, "memory", robot_pair.BINS, "the searches")
    return camera_at(problem.camera, found)


def checked(size: Config) -> None:
    if size.robot is None and size.pair not in PAIRS:
        raise DomainError(
            f"--pair {size.pair}: choose from {', '.join(PAIRS)}, or give --robot and a .yaml file."
        )
    if size.robot and size.pair != Config.pair:
        raise DomainError("--robot and --pair are both given; leave one of them out.")
    check_least(size, 1, "seeds", "steps", "worlds", "per_world", "judged_worlds", "judged_drives")
    check_drives(per_world=size.per_world, judged_drives=size.judged_drives)
    if len(set(size.searches)) < len(size.searches):
        raise DomainError(f"--searches {' '.join(size.searches)} names one twice; name each once.")
    if not 0 <= size.seed <= HIGHEST_SEED:
        raise DomainError(f"--seed is {size.seed}; the searches need 0 to {HIGHEST_SEED}.")
    if size.lens is None:
        check_unused(size, "without --lens", "focal_mm")
    if size.look:
        check_unused(size, "with --look", *SEARCHED)


if __name__ == "__main__":
    sys.exit(main(study, Config))
