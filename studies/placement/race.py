"""The searches for a mount from the same starts at equal renders, what each ends with, and its error in worlds that none
saw; all of it kept in the run's state."""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from codesign import grad
from codesign.errors import DomainError
from codesign.mount import PrecisionTrend
from studies.frame.run import Run
from studies.placement.descent import descend, settled
from studies.placement.grid import first_points, looks, refined_grid
from studies.placement.problem import Problem
from studies.placement.resumption import asked, check_same
from studies.placement.searches import SEARCHES, Trail

GRADIENT = "gradient"
GRID = "grid"
STEP = 0.12  # of the cube: of the gradient's differences of geometry, and of those that judge it
AGREES = {"relative_l2": 1.0, "cosine": 0.8}  # steps have a set length: what counts is where they lead
UNKNOWN = 1 / 3  # standard error of differences from which on they judge nothing
WAYS = ("autograd", "differences", "evolution")
TRIES = 2048
FINAL_DRAWS = 12  # that choose among answers, and of the grid's second look
KEPT_EVERY = 50  # looks
WORST = 1.0  # of bounded errors
GROUPS = {"position": slice(0, 3), "attitude": slice(3, 6)}


def feasible(problem: Problem, count: int, seed: int, first: Sequence[Tensor] = ()) -> list[Tensor]:
    """Mounts [6] to start from: those given, and others spread at random over what is allowed."""
    if bool(problem.ranges.held.all()):
        raise DomainError("equal bounds hold all six numbers of the mount; widen what is to be searched.")
    random = torch.Generator().manual_seed(seed)
    found = list(first)[:count]
    for _ in range(TRIES):
        if len(found) == count:
            break
        share = 0.05 + 0.9 * torch.rand(6, generator=random, dtype=torch.float64)
        if kept(problem, share):
            found.append(share)
    if len(found) < count:
        raise DomainError(
            f"of {TRIES} mounts within the bounds {len(found) - len(first)} keep what is required, {count - len(first)} are "
            "needed; widen the bounds, or ask for less."
        )
    return found


def check_grid(problem: Problem, count: int, seed: int) -> None:
    """Raise DomainError where a grid has no point that is allowed to begin with."""
    if count and not any(kept(problem, share) for share in first_points(6, count, seed)):
        raise DomainError(
            f"of {count} mounts of the grid none keeps what is required; give --grid more of them, or ask for less."
        )


def kept(problem: Problem, share: Tensor) -> bool:
    """Whether a mount keeps every requirement, by the hard answer; the cheap ones are asked first."""
    mount = problem.ranges.pose(share)
    with torch.no_grad():
        return all(float(each.exact(mount, problem.camera).min()) >= 0 for each in problem.requirements)


