"""Which part brings the gain of a robot's camera designed as a whole: lens, mount, sensor or
estimator?

Every subset of the four is designed in one descent (studies.codesign), what is left out being held
as the pair has it. A part's share of the gain is its Shapley value: what it adds to the log of the
error, averaged over all orders in which parts can be let free.
"""

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations
from math import comb

import torch
from torch import Tensor

from studies.codesign.cells import CellsConfig, answers, judged_errors, setting, space_of
from studies.codesign.design import BLOCKS
from studies.codesign.race import ENOUGH
from studies.frame.compare import crossed
from studies.frame.run import Run, main
from studies.frame.show import bars, tabulate
from studies.frame.sweep import column

NAMES = {"lens": "lens", "mount": "mount", "sensor": "sensor", "network": "estimator"}
SUBSETS = [frozenset(parts) for size in range(1, 5) for parts in combinations(BLOCKS, size)]


@dataclass(frozen=True)
class Config(CellsConfig):
    """Subsets of the parts are its settings."""


def study(run: Run[Config]) -> None:
    config = run.config
    whole = setting(config)
    space = space_of(whole)
    cells = {
        told(parts): setting(
            config,
            free=[
                name
                for part in BLOCKS
                if part in parts
                for name in BLOCKS[part]
                if name in space.free
            ],
        )
        for parts in SUBSETS
    }
    rows = answers(run, cells, ("joint",))
    held = judged_errors(config, whole, space.start.tolist())
    errors = {frozenset(): [held["errors"]] * config.seeds}
    errors |= {parts: column(rows, "errors", regime=told(parts)) for parts in SUBSETS}
    logs = {parts: torch.tensor(of, dtype=torch.float64).log() for parts, of in errors.items()}
    lines = []
    for parts, of in logs.items():
        over, rest = (
            crossed(of - logs[other]).ratio() for other in (frozenset(), frozenset(BLOCKS))
        )
        alone = sum(logs[frozenset({part})] - logs[frozenset()] for part in parts)
        beyond = crossed(of - logs[frozenset()] - alone).ratio()
        lines.append(
            {
                "designed": told(parts),
                "error": float(of.exp().mean(1).quantile(0.5)),
                "over the default": f"{over:.2f}" if parts else "",
                "over the whole": f"{rest:.2f}" if parts != frozenset(BLOCKS) else "",
                "over its parts' own gains": f"{beyond:.2f}" if len(parts) > 1 else "",
            }
        )
    brought = {NAMES[part]: of for part, of in shapley(logs).items()}
    shares = {name: crossed(of).ratio() for name, of in brought.items()}
    for name, share in shares.items():
        run.record(**share.metrics(f"share_{name}"))
    run.section(
        "What each part brings",
        "The factor by which letting a part free multiplies the error, averaged over all orders in which parts can be let free; "
        "start by start the factors' product is the whole gain. Median over starts, 95 % of resampled starts and worlds.",
    )
    run.figure(
        bars(shares, "factor of the error", log=True, level=1.0), "shares", "Shapley values."
    )
    run.section(
        "Every subset",
        "One descent along the numbers of these parts, the others as the pair has them: errors in unseen worlds, median over "
        "starts, and their ratios; the last one is over what its parts would leave if each brought what it brings alone.",
    )
    tabulate(run, "Subsets", lines, "designed", prefix="designed")
    order = sorted(shares, key=lambda name: shares[name].value)
    said = "; ".join(f"{name} {shares[name]:.2f}" for name in order)
    lead = crossed(brought[order[0]] - brought[order[1]])
    sure = "" if lead.high < 0 else ", though that is undecided"
    few = " So few starts decide nothing." if config.seeds < ENOUGH else ""
    run.finish(
        "What each part of a design brings",
        f"Of the parts of '{config.pair}' the {order[0]} brings most{sure} ({order[0]} over {order[1]} {lead.ratio():.2f}). "
        f"Factors of the error: {said}.{few}",
    )


def told(parts: Iterable[str]) -> str:
    """Names of parts, in the order of a design."""
    return ", ".join(NAMES[part] for part in BLOCKS if part in set(parts)) or "nothing"


def shapley(values: Mapping[frozenset[str], Tensor]) -> dict[str, Tensor]:
    """Of a value for every subset of players each player's share.

    Source: Shapley, Contributions to the Theory of Games 2 (1953) 307.

    >>> worth = {frozenset(): 0.0, frozenset("a"): 1.0, frozenset("b"): 0.0, frozenset("ab"): 2.0}
    >>> {name: float(share) for name, share in shapley(worth).items()}
    {'a': 1.5, 'b': 0.5}
    """
    players = sorted(max(values, key=len))
    found = {}
    for player in players:
        found[player] = sum(
            (values[subset | {player}] - values[subset])
            / (len(players) * comb(len(players) - 1, len(subset)))
            for subset in values
            if player not in subset
        )
    return found


if __name__ == "__main__":
    sys.exit(main(study, Config))
