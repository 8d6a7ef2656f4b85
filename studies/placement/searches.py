"""Searches over the cube of shares from 0 to 1 in which ``mount.MountRanges`` puts mounts: descent along
gradients that are noisy but right in the mean, and searches without gradients.

A search without gradients is a generator that gives a point and is sent its error, so that budget, bounds and
records are the same for all: ``count`` points, one call of the judge each, the start first. What can be
refused without a look costs none. The same seed and judge give the same points.
"""

import math
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from codesign.errors import DomainError, NonFiniteError
from codesign.optional import optional, require

Judge: TypeAlias = Callable[[Tensor], float]
Proposals: TypeAlias = Generator[Tensor, float, None]

cma = optional("cma", "search", "the search CMA-ES")
optuna = optional("optuna", "search", "the search TPE")

# points refused for each that is looked at
MOST_REFUSED = 100
# of CMA-ES: a quarter of the cube, as its authors advise
SIGMA = 0.25
# of coordinate search, in shares; nobody mounts a camera more exactly than the last
FIRST_STEP = 0.2
LAST_STEP = 1e-4
# of the descent: lengths of the first and the last step, and the end of the way whose mean is the answer
FIRST_LENGTH = 0.15
LAST_LENGTH = 0.02
MOMENTUM = 0.7
END = 0.25


@dataclass(frozen=True)
class Trail:
    """Points that a search looked at: share [N, V] and error [N], float64, in order."""

    share: Tensor
    error: Tensor

    @property
    def best(self) -> int:
        """Index of the smallest error."""
        return int(self.error.argmin())


def descend(
    slope: Callable[[Tensor, int], tuple[float, Tensor]],
    start: Tensor,
    steps: int,
    advance: Callable[[float], object] = lambda error: None,
) -> Trail:
    """Normalised momentum descent in the cube, its steps ever shorter.

    Args:
      slope: (share [V], number of the step) -> value and gradient [V], of other samples in every step.
      start: [V].
    Returns: Trail of the points whose slopes were asked for, and last the mean of the end of the way, which
      is the answer and has the error of the last step. Raises: NonFiniteError.
    """
    here = start.detach().clone()
    pace = torch.zeros_like(here)
    shares = []
    errors = []
    for step in range(steps):
        value, gradient = slope(here, step)
        if not bool(torch.isfinite(gradient).all()):
            raise NonFiniteError(f"the gradient of the placement is not finite at step {step + 1}.")
        shares.append(here)
        errors.append(value)
        advance(value)
        # what pushes through a wall of the cube has no part in the direction
        blocked = ((here <= 0) & (gradient > 0)) | ((here >= 1) & (gradient < 0))
        gradient = torch.where(blocked, 0.0, gradient)
        pace = MOMENTUM * pace + (1 - MOMENTUM) * gradient / gradient.norm().clamp_min(1e-12)
        length = FIRST_LENGTH * (LAST_LENGTH / FIRST_LENGTH) ** (step / max(1, steps - 1))
        here = (here - length * pace / pace.norm().clamp_min(1e-12)).clamp(0, 1)
    errors.append(errors[-1])
    shares.append(torch.stack([*shares, here])[-max(1, round(END * steps)) :].mean(0))
    return Trail(torch.stack(shares), torch.tensor(errors, dtype=torch.float64))


@dataclass(frozen=True)
class Search:
    """A search by its proposals.

    propose: (start [V], seed) -> generator of points [V] without end, the start first, sent the error of
      each.
    library: module that it needs, None for none.
    """

    propose: Callable[[Tensor, int], Proposals]
    library: str | None = None

    def __call__(
        self,
        judge: Judge,
        start: Tensor,
        count: int,
        seed: int,
        advance: Callable[[float], object] = lambda error: None,
        refused: Callable[[Tensor], float | None] = lambda share: None,
    ) -> Trail:
        """Look at ``count`` points.

        Args:
          judge: share [V] -> error, the lower the better.
          start: [V] shares in 0..1.
          seed: from 0.
          advance: called with each error.
          refused: share [V] -> what the search is told of a point that needs no look, None for others; after
            MOST_REFUSED times ``count`` of them the search ends.
        Returns: Trail of the points looked at; the first is the start.
        Raises: NonFiniteError where the judge's error is not finite.
        """
        shares: list[Tensor] = []
        errors: list[float] = []
        proposals = self.propose(start.detach().double(), seed)
        share = next(proposals).clamp(0, 1)
        for _ in range((1 + MOST_REFUSED) * count):
            # the start is looked at
            told = refused(share.clone()) if errors else None
            if told is None:
                told = float(judge(share.clone()))
                shares.append(share)
                errors.append(told)
                advance(told)
            if not math.isfinite(told):
                raise NonFiniteError(
                    f"search: the judge says {told} of the shares {share.tolist()}; give it finite errors."
                )
            if len(errors) == count:
                break
            # proposals leave the cube by rounding
            share = proposals.send(told).clamp(0, 1)
        proposals.close()
        return Trail(torch.stack(shares), torch.tensor(errors, dtype=torch.float64))


def uniform(start: Tensor, seed: int) -> Proposals:
    """Points spread evenly at random."""
    random = np.random.default_rng(seed)  # another stream than the starts'
    yield start
    while True:
        yield torch.from_numpy(random.random(len(start)))