class Race:
    """Finished searches, kept in the run's state: a resumed run makes only those that are missing."""

    def __init__(self, run: Run[Any], problem: Problem):
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
        problem.trend = PrecisionTrend()

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
        """A search without gradients at as many samples as the descent rendered, all on the same ones unless it is asked
        for others. Of mounts that do not keep what is required nothing is rendered: they are told to be worse than any other."""
        size = self.run.config
        first = 1000 * (size.seed + number)
        steps = itertools.count()

        def error(share):
            draw = first + (next(steps) if size.rivals_fresh else 0)
            if size.rivals_expect:
                with torch.no_grad():
                    return float(objective(self.problem, split(share), draw))
            return self.problem.error(share, self.problem.draw(draw))

        count = max(2, self.samples(number, GRADIENT) // self.problem.samples)
        seed = size.seed + number
        free = ~self.problem.ranges.held

        def whole(part):
            return start.expand(*part.shape[:-1], 6).masked_scatter(free.expand(*part.shape[:-1], 6), part)

        def refused(part):
            share = whole(part)
            return None if kept(self.problem, share) else WORST + self.problem.penalty_of(share)

        def make(advance):
            look = SEARCHES[name]
            trail = look(lambda part: error(whole(part)), start[free], count, seed, advance, refused)
            return Trail(whole(trail.share), trail.error)

        self._made(number, name, count, make)

    def grid(self) -> None:
        """The refined grid: all its points with the draw of the first search, the best of each cube again with others. What is
        known of it is kept when it is interrupted, and every so often."""
        if f"{GRID}/0/final" in self.tensors:
            return
        problem, size = self.problem, self.run.config
        first = [problem.draw(1000 * size.seed)]
        other = [problem.draw(-1 - k) for k in range(FINAL_DRAWS)]
        known = self.tensors.get(f"{GRID}/0/known", torch.zeros(0, dtype=torch.float64)).tolist()
        replayed = iter(known[:])

        def keep():
            if f"{GRID}/0/final" not in self.tensors:
                self.tensors[f"{GRID}/0/known"] = torch.tensor(known, dtype=torch.float64)
                self.save()

        def look(share, again):
            error = next(replayed, None)
            if error is None:
                draws = other if again else first
                error = sum(problem.error(share, draw) for draw in draws) / len(draws)
                known.append(error)
                if len(known) % KEPT_EVERY == 0:
                    keep()
                bar.advance(error=error)
            return error

        self.run.on_interrupt(keep)
        with self.run.progress(looks(size.grid), GRID, done=len(known)) as bar:
            points, finals = refined_grid(
                look, 6, size.grid, seed=size.seed, allowed=lambda share: kept(problem, share)
            )
        self.tensors.pop(f"{GRID}/0/known", None)
        drives = problem.samples * (len(points.error) + FINAL_DRAWS * len(finals.error))
        self.tensors |= {
            f"{GRID}/0/share": points.share,
            f"{GRID}/0/error": points.error,
            f"{GRID}/0/final": finals.share[finals.best],
            f"{GRID}/0/samples": torch.tensor(drives),
        }
        self.save()

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

    def answer(self, number: int, name: str, part: float = 1.0) -> Tensor:
        """The mount [6] that a search ends with, or would end with after a part of its renders: the descent's mean of its end;
        the best of the grid's finalists; of the others the best of those that keep what is required."""
        if name == GRID:
            return self.tensors[f"{GRID}/0/final"]
        trail = self.trail(number, name)
        if part < 1:
            trail = shortened(trail, part, name == GRADIENT)
        if name == GRADIENT:
            order = range(len(trail.error) - 1, -1, -1)
        else:
            order = trail.error.argsort().tolist()
        for index in order:
            if kept(self.problem, trail.share[index]):
                return trail.share[index]
        return trail.share[0]


def shortened(trail: Trail, part: float, descended: bool) -> Trail:
    """What a search had after a part of its points. descended: the last is the mean of a way's end, and no point of its own."""
    count = max(1, round(part * (len(trail.error) - descended)))
    if not descended:
        return Trail(trail.share[:count], trail.error[:count])
    return Trail(settled(trail.share[: count + 1], count), trail.error[: count + 1])


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
    """The mean error to be expected; its gradient is that of ``Problem.expected_around``."""
    share, samples = torch.cat([parts[name] for name in GROUPS]), problem.draw(draw)
    if not share.requires_grad:
        return problem.expected(problem.ranges.pose(share), samples, learn).mean()
    value, slope = problem.expected_around(share.detach(), samples, STEP, learn)
    return value + slope @ (share - share.detach())


def objective(problem: Problem, parts: dict[str, Tensor], draw: int, learn: bool = False) -> Tensor:
    """The same and the penalty of what is required, whose gradient is exact."""
    return expected(problem, parts, draw, learn) + problem.penalty(pose_of(problem, parts))


def certified(run: Run[Any], race: Race, start: Tensor) -> dict[str, grad.Choice]:
    """The way to the gradient of position and attitude: that of ``expected`` ("autograd") where it agrees with averaged differences
    of rendered mounts, or these are too noisy to tell."""
    draws = run.config.certified
    if not draws:
        return {name: grad.Choice("autograd", math.nan, math.nan, math.nan, 0) for name in GROUPS}
    if "ways" not in race.tensors:
        problem = race.problem
        problem.trend = PrecisionTrend()
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
            [WAYS.index(c.way), c.relative_l2, c.cosine, c.noise, c.calls]
            for c in (found[name] for name in GROUPS)
        ]
        race.tensors["ways"] = torch.tensor(rows, dtype=torch.float64)
        race.save()
    ways = {}
    for name, row in zip(GROUPS, race.tensors["ways"].tolist(), strict=True):
        way = WAYS[int(row[0])]
        said = grad.Choice(way, row[1], row[2], row[3], int(row[4]))
        ways[name] = said if said.noise < UNKNOWN else replace(said, way="autograd", calls=0)
        run.say(f"{name}: {ways[name]}")
    return ways


