"""Searches over the cube of shares from 0 to 1 in which ``mount.MountRanges`` puts mounts: descent
along gradients that are noisy but right in the mean, and searches without gradients.

A search without gradients is a generator that gives a point and is sent its error, so that budget,
bounds and records are the same for all: ``count`` points, one call of the judge each, the start
first. What can be refused without a look costs none. The same seed and judge give the same points.
"""

import math
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass
from importlib.util import find_spec
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
# of the descent: lengths of the first and the last step, and the end of the way whose mean is the
# answer
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
        return int(self.error.argmin())


def descend(
    slope: Callable[[Tensor, int], tuple[float, Tensor]],
    start: Tensor,
    steps: int,
    advance: Callable[[float], object] = lambda error: None,
) -> Trail:
    """Normalised momentum descent in the cube, its steps ever shorter.

    Args:
      slope: (share [V], number of the step) -> value and gradient [V], of other samples in every
        step.
      start: [V].
    Returns: Trail of the points whose slopes were asked for, and last the mean of the end of the
      way, which is the answer and has the error of the last step. Raises: NonFiniteError.
    """
    here = start.detach().clone()
    pace = torch.zeros_like(here)
    shares, errors = [], []
    for step in range(steps):
        value, gradient = slope(here, step)
        if not torch.isfinite(gradient).all():
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

    propose: (start [V], seed) -> generator of points [V] without end, the start first, sent the
      error of each.
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
          refused: share [V] -> what the search is told of a point that needs no look, None for
            others; after MOST_REFUSED times ``count`` of them the search ends.
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
    random = np.random.default_rng(seed)  # another stream than the starts'
    yield start
    while True:
        yield torch.from_numpy(random.random(len(start)))


def evolved(start: Tensor, seed: int) -> Proposals:
    """CMA-ES about the start (which it only looks at first, so that all searches do); when it has
    ended, again from a random point with twice the population.

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
    # pycma needs two numbers
    mean = [*start.tolist(), *[0.5] * (len(start) == 1)]
    while True:
        strategy = cma.CMAEvolutionStrategy(mean, SIGMA, options)
        while not strategy.stop():
            asked = strategy.ask()
            errors = []
            for share in asked:
                errors.append((yield torch.as_tensor(share[: len(start)], dtype=torch.float64)))
            strategy.tell(asked, errors)
        options["popsize"] = 2 * strategy.popsize
        mean = random.random(len(mean)).tolist()


def estimated(start: Tensor, seed: int) -> Proposals:
    """The tree-structured Parzen estimator of optuna, over all numbers jointly."""
    names = [f"share_{k}" for k in range(len(start))]
    said = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        study = optuna.create_study(
            sampler=optuna.samplers.TPESampler(multivariate=True, seed=seed)
        )
    finally:
        optuna.logging.set_verbosity(said)
    study.enqueue_trial(dict(zip(names, start.tolist(), strict=True)))
    while True:
        trial = study.ask()
        share = [trial.suggest_float(name, 0.0, 1.0) for name in names]
        study.tell(trial, (yield torch.tensor(share, dtype=torch.float64)))


SEARCHES: dict[str, Search] = {
    "random": Search(uniform),
    "CMA-ES": Search(evolved, "cma"),
    "TPE": Search(estimated, "optuna"),
}


def available(names: Iterable[str]) -> dict[str, Search]:
    """The searches of these names.

    Raises: DomainError for a name that is not there; MissingPackageError where the library of one
      is not installed.
    """
    found = {}
    for name in names:
        if name not in SEARCHES:
            raise DomainError(f"search '{name}' is unknown; choose from {', '.join(SEARCHES)}.")
        found[name] = SEARCHES[name]
        library = SEARCHES[name].library
        if library and not find_spec(library):  # present ones are imported when they search
            require(library, "search", f"the search {name}")
    return found
