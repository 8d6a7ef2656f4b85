"""Searches without gradients, over the cube of shares from 0 to 1 in which ``mount.MountRanges`` puts mounts.

Each looks at ``count`` points, one call of the judge each, the start first; how the judge deals with noise is its own
affair. What can be refused without a look costs none. A search is a generator that gives a point and is sent its error,
so that budget, bounds and records are the same for all. The same seed and judge give the same points.
"""

import math
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from codesign.errors import DomainError, NonFiniteError, ShapeError, check_seed, check_whole
from codesign.optional import optional, require
from studies.placement.coordinate_search import along_axes

Judge: TypeAlias = Callable[[Tensor], float]
Proposals: TypeAlias = Generator[Tensor, float, None]

cma = optional("cma", "search", "the search CMA-ES")
optuna = optional("optuna", "search", "the search TPE")

MOST_REFUSED = 100  # points for each that is looked at
SIGMA = 0.25  # of CMA-ES: a quarter of the cube, as its authors advise
SEED_BITS = 32


@dataclass(frozen=True)
class Trail:
    """Points that a search looked at: share [N, V] and error [N], float64, in order."""

    share: Tensor
    error: Tensor

    @property
    def best(self) -> int:
        """Index of the smallest error."""
        return int(self.error.argmin())


@dataclass(frozen=True)
class Search:
    """A search by its proposals.

    propose: (start [V], seed) -> generator of points [V] without end, the start first, sent the error of each.
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

        Args: judge: share [V] -> error, the lower the better. start: [V] shares in 0..1. seed: from 0. advance: called
          with each error. refused: share [V] -> what the search is told of a point that needs no look, None for others;
          after MOST_REFUSED times ``count`` of them the search ends.
        Returns: Trail of the points looked at; the first is the start.
        Raises: DomainError for a start outside the cube; NonFiniteError where the judge's error is not finite;
          ShapeError; MissingPackageError.
        """
        check_whole(count, "search: count")
        if check_seed(seed, "search: seed", SEED_BITS) < 0:
            raise DomainError(f"search: seed = {seed} must be at least 0.")
        if start.ndim != 1 or not start.numel():
            raise ShapeError(f"search: the start is [V], one share each, got {tuple(start.shape)}.")
        start = start.detach().double()
        if not bool(((start >= 0) & (start <= 1)).all()):
            raise DomainError(
                f"search: the start {start.tolist()} is not in the cube from 0 to 1; move it inside."
            )
        return _followed(self.propose(start, seed), judge, count, advance, refused)


def uniform(start: Tensor, seed: int) -> Proposals:
    """Points spread evenly at random."""
    random = np.random.default_rng(seed)  # another stream than the starts'
    yield start
    while True:
        yield torch.from_numpy(random.random(len(start)))


def evolved(start: Tensor, seed: int) -> Proposals:
    """CMA-ES about the start (which it only looks at first, so that all searches do); when it has ended, again from a
    random point with twice the population.

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


SEARCHES: dict[str, Search] = {
    "random": Search(uniform),
    "coordinate": Search(along_axes),
    "CMA-ES": Search(evolved, "cma"),
    "TPE": Search(estimated, "optuna"),
}


def available(names: Iterable[str]) -> dict[str, Search]:
    """The searches of these names.

    Raises: DomainError for a name that is not there; MissingPackageError where the library of one is not installed.
    """
    found = {}
    for name in names:
        if name not in SEARCHES:
            raise DomainError(f"search '{name}' is unknown; choose from {', '.join(SEARCHES)}.")
        found[name] = SEARCHES[name]
        if found[name].library:
            require(found[name].library, "search", f"the search {name}")
    return found


def _followed(proposals, judge, count, advance, refused):
    """Trail of the first ``count`` proposals that are not refused."""
    shares = []
    errors = []
    share = next(proposals).clamp(0, 1)
    for _ in range((1 + MOST_REFUSED) * count):
        told = refused(share.clone()) if errors else None  # the start is looked at
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
        share = proposals.send(told).clamp(0, 1)  # rounding
    proposals.close()
    return Trail(torch.stack(shares), torch.tensor(errors, dtype=torch.float64))
