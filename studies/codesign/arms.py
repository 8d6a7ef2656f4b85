"""Ways to a whole design at equal rendered drives: joint, one block after the other, alternating,
by the book, nested."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import permutations

import torch
from torch import Tensor

from codesign.mount.requirements import first_missed
from scenes.robots import pair as robot_pair
from scenes.robots.costs import FASTEST
from studies.codesign.design import BLOCKS, Space
from studies.codesign.objective import Objective
from studies.codesign.problem import Looked
from studies.placement.searches import SEARCHES

FIRST_LENGTH, LAST_LENGTH = 0.15, 0.03  # of steps in the cube
MOMENTUM = 0.7
END = 0.25  # of the way, whose mean is the answer
RECORDED = 3  # rounds of drives on which sensor and estimator are settled
NESTED = 8  # designs of sensor and estimator tried at every step
BOOK_STEPS = 40  # of focal length, from the longest on
GEOMETRY = ("lens", "mount")


@dataclass
class Way:
    """shares: looked at, with the error to be expected at each; recorded: the last drives that were
    rendered; expected: the error at what the way ends with, a search with the best it has seen."""

    shares: list[Tensor] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)
    recorded: list[Looked] = field(default_factory=list)
    expected: float | None = None

    def add(self, share: Tensor, error: float, looked: Looked) -> None:
        """One step."""
        self.shares.append(share)
        self.errors.append(error)
        self.expected = error
        self.recorded = [*self.recorded, looked][-RECORDED:]


def descend(
    objective: Objective,
    start: Tensor,
    free: list[int],
    steps: int,
    first: int,
    way: Way,
    before: Callable[[Tensor, Way], Tensor] = lambda share, way: share,
    done: int = 0,
    of: int = 0,
) -> Tensor:
    """Steps of equal length down the slope with momentum, shorter and shorter; fresh drives in
    each.

    Args:
      start: [V] shares.
      free: places of those that move.
      first: number of the first draw.
      way: what is looked at goes there.
      before: called before every step, for what is solved within it.
      done, of: steps that went before, and all those over which their length falls; those of this
        call for 0.
    Returns: mean of the last quarter.
    """
    here, pace = start.clone(), torch.zeros_like(start)
    mine = []
    for step in range(steps):
        here = before(here, way)
        value, slope, looked = objective(here, objective.drawn.draw(first + step), free)
        way.add(here, value, looked)
        mine.append(here)
        blocked = ((here <= 0) & (slope > 0)) | ((here >= 1) & (slope < 0))
        slope = torch.where(blocked, 0.0, slope)
        pace = MOMENTUM * pace + (1 - MOMENTUM) * slope / slope.norm().clamp_min(1e-12)
        length = FIRST_LENGTH * (LAST_LENGTH / FIRST_LENGTH) ** (
            (done + step) / max(1, (of or steps) - 1)
        )
        here = (here - length * pace / pace.norm().clamp_min(1e-12)).clamp(0, 1)
    return torch.stack([*mine, here][-max(1, round(END * steps)) :]).mean(0)


def read_out(task: "Task", share: Tensor, way: Way, tries: int = 0) -> Tensor:
    """Shares [V] with sensor and estimator settled on the drives recorded last
    (``Objective.settled``); ``tries`` of them, those of the task for 0."""
    if not task.space.part("read-out") or not way.recorded:
        return share
    return task.objective.settled(share, way.recorded, tries or task.settling)


@dataclass(frozen=True)
class Task:
    """What every arm gets: objective, start [V], steps in all, first number of draws, seed, designs
    of sensor and estimator tried wherever these are settled."""

    objective: Objective
    start: Tensor
    steps: int
    first: int
    seed: int
    settling: int = 24

    @property
    def space(self) -> Space:
        return self.objective.space

    def free(self, *blocks: str) -> list[int]:
        """Places of the blocks' numbers."""
        return [k for name in blocks for k in self.space.block(name)]

    def look(self, share: Tensor, way: Way) -> None:
        """Render a draw at shares, for what is solved on recorded frames."""
        way.add(share, *self.objective.look(share, self.first + len(way.shares)))

    def descend(self, start, blocks, steps, way, **how) -> Tensor:
        """Steps in some blocks, draws numbered on from those on the way."""
        first = self.first + len(way.shares)
        return descend(self.objective, start, self.free(*blocks), steps, first, way, **how)


def joint(task: Task) -> tuple[Tensor, Way]:
    """All numbers in one descent."""
    way = Way()
    return task.descend(task.start, tuple(BLOCKS), task.steps, way), way


