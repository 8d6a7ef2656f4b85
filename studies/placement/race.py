"""The searches for a mount from the same starts at equal renders, what each ends with, and its
error in worlds that none saw; all of it kept in the run's state."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.mount import PrecisionTrend, starts
from codesign.mount.requirements import first_missed
from scenes.robots.pair import RobotPair
from studies.frame.files import check_same, digest, digests
from studies.frame.run import Run
from studies.placement.problem import Problem
from studies.placement.searches import SEARCHES, Trail, descend

GRADIENT = "gradient"
# the pair's own mount
DEFAULT = "default"
# of the cube: the gradient's differences of geometry
STEP = 0.12
# that choose among answers
FINAL_DRAWS = 12
# of bounded errors
WORST = 1.0


def feasible(problem: Problem, count: int, seed: int, first: Sequence[Tensor] = ()) -> list[Tensor]:
    """Mounts [6] to start from: those given, and others spread at random over what is allowed."""
    if problem.ranges.held.all():
        raise DomainError(
            "equal bounds hold all six numbers of the mount; widen what is to be searched."
        )
    found = list(first)[:count]
    if more := count - len(found):
        found += starts(problem.ranges, more, problem.requirements, problem.real, seed=seed)
    return found


def kept(problem: Problem, share: Tensor) -> bool:
    """Whether a mount keeps every requirement, by the hard answer; the cheap ones are asked
    first."""
    return first_missed(problem.requirements, problem.ranges.pose(share), problem.real) is None


def fingerprints(pair: RobotPair) -> dict[str, str]:
    """What a user may have changed since a run was begun: the robot's page, and the files of which
    it was made."""
    found: dict[str, str] = {"the robot's page": digest(pair.page.encode())}
    for path in pair.files:
        name = f"'{path.name}'"  # alone: a folder may be copied elsewhere
        found[name] = "".join([found.get(name, ""), *digests([path]).values()])
    return found


class Race:
    """Finished searches, kept in the run's state: a resumed run makes only those that are
    missing."""

    def __init__(self, run: Run[Any], problem: Problem):
        self.run = run
        self.problem = problem
        self.fingerprints = fingerprints(problem.pair)
        stored = run.load_state()
        self.tensors: dict[str, Tensor] = dict(stored.tensors) if stored else {}
        if stored:
            check_same(stored.numbers, self.fingerprints)

    def save(self) -> None:
        self.run.save_state(self.tensors, self.fingerprints)

    def trail(self, number: int, name: str) -> Trail:
        return Trail(*(self.tensors[f"{name}/{number}/{part}"] for part in ("share", "error")))

    def samples(self, number: int, name: str) -> int:
        return int(self.tensors[f"{name}/{number}/samples"])

    def descent(self, number: int, start: Tensor) -> None:
        """Gradient steps: differences of geometry, and the exact gradient of the penalty."""
        problem, first = self.problem, 1000 * (self.run.config.seed + number)
        problem.trend = PrecisionTrend()

        def slope(share, step):
            error, gradient = problem.expected_around(
                share, problem.draw(first + step), STEP, learn=True
            )
            at = share.clone().requires_grad_()
            penalty = problem.penalty(problem.ranges.pose(at))
            (push,) = torch.autograd.grad(penalty, at)
            return float(error + penalty.detach()), gradient + push

        steps = self.run.config.steps
        self._made(number, GRADIENT, steps, lambda advance: descend(slope, start, steps, advance))

    def search(self, number: int, name: str, start: Tensor) -> None:
        """A search without gradients at as many samples as the descent rendered, all on the same
        ones.

        Of mounts that do not keep what is required nothing is rendered: they are told to be worse
        than any other.
        """
        problem, seed = self.problem, self.run.config.seed + number
        samples = problem.draw(1000 * seed)
        count = max(2, self.samples(number, GRADIENT) // problem.samples)
        free = ~problem.ranges.held

        def whole(part):
            batch = part.shape[:-1]
            return start.expand(*batch, 6).masked_scatter(free.expand(*batch, 6), part)

        def refused(part):
            share = whole(part)
            return None if kept(problem, share) else WORST + problem.penalty_of(share)

        def judge(part):
            return problem.error(whole(part), samples)

        def make(advance):
            trail = SEARCHES[name](judge, start[free], count, seed, advance, refused)
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
        """The mount [6] that a search ends with: the descent's mean of its end, or the last before
        it that keeps what is required; of the others the best that does."""
        trail = self.trail(number, name)
        shares = trail.share.flip(0) if name == GRADIENT else trail.share[trail.error.argsort()]
        return next((share for share in shares if kept(self.problem, share)), trail.share[0])

    def judge(self, unseen: Problem, starts: list[Tensor]) -> dict[tuple[int, str], Tensor]:
        """Bounded errors [N] of starts and answers, on the same unseen samples with single events.

        Key: (start, search); the pair's own design is (0, DEFAULT), the starts (number, "start").
        """
        wanted = {(0, DEFAULT): unseen.start}
        for number, start in enumerate(starts):
            wanted[number, "start"] = start
            for name in (GRADIENT, *self.run.config.searches):
                wanted[number, name] = self.answer(number, name)
        samples = unseen.draw(0)
        found = {}
        with self.run.progress(len(wanted), "judging with single events") as bar:
            for (number, name), share in wanted.items():
                key = f"judged/{name}/{number}"
                if key not in self.tensors:
                    pose = unseen.ranges.pose(share)
                    self.tensors[key] = unseen.judged(pose, samples, "sensor").bounded()
                    self.save()
                found[number, name] = self.tensors[key]
                bar.advance(error=self.tensors[key].mean())
        return found

    def chosen(self, count: int) -> tuple[int, str]:
        """Start and search of the answer that errs least on training drives, (0, DEFAULT) where the
        pair's own mount errs less than all of them: what is judged on unseen samples has not been chosen by them."""
        names = (GRADIENT, *self.run.config.searches)
        answers = [(number, name) for number in range(count) for name in names]
        if "final_errors" not in self.tensors:
            problem = self.problem
            mounts = [problem.start, *(self.answer(*each) for each in answers)]
            draws = [problem.draw(-1 - k) for k in range(FINAL_DRAWS)]
            errors = []
            with self.run.progress(len(mounts), "choosing on training drives") as bar:
                for share in mounts:
                    errors.append(sum(problem.bounded(share, draw) for draw in draws) / FINAL_DRAWS)
                    bar.advance(error=errors[-1])
            self.tensors["final_errors"] = torch.tensor(errors, dtype=torch.float64)
            self.save()
        return [(0, DEFAULT), *answers][int(self.tensors["final_errors"].argmin())]