def judge(run: Run[Any], race: Race, unseen: Problem, starts: list[Tensor]) -> dict[tuple[int, str], Tensor]:
    """Bounded errors [N] of starts and answers, on the same unseen samples with single events. Key: (start, search); the
    pair's own design is (0, "default"), the starts (number, "start")."""
    wanted = {(0, "default"): unseen.start}
    for number, start in enumerate(starts):
        wanted[number, "start"] = start
        for name in (GRADIENT, *run.config.searches):
            wanted[number, name] = race.answer(number, name)
    if run.config.grid:
        wanted[0, GRID] = race.answer(0, GRID)
    named = {f"judged/{name}/{number}": share for (number, name), share in wanted.items()}
    found = _judged(run, race, unseen, named, "judging with single events")
    return dict(zip(wanted, found, strict=True))


def judge_along(
    run: Run[Any], race: Race, unseen: Problem, judged: dict[tuple[int, str], Tensor], count: int
) -> dict[str, Tensor]:
    """Mean errors [starts, parts + 1] of each search from its start to its end, on the samples of ``judge``."""
    parts = run.config.along
    names = [GRADIENT, *run.config.searches]
    wanted = {
        f"judged/{name}/{number}/{part}/{parts}": race.answer(number, name, part / parts)
        for name in names
        for number in range(count)
        for part in range(1, parts)
    }
    between = dict(zip(wanted, _judged(run, race, unseen, wanted, "judging on the way"), strict=True))
    found = {}
    for name in names:
        ways = []
        for number in range(count):
            errors = [between[f"judged/{name}/{number}/{part}/{parts}"] for part in range(1, parts)]
            ways.append(torch.stack([judged[number, "start"], *errors, judged[number, name]]).mean(1))
        found[name] = torch.stack(ways)
    return found


def _judged(run, race, unseen, wanted, said):
    """Errors [N] of every mount, kept by their keys."""
    samples = unseen.draw(0)
    found: list[Tensor] = []
    if not wanted:
        return found
    with run.progress(len(wanted), said) as bar:
        for key, share in wanted.items():
            if key not in race.tensors:
                race.tensors[key] = unseen.judged(unseen.ranges.pose(share), samples, "sensor").bounded()
                race.save()
            found.append(race.tensors[key])
            bar.advance(error=float(found[-1].mean()))
    return found


def chosen(race: Race, count: int) -> int | None:
    """Number of the descent whose answer errs least on training samples, None where the pair's own mount errs less than all of
    them: what is judged on unseen samples has not been chosen by them."""
    if "chosen" not in race.tensors:
        problem = race.problem
        draws = [problem.draw(-1 - k) for k in range(FINAL_DRAWS)]
        mounts = [problem.start, *(race.answer(number, GRADIENT) for number in range(count))]
        errors = [sum(problem.bounded(share, draw) for draw in draws) for share in mounts]
        race.tensors["chosen"] = torch.tensor(errors).argmin() - 1
        race.save()
    number = int(race.tensors["chosen"])
    return None if number < 0 else number