def ordered(names: tuple[str, ...]) -> Callable[[Task], tuple[Tensor, Way]]:
    """One block after the other, half of the steps for lens and mount each; sensor and estimator in
    their turn on what is recorded, for which one step is spent where nothing is yet."""

    def arm(task):
        way, here = Way(), task.start
        left = len(GEOMETRY)
        for name in names:
            if name == "read-out":
                if not way.recorded:
                    task.look(here, way)
                here = read_out(task, here, way)
            else:
                here = task.descend(here, (name,), (task.steps - len(way.shares)) // left, way)
                left -= 1
        return here, way

    return arm


def alternating(sweeps: int) -> Callable[[Task], tuple[Tensor, Way]]:
    """Lens, mount, sensor and estimator in turns, steps shorter and shorter over all of them."""

    def arm(task):
        way, here = Way(), task.start
        steps = task.steps // (len(GEOMETRY) * sweeps)
        # a simplex has a corner more than numbers, and is to move once
        tries = max(task.settling // sweeps, len(task.space.part("read-out")) + 2)
        for _ in range(sweeps):
            for name in GEOMETRY:
                fallen = {"done": len(way.shares), "of": task.steps}
                here = task.descend(here, (name,), steps, way, **fallen)
            here = read_out(task, here, way, tries)
        return here, way

    return arm


def nested(task: Task) -> tuple[Tensor, Way]:
    """Lens and mount in one descent, sensor and estimator solved again on recorded frames at every
    step."""
    way = Way()

    def solved(share, so_far):
        return read_out(task, share, so_far, NESTED)

    return task.descend(task.start, GEOMETRY, task.steps, way, before=solved), way


def by_the_book(task: Task) -> tuple[Tensor, Way]:
    """What a careful engineer does without a model of the task: the longest lens that still sees
    ahead from the nominal place, focused at the hyperfocal distance and stopped down as far as
    light allows, default pixels; then the mount by the task's own error, then the read-out."""
    way, space = Way(), task.space
    share = space.share(**chosen_by_the_book(space, task.objective.drawn.requirements))
    return task.descend(share, ("mount",), task.steps, way), way


def chosen_by_the_book(space: Space, requirements) -> dict[str, float]:
    """Focal length, f-number and focus in the order of the handbook.

    f-number: full light for half of the darkest surfaces' contrast, so the smallest at which the
    picture is as bright as the sensor's knee (20 of 255). Focus: hyperfocal for a blur of one
    pixel.
    """
    low, high = space.limits("fno")
    bright = 20 / robot_pair.LIGHT[0] / space.costs.light
    fno = min(max(FASTEST / math.sqrt(bright), low), high)
    shortest, longest = space.limits("efl_mm")
    focal = longest
    for step in range(BOOK_STEPS):
        focal = longest * (shortest / longest) ** (step / (BOOK_STEPS - 1))
        made = space.made(space.share(efl_mm=focal, fno=fno))
        if first_missed(requirements, made.T_body_cam, made.camera) is None:
            break
    near, far = space.limits("focus_per_m")
    # what is not free stays as it is held
    has = space.made(space.share(efl_mm=focal, fno=fno)).numbers
    hyperfocal = 1e3 * has["fno"] * robot_pair.PITCH_MM / has["efl_mm"] ** 2
    return {"efl_mm": focal, "fno": fno, "focus_per_m": min(max(hyperfocal, near), far)}


def searched(name: str) -> Callable[[Task], tuple[Tensor, Way]]:
    """A search without gradients over the whole design, by the errors to be expected on one set of
    drives."""

    def arm(task):
        way, drawn = Way(), task.objective.drawn
        samples = drawn.draw(task.first)

        def judge(share):
            looked = drawn.looked(task.space.made(share), samples)
            error = float(looked.expected.mean()) + task.objective.penalty(share)
            best = min(way.errors, default=math.inf)
            recorded = [looked] if error < best else way.recorded
            way.add(share, error, looked)
            way.expected = min(error, best)
            way.recorded = recorded  # the read-out is settled on what the best design saw
            return error

        trail = SEARCHES[name](judge, task.start, task.steps, task.seed)
        return trail.share[trail.best], way

    return arm


def default(task: Task) -> tuple[Tensor, Way]:
    """The pair's own design."""
    return task.space.start, Way()


def settled_default(task: Task) -> tuple[Tensor, Way]:
    """The pair's own lens and mount; like every arm it ends with sensor and estimator settled on
    the drives recorded last."""
    way = Way()
    for _ in range(RECORDED):
        task.look(task.space.start, way)
    return task.space.start, way


ARMS: dict[str, Callable[[Task], tuple[Tensor, Way]]] = {
    "joint": joint,
    **{" > ".join(names): ordered(names) for names in permutations((*GEOMETRY, "read-out"))},
    "alternating 4": alternating(4),
    "alternating 8": alternating(8),
    "nested": nested,
    "book": by_the_book,
    **{name: searched(name) for name in ("CMA-ES", "TPE", "random")},
    "default": default,
    "default, settled": settled_default,
}
