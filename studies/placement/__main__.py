"""Where to mount the camera on a robot: gradient steps in the six numbers of its pose, beside random and coordinate search,
CMA-ES and TPE at equal renders.

A robot drives through its worlds and reads its velocity off event flow (scenes/robot_pair.py, or a robot of your own:
--robot). The gradient is that of the error to be expected: from the covariance that the flow's estimator claims, flow
beyond its reach, wrong depths, and what the robot covers of the picture. All searches begin at the same mounts, render as
many samples, and are judged by single events of the hard sensor in worlds and drives that none of them saw.
"""

import csv
import io
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from codesign import grad, place, task
from codesign.atomic import write_atomic
from codesign.errors import DomainError
from codesign.place.ranges import NAMES
from codesign.report.mount_sphere import mount_sphere
from codesign.system import HandOver, load_hand_over, save_hand_over
from scenes import robot_pair
from scenes.robot_check import check_pair
from scenes.robot_own import own_pair
from scenes.robot_pairs import PAIRS
from studies.frame.run import Run, StudyConfig, main
from studies.placement import figures
from studies.placement.controls import cheat, controls
from studies.placement.descent import descend
from studies.placement.problem import DRIVES, Problem, traced_camera
from studies.placement.resumption import asked, check_same
from studies.placement.searches import SEARCHES, Trail, available, refined_grid

GRADIENT = "gradient"
GRID = "grid"
STEP = 0.12  # of the cube, of the differences that judge the gradient
AGREES = {"relative_l2": 1.0, "cosine": 0.8}  # steps have a set length: what counts is where they lead
UNKNOWN = 1 / 3  # standard error of differences from which on they judge nothing
TRIES = 2048
RESAMPLED = 4000
INTERVAL = 0.9
GROUPS = {"position": slice(0, 3), "attitude": slice(3, 6)}


@dataclass(frozen=True)
class Config(StudyConfig):
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
    """Starting mounts, paired over all searches."""
    steps: int = 32
    """Steps of the gradient; other searches look at as many mounts as render as many samples."""
    worlds: int = 12
    """Training worlds."""
    per_world: int = 2
    """Drives in each of the worlds of a step, twelve of them at most."""
    searches: tuple[str, ...] = tuple(SEARCHES)
    """Searches beside the gradient."""
    rivals_expect: bool = False
    """Searches beside the gradient minimise what it descends, instead of errors with hard counts."""
    grid: int = 0
    """Mounts of a quasi-random grid that is refined twice, 0 for none."""
    judged_worlds: int = 12
    """Unseen worlds."""
    judged_drives: int = 12
    """Drives in each."""
    certified: int = 0
    """Draws in which the gradient is compared with differences before it is used, 0 for none."""


SPREAD = 12


def study(run: Run[Config]) -> None:
    size = run.config
    checked(size)
    available(size.searches)
    if run.device.type != "cpu":
        run.say("This study computes on the CPU; the device asked for stays unused.")
    pair = own_pair(size.robot) if size.robot else PAIRS[size.pair]()
    camera = traced_camera(pair, size.lens, size.focal_mm) if size.lens else pair.design.camera()
    check_pair(pair, camera)
    spread = min(SPREAD, size.worlds)
    problem = Problem(pair, robot_pair.training(size.worlds), spread, size.per_world, camera=camera)
    judged_in = robot_pair.unseen(size.judged_worlds)
    unseen = Problem(pair, judged_in, size.judged_worlds, size.judged_drives, camera=camera)
    race = Race(run, problem)
    starts = feasible(problem, size.seeds, size.seed)
    ways = certified(run, race, starts[0])
    for number, start in enumerate(starts):
        race.descent(number, start, ways)
        for name in size.searches:
            race.search(number, name, start)
    if size.grid:
        race.search(0, GRID, problem.start)
    judged = judge(run, race, unseen, starts)
    report(run, race, unseen, starts, judged, ways)


def checked(size: Config) -> None:
    """Raise DomainError for sizes that cannot be."""
    if size.robot is None and size.pair not in PAIRS:
        raise DomainError(
            f"--pair {size.pair}: choose from {', '.join(PAIRS)}, or give --robot and a .yaml file."
        )
    for name in ("seeds", "steps", "worlds", "per_world", "judged_worlds", "judged_drives"):
        if getattr(size, name) < 1:
            raise DomainError(f"--{name.replace('_', '-')} is {getattr(size, name)}; at least 1 is needed.")
    for name in ("per_world", "judged_drives"):
        if getattr(size, name) > DRIVES:
            raise DomainError(
                f"--{name.replace('_', '-')} is {getattr(size, name)}; a world has {DRIVES} drives."
            )
    if size.seed < 0:
        raise DomainError(f"--seed is {size.seed}; the searches need 0 or more.")
    if size.focal_mm is not None and size.lens is None:
        raise DomainError("--focal-mm scales a traced lens; give --lens too, or leave it out.")
    if size.grid < 0 or size.certified < 0 or size.certified == 1:
        raise DomainError("--grid needs 0 or more mounts, --certified 0 or at least 2 draws.")