def evolved(start: Tensor, seed: int) -> Proposals:
    """CMA-ES about the start (which it only looks at first, so that all searches do); when it has ended,
    again from a random point with twice the population.

    Source: pycma, Hansen, Akimoto and Baudis, 2019; restarts of Auger and Hansen, CEC 2005.
    """
    random = np.random.default_rng(seed)
    options = {
        "bounds": [0, 1],
        "seed": math.nan,  # the global generator is left alone
        "randn": lambda *shape: random.standard_normal(shape),
        "verbose": -9,
        "verb_log": 0,
        "signals_filename": "",
    }
    yield start
    mean = start.tolist()
    while True:
        strategy = cma.CMAEvolutionStrategy(mean, SIGMA, options)
        while not strategy.stop():
            asked = strategy.ask()
            errors = []
            for share in asked:
                errors.append((yield torch.as_tensor(share, dtype=torch.float64)))
            strategy.tell(asked, errors)
        options["popsize"] = 2 * strategy.popsize
        mean = random.random(len(start)).tolist()


def estimated(start: Tensor, seed: int) -> Proposals:
    """The tree-structured Parzen estimator of optuna, over all numbers jointly."""
    names = [f"share_{k}" for k in range(len(start))]
    said = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        study = optuna.create_study(sampler=optuna.samplers.TPESampler(multivariate=True, seed=seed))
    finally:
        optuna.logging.set_verbosity(said)
    study.enqueue_trial(dict(zip(names, start.tolist(), strict=True)))
    while True:
        trial = study.ask()
        share = [trial.suggest_float(name, 0.0, 1.0) for name in names]
        study.tell(trial, (yield torch.tensor(share, dtype=torch.float64)))


def along_axes(start: Tensor, seed: int) -> Proposals:
    """One number after the other, in an order drawn anew for each round, and once along what the round has
    moved; from a random point again when steps have become too short to matter.

    Source: line searches of Davies, Swann and Campey, as in Box, Davies and Swann, Non-linear Optimization
      Techniques, 1969: steps are doubled while they help, then the vertex of a parabola is tried. The move
      after a round is that of Hooke and Jeeves, J. ACM 8, 1961.
    """
    random = torch.Generator().manual_seed(seed)
    at = start
    while True:
        yield from _descended(at, random)
        at = torch.rand(start.shape, generator=random, dtype=torch.float64)


def _descended(at, random):
    """From ``at`` downhill, until a round of the shortest steps does not help."""
    error = yield at
    steps = [FIRST_STEP] * len(at)  # towards the side where it was better last time
    helped = True
    while helped or max(map(abs, steps)) > LAST_STEP:
        before = at
        for axis in torch.randperm(len(at), generator=random).tolist():
            along = torch.eye(len(at), dtype=torch.float64)[axis]
            at, error, steps[axis] = yield from _line(at, error, along, steps[axis])
        moved = at - before
        helped = bool(moved.any())
        if int(moved.count_nonzero()) > 1:
            at, error, _ = yield from _line(at, error, moved / moved.norm(), float(moved.norm()))


def _line(at, error, along, step):
    """The best point on a line, its error, and the step to begin with next time."""

    def point(to):
        return (at + to * along).clamp(0, 1)

    walls = (torch.stack([-at, 1 - at]) / along)[:, along != 0]
    low, high = float(walls.amin(0).max()), float(walls.amax(0).min())
    best = 0.0
    known = {best: error}
    for reach in (step, -step):
        while (to := min(max(best + reach, low), high)) not in known:
            known[to] = yield point(to)
            if known[to] >= known[best]:
                break
            best = to
            reach *= 2
        if best:
            break
    vertex = _vertex(known, best)
    if vertex not in known:
        known[vertex] = yield point(vertex)
        best = vertex if known[vertex] < known[best] else best
    length = min(max(abs(best), abs(step) / 4, LAST_STEP), 2 * FIRST_STEP)
    return point(best), known[best], math.copysign(length, best or step)


def _vertex(known, best):
    """Where a parabola through the best of the known places and its two neighbours is lowest; the best itself
    where it has one neighbour, or no parabola is lower by a step that matters."""
    places = sorted(known)
    k = places.index(best)
    if not 0 < k < len(places) - 1:
        return best
    below, above = best - places[k - 1], places[k + 1] - best
    rise_below, rise_above = (known[places[j]] - known[best] for j in (k - 1, k + 1))
    bend = above * rise_below + below * rise_above
    if bend <= 0:
        return best
    shift = (above**2 * rise_below - below**2 * rise_above) / (2 * bend)
    return best + shift if abs(shift) > LAST_STEP / 10 else best


SEARCHES: dict[str, Search] = {
    "random": Search(uniform),
    "coordinate": Search(along_axes),
    "CMA-ES": Search(evolved, "cma"),
    "TPE": Search(estimated, "optuna"),
}


def available(names: Iterable[str]) -> dict[str, Search]:
    """The searches of these names.

    Raises: DomainError for a name that is not there; MissingPackageError where the library of one is not
      installed.
    """
    found = {}
    for name in names:
        if name not in SEARCHES:
            raise DomainError(f"search '{name}' is unknown; choose from {', '.join(SEARCHES)}.")
        found[name] = SEARCHES[name]
        if found[name].library:
            require(found[name].library, "search", f"the search {name}")
    return found