def feasible(problem: Problem, count: int, seed: int) -> list[Tensor]:
    """Mounts [6] spread at random over what is allowed."""
    if bool(problem.ranges.held.all()):
        raise DomainError("equal bounds hold all six numbers of the mount; widen what is to be searched.")
    random = torch.Generator().manual_seed(seed)
    found: list[Tensor] = []
    for _ in range(TRIES):
        share = 0.05 + 0.9 * torch.rand(6, generator=random, dtype=torch.float64)
        if kept(problem, share):
            found.append(share)
            if len(found) == count:
                return found
    raise DomainError(
        f"of {TRIES} mounts within the bounds {len(found)} keep what is required, {count} are needed; widen the bounds, or "
        "ask for less."
    )


def kept(problem: Problem, share: Tensor) -> bool:
    """Whether a mount keeps every requirement, by the hard answer; the cheap ones are asked first."""
    mount = problem.ranges.pose(share)
    with torch.no_grad():
        return all(float(each.exact(mount, problem.camera).min()) >= 0 for each in problem.requirements)


class Race:
    """Finished searches, kept in the run's state: a resumed run makes only those that are missing."""

    def __init__(self, run: Run[Config], problem: Problem):
        self.run = run
        self.problem = problem
        self.asked = asked(run.config, problem.pair)
        stored = run.load_state()
        self.tensors: dict[str, Tensor] = dict(stored.tensors) if stored else {}
        if stored:
            check_same(stored.numbers, self.asked)

    def save(self) -> None:
        """Keep what has been found."""
        self.run.save_state(self.tensors, self.asked)

    def trail(self, number: int, name: str) -> Trail:
        """What a search looked at."""
        return Trail(*(self.tensors[f"{name}/{number}/{part}"] for part in ("share", "error")))

    def samples(self, number: int, name: str) -> int:
        """Drives that a search rendered."""
        return int(self.tensors[f"{name}/{number}/samples"])

    def descent(self, number: int, start: Tensor, ways: dict[str, grad.Choice]) -> None:
        """Gradient steps, every group of numbers by the way chosen for it."""
        problem, first = self.problem, 1000 * (self.run.config.seed + number)
        problem.trend = task.PrecisionTrend()

        def slope(share, step):
            values = []

            def loss(parts, draw):
                value = objective(problem, parts, draw, learn=True)
                values.append(float(value.detach()))
                return value

            found = grad.gradient(loss, split(share), ways, first + step, scales=scales())
            return values[0], torch.cat([found[name] for name in GROUPS])

        steps = self.run.config.steps
        self._made(number, GRADIENT, steps, lambda advance: descend(slope, start, steps, advance))

    def search(self, number: int, name: str, start: Tensor) -> None:
        """A search without gradients at as many samples as the descent rendered, all on the same ones."""
        size = self.run.config
        samples = self.problem.draw(1000 * (size.seed + number))

        def error(share):
            if size.rivals_expect:
                with torch.no_grad():
                    mount = self.problem.ranges.pose(share)
                    expected = self.problem.expected(mount, samples).mean()
                    return float(expected + self.problem.penalty(mount))
            return self.problem.error(share, samples)

        if name == GRID:
            total = size.grid + 2 * max(1, size.grid // 5)
            self._made(
                number, name, total, lambda advance: refined_grid(error, 6, size.grid, 2, size.seed, advance)
            )
            return
        count = max(2, self.samples(number, GRADIENT) // self.problem.samples)
        seed = size.seed + number
        free = ~self.problem.ranges.held

        def whole(part):
            return start.expand(*part.shape[:-1], 6).masked_scatter(free.expand(*part.shape[:-1], 6), part)

        def make(advance):
            trail = SEARCHES[name](lambda part: error(whole(part)), start[free], count, seed, advance)
            return Trail(whole(trail.share), trail.error)

        self._made(number, name, count, make)

    def _made(self, number: int, name: str, total: int, make: Callable[..., Trail]) -> None:
        key = f"{name}/{number}"
        if f"{key}/error" in self.tensors:
            return
        before = self.problem.rendered
        with self.run.progress(total, f"{name}, start {number + 1}") as bar:
            trail = make(lambda error: bar.advance(error=error))
        self.tensors |= {
            f"{key}/share": trail.share,
            f"{key}/error": trail.error,
            f"{key}/samples": torch.tensor(self.problem.rendered - before),
        }
        self.save()

    def answer(self, number: int, name: str) -> Tensor:
        """The mount [6] that a search ends with: the descent's mean of its end; of the others the best of those that keep
        what is required."""
        trail = self.trail(number, name)
        if name == GRADIENT:
            order = range(len(trail.error) - 1, -1, -1)
        else:
            order = trail.error.argsort().tolist()
        for index in order:
            if kept(self.problem, trail.share[index]):
                return trail.share[index]
        return trail.share[0]


def split(share: Tensor) -> dict[str, Tensor]:
    """Position and attitude."""
    return {name: share[part] for name, part in GROUPS.items()}


def scales() -> dict[str, float]:
    """Steps of differences."""
    return dict.fromkeys(GROUPS, STEP)


def pose_of(problem: Problem, parts: dict[str, Tensor]) -> Tensor:
    """T_body_cam [4, 4]."""
    return problem.ranges.pose(torch.cat([parts[name] for name in GROUPS]))


def expected(problem: Problem, parts: dict[str, Tensor], draw: int, learn: bool = False) -> Tensor:
    """The mean error to be expected."""
    return problem.expected(pose_of(problem, parts), problem.draw(draw), learn).mean()


def objective(problem: Problem, parts: dict[str, Tensor], draw: int, learn: bool = False) -> Tensor:
    """The same and the penalty of what is required, whose gradient is exact."""
    return expected(problem, parts, draw, learn) + problem.penalty(pose_of(problem, parts))


def certified(run: Run[Config], race: Race, start: Tensor) -> dict[str, grad.Choice]:
    """The way to the gradient of position and attitude: autograd where it agrees with averaged differences of what is
    expected, or these are too noisy to tell."""
    draws = run.config.certified
    if not draws:
        return {name: grad.Choice("autograd", math.nan, math.nan, math.nan, 0) for name in GROUPS}
    if "ways" not in race.tensors:
        problem = race.problem
        problem.trend = task.PrecisionTrend()
        for draw in range(draws):
            expected(problem, split(start), draw, learn=True)
        run.say(f"comparing the gradient with differences in {draws} draws of {problem.samples} samples")
        found = grad.choose(
            lambda parts, draw: expected(problem, parts, draw),
            split(start),
            range(draws),
            scales=scales(),
            **AGREES,
        )
        rows = [
            [("autograd", "differences", "evolution").index(c.way), c.relative_l2, c.cosine, c.noise, c.calls]
            for c in (found[name] for name in GROUPS)
        ]
        race.tensors["ways"] = torch.tensor(rows, dtype=torch.float64)
        race.save()
    ways = {}
    for name, row in zip(GROUPS, race.tensors["ways"].tolist(), strict=True):
        way = ("autograd", "differences", "evolution")[int(row[0])]
        said = grad.Choice(way, row[1], row[2], row[3], int(row[4]))
        ways[name] = said if said.noise < UNKNOWN else replace(said, way="autograd", calls=0)
        run.say(f"{name}: {ways[name]}")
    return ways


def judge(
    run: Run[Config], race: Race, unseen: Problem, starts: list[Tensor]
) -> dict[tuple[int, str], Tensor]:
    """Bounded errors [N] of starts and answers, on the same unseen samples with single events. Key: (start, search); the
    pair's own design is (0, "default"), the starts (number, "start")."""
    samples = unseen.draw(0)
    wanted = {(0, "default"): unseen.start}
    for number, start in enumerate(starts):
        wanted[number, "start"] = start
        for name in (GRADIENT, *run.config.searches):
            wanted[number, name] = race.answer(number, name)
    if run.config.grid:
        wanted[0, GRID] = race.answer(0, GRID)
    found = {}
    with run.progress(len(wanted), "judging with single events") as bar:
        for (number, name), share in wanted.items():
            key = f"judged/{name}/{number}"
            if key not in race.tensors:
                race.tensors[key] = unseen.judged(unseen.ranges.pose(share), samples, "sensor").bounded()
                race.save()
            found[number, name] = race.tensors[key]
            bar.advance(error=float(found[number, name].mean()))
    return found


def chosen(race: Race, count: int) -> int:
    """Number of the descent whose answer does best on other training samples, one draw in every world: what is judged on
    unseen ones has not been chosen by them."""
    if "chosen" not in race.tensors:
        problem = race.problem
        draws = [problem.draw(-1 - k) for k in range(max(1, len(problem.numbers) // problem.spread))]
        answers = [race.answer(number, GRADIENT) for number in range(count)]
        errors = [sum(problem.error(share, draw) for draw in draws) for share in answers]
        race.tensors["chosen"] = torch.tensor(errors).argmin()
        race.save()
    return int(race.tensors["chosen"])


@dataclass(frozen=True)
class Paired:
    """Ratio of errors, ours over theirs, over paired starts: median and interval of resampled starts; how many below 1."""

    median: float
    low: float
    high: float
    ahead: int
    count: int

    def __str__(self):
        if self.count == 1:
            return f"{self.median:.2f}, one start"
        return f"{self.median:.2f} ({self.low:.2f} to {self.high:.2f}), ahead {self.ahead} of {self.count}"


def paired(ours: Tensor, theirs: Tensor) -> Paired:
    """Of errors [seeds] each."""
    ratio = ours / theirs
    drawn = torch.randint(len(ratio), (RESAMPLED, len(ratio)), generator=torch.Generator().manual_seed(0))
    ends = torch.tensor([(1 - INTERVAL) / 2, (1 + INTERVAL) / 2], dtype=ratio.dtype)
    low, high = torch.quantile(ratio[drawn].quantile(0.5, 1), ends).tolist()
    return Paired(float(ratio.quantile(0.5)), low, high, int((ratio < 1).sum()), len(ratio))


def report(
    run: Run[Config],
    race: Race,
    unseen: Problem,
    starts: list[Tensor],
    judged: dict[tuple[int, str], Tensor],
    ways: dict[str, grad.Choice],
) -> None:
    """Metrics, raw table, hand-over and page."""
    size = run.config
    problem = race.problem
    names = [GRADIENT, *size.searches]
    errors = {
        name: torch.stack([judged[k, name].mean() for k in range(len(starts))]) for name in ["start", *names]
    }
    default = float(judged[0, "default"].mean())
    best = chosen(race, len(starts))
    share = race.answer(best, GRADIENT)
    mount = problem.ranges.pose(share)
    rivals = {name: paired(errors[GRADIENT], errors[name]) for name in size.searches}
    write_table(run, race, judged)
    run.record(
        default_error=default,
        samples_per_search=race.samples(0, GRADIENT),
        samples_judged=unseen.samples,
        chosen_start=best,
        seeds=len(starts),
        seconds=run.seconds,
        **{f"{label(name)}_median_error": values.quantile(0.5) for name, values in errors.items()},
    )
    for name, found in rivals.items():
        run.record(
            **{
                f"over_{label(name)}_median": found.median,
                f"over_{label(name)}_low90": found.low,
                f"over_{label(name)}_high90": found.high,
                f"over_{label(name)}_ahead": found.ahead,
            }
        )
    for name, way in ways.items():
        if size.certified:
            run.record(
                **{
                    f"gradient_{name}_relative_l2": way.relative_l2,
                    f"gradient_{name}_cosine": way.cosine,
                    f"gradient_{name}_differences_noise": way.noise,
                    f"gradient_{name}_calls": way.calls,
                }
            )
    better = float(errors[GRADIENT][best]) < default
    said = "belongs at" if better else "is no better off than at its default mount at"
    answer = (
        f"The camera of '{problem.pair.name}' {said} {place_in_words(problem, share)}: mean error "
        f"{float(errors[GRADIENT][best]):.3f} on {unseen.samples} unseen samples with single events, "
        f"{default:.3f} at its default mount."
    )
    run.card(
        "error of the mount found", f"{float(errors[GRADIENT][best]):.3f}", f"default mount: {default:.3f}"
    )
    for name, found in rivals.items():
        run.card(
            f"gradient over {name}", f"{found.median:.2f}", f"ahead {found.ahead} of {found.count} starts"
        )
    ranked(run, race, errors, rivals, judged)
    seen(run, problem, unseen, mount, share)
    handed(run, problem, unseen, mount, judged[best, GRADIENT])
    run.finish("Where to mount the camera", answer)


def label(name: str) -> str:
    """A name among metrics."""
    return name.lower().replace("-", "_").replace(" ", "_")


def place_in_words(problem: Problem, share: Tensor) -> str:
    """Position and attitude of a mount."""
    x, y, z, yaw, pitch, roll = problem.ranges.numbers(share).tolist()
    turned = ", ".join(
        f"{name} {math.degrees(angle):+.0f}°"
        for name, angle in (("yaw", yaw), ("pitch", pitch), ("roll", roll))
    )
    return f"({x:.2f}, {y:.2f}, {z:.2f}) m, {turned}"


def write_table(run: Run[Config], race: Race, judged: dict[tuple[int, str], Tensor]) -> None:
    """race.csv: every answer with its mount, what it rendered and its error."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = list(NAMES)
    writer.writerow(["pair", "seed", "search", *names, "samples", "error", "standard_error"])
    for (number, name), errors in sorted(judged.items()):
        if name in ("default", "start"):
            share = race.problem.start if name == "default" else race.trail(number, GRADIENT).share[0]
            samples = 0
        else:
            share, samples = race.answer(number, name), race.samples(number, name)
        row = [f"{value:.5f}" for value in race.problem.ranges.numbers(share).tolist()]
        deviation = standard_error(errors, run.config.judged_worlds)
        writer.writerow(
            [
                race.problem.pair.name,
                run.config.seed + number,
                name,
                *row,
                samples,
                f"{float(errors.mean()):.5f}",
                f"{deviation:.5f}",
            ]
        )
    write_atomic(run.path("race.csv"), text.getvalue().encode())


def standard_error(errors: Tensor, worlds: int) -> float:
    """Of the mean of errors [N], world after world: of the worlds' means, since drives in one world err alike; of one
    world's drives where there is one."""
    means = errors.unflatten(0, (worlds, -1)).mean(1) if worlds > 1 else errors
    return float(means.std() / math.sqrt(len(means))) if len(means) > 1 else 0.0


def ranked(
    run: Run[Config],
    race: Race,
    errors: dict[str, Tensor],
    rivals: dict[str, Paired],
    judged: dict[tuple[int, str], Tensor],
) -> None:
    """The searches beside one another."""
    run.section(
        "Searches at equal renders",
        f"Every search began at the same {len(errors['start'])} mounts and rendered {race.samples(0, GRADIENT)} samples; "
        "errors are means of q / (1 + q), q the squared error of the velocities that count in units of 0.05 m/s plus a "
        "tenth of the speed, and 0.15 rad/s, with single events in worlds and drives that no search saw (a world from a file is the same for all). In brackets: "
        f"{INTERVAL:.0%} of resampled starts.",
    )
    rows: list[list[Any]] = []
    for name, values in errors.items():
        over = str(rivals[name]) if name in rivals else None
        rows.append([name, float(values.quantile(0.5)), float(values.min()), float(values.max()), over])
    if (0, GRID) in judged:
        grid = float(judged[0, GRID].mean())
        within = int((errors[GRADIENT] <= 1.02 * grid).sum())
        share = race.samples(0, GRADIENT) / race.samples(0, GRID)
        rows.append([f"grid, {race.samples(0, GRID)} samples", grid, grid, grid, None])
        run.record(
            grid_error=grid, starts_within_2_percent_of_grid=within, renders_of_gradient_over_grid=share
        )
        run.text(
            f"{within} of {len(errors[GRADIENT])} descents end within 2 % of the best of the refined grid, with {share:.3f} "
            "of its renders."
        )
    rows.append(["default mount", float(judged[0, "default"].mean()), None, None, None])
    run.table("Errors on unseen samples", ("search", "median", "best", "worst", "gradient over it"), rows)
    trails = {
        name: [race.trail(number, name) for number in range(len(errors["start"]))]
        for name in errors
        if name != "start"
    }
    run.figure(
        figures.ways(race.problem, trails),
        "ways",
        "Left: what the searches saw of their own objective, best so far (the gradient's is the error to be expected, which "
        "is larger). Right: the mounts that the descents went through.",
    )


def seen(run: Run[Config], problem: Problem, unseen: Problem, mount: Tensor, share: Tensor) -> None:
    """The robot with its camera before and after, what it sees, what it is blind to, and controls."""
    size = run.config
    run.section("Before and after")
    run.figure(
        figures.before_and_after(unseen, mount),
        "before_and_after",
        "The robot with its default mount (above) and the one found (below): frame of an unseen drive with the windows read, "
        "events of the hard sensor in them, flow.",
    )
    verdicts = place.judge(problem.requirements, mount, problem.camera)
    run.text("Requirements: " + "; ".join(map(str, verdicts)) + ".")
    planar = problem.pair.axes
    depth = task.ground_depth
    x, y, z = problem.ranges.numbers(share)[:3].tolist()
    T_world_body = torch.eye(4, dtype=torch.float64)
    T_world_body[2, 3] = problem.pair.drive(0, 12)[0][:, robot_pair.FRAMES // 2, 2, 3].mean()
    around = task.Surroundings((x, y, z), T_world_body, axes=planar, depth=depth)
    height = z + float(T_world_body[2, 3])
    if height > 0.05:
        information, _ = around.information(problem.camera, mount)
        sight = place.sight(information, task.sight_units(around), planar)
        run.text(
            f"{height:.2f} m over flat ground the motion that shows least from there is {sight.weakest_named()} (in units of 0.1 m/s and 0.1 "
            f"rad/s, deviation {sight.weakest_deviation:.2f}); blind to: {', '.join(sight.blind()) or 'nothing'}."
        )
        yaw, pitch, errors = task.sight_map(problem.camera, around, rows=9, columns=18)
        now = place.yaw_pitch_roll_rad(mount).tolist()
        run.figure(
            mount_sphere(yaw, pitch, errors, "expected error, units", {"found": (now[0], now[1])}),
            "sight",
            "What the place allows: the error that flow over flat ground lets expect, over all directions the camera may look "
            "in (27 points of 5 px/s).",
        )
    samples = unseen.draw(0)
    found = controls(unseen, mount, samples)
    run.section(
        "Controls",
        "Single events in unseen worlds. Errors of an answer that is always zero, of a camera that sees nothing move, and of "
        "one that looks at its own robot should be alike.",
    )
    run.table(
        "What is left",
        ("control", "mean bounded error"),
        [[k.replace("_", " "), v] for k, v in found.items()],
    )
    run.record(**{f"control_{name}_error": value for name, value in found.items()})
    mounts = torch.stack(feasible(problem, 4 if size.seeds == 1 else 12, size.seed + 500))
    pairs = torch.tensor(
        cheat(problem, torch.cat([mounts, share[None]]), problem.draw(0)), dtype=torch.float64
    )
    least = int(pairs[:, 0].argmin())
    run.record(
        cheat_least_pixel_error_px=pairs[least, 0],
        cheat_error_of_that_mount=pairs[least, 1],
        cheat_best_error=pairs[:, 1].min(),
        cheat_pixel_error_of_answer_px=pairs[-1, 0],
    )
    cheats = least != int(pairs[:, 1].argmin())
    run.text(
        f"An objective in pixels {'would cheat' if cheats else 'chose well this time'}: of {len(pairs)} mounts the one with the least error of flow "
        f"({float(pairs[least, 0]):.2f} px) has a velocity error of {float(pairs[least, 1]):.3f}, the best has "
        f"{float(pairs[:, 1].min()):.3f}. Flow is smallest, and its errors with it, where everything is far away and says "
        "little of the way the robot goes."
    )


def handed(run: Run[Config], problem: Problem, unseen: Problem, pose: Tensor, errors: Tensor) -> None:
    """Write the mount, read it back, and see that it has the same score."""
    low, high = problem.ranges.low[:3], problem.ranges.high[:3]
    yaw, pitch, roll = place.yaw_pitch_roll_rad(pose).tolist()
    half = (high - low) / 2
    middle = (low + high) / 2
    inside = torch.where(half > 0, (pose[:3, 3] - middle).clamp(-0.999 * half, 0.999 * half), 0.0)
    mount = place.Mount(middle, half, yaw_rad=yaw, pitch_rad=pitch, roll_rad=roll, position_m=middle + inside)
    parent = "base_footprint" if len(problem.pair.axes) == 3 else "base_link"
    path = run.path("mount.yaml")
    notes = {
        "pair": problem.pair.name,
        "error_unseen": float(errors.mean()),
        "error_found": float(errors.mean()),
    }
    save_hand_over(
        path, HandOver(mount, problem.camera, robot_pair.SENSOR, parent, "camera_optical_frame", notes)
    )
    back = load_hand_over(path)
    again = unseen.judged(back.mount().detach(), unseen.draw(0), "sensor").bounded()
    run.record(hand_over_score_again=again.mean(), hand_over_score=errors.mean())
    run.section(
        "Hand-over",
        f"`mount.yaml` has the transform, lens, camera and sensor; read back it scores {float(again.mean()):.4f} where the "
        f"search's mount had {float(errors.mean()):.4f}.",
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
