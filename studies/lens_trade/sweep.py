"""The long part of the trade study as jobs of their own: spot optima of every start, then both designers at every value.

A job is a pure function of plain values to plain values; lenses lie as files in the run's folder.
"""

from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cached_property
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.lens import GeoLens
from codesign.system import Batch
from studies.lens_opt.task import HELD_OUT
from studies.lens_trade import cases
from studies.lens_trade.designers import SAMPLES, by_flow, by_search, by_spots, log_errors, mean_log_error
from studies.lens_trade.problem import FLAT, Problem, Weights
from studies.lens_trade.trades import TRADES, Trade, owned, spot_chain

# what the spot designer may weigh: corners less, near less or more
WEIGHTS = (Weights(0.4, 0.0), Weights(1.0, -0.5), Weights(1.0, -1.0), Weights(0.4, -0.5), Weights(1.0, 0.5))
REWEIGHED = 1  # starts that get all weights: the best by development cases
DESCENTS = 3  # starts that the flow designer goes on from: the best by development cases
REFINE = 25  # steps after a change of weights
DESIGNERS = ("textbook", "spots", "flow")


@dataclass(frozen=True)
class Effort:
    """How much of everything: seeds of the random starts, flow steps and cases per step, tries of the search, cases of
    development and judgement."""

    starts: tuple[int, ...]
    steps: int
    batch: int
    tries: int
    development: int
    judged: int


def one_thread() -> None:
    """Workers share the cores, so each takes one."""
    import drjit

    drjit.set_thread_count(1)
    torch.set_num_threads(1)


def lens_file(folder: Path, trade: str, at: int, label: str) -> Path:
    return folder / f"{trade}_{at}_{label}.json"


def chain_job(folder: Path, trade: str, seed: int) -> dict[str, Any]:
    """Spot optima of one start at every value, as files."""
    for at, geo in enumerate(spot_chain(TRADES[trade], seed)):
        lens.save(geo, lens_file(folder, trade, at, f"start{seed}"))
    return {}


def point_job(folder: Path, trade: str, at: int, effort: Effort) -> dict[str, Any]:
    """Both designers at one value of a trade, judged on the same held-out cases.

    textbook: the start of the least flat spot. spots: of all starts and weights the best on the development cases.
    flow: of descents from the best starts, and a search without gradients from the best of those, the best on them.
    """
    found = TRADES[trade]
    value = found.values[at]
    light = found.light
    starts = [
        lens.load(path).freeze()
        for seed in effort.starts
        if (path := lens_file(folder, trade, at, f"start{seed}")).exists()
    ]
    if not starts:
        raise DomainError(f"{trade} {value:g}: no start became a lens.")
    judge = _Judge(found, value, effort)
    flat = [judge.candidate(geo, FLAT, f"start {k}") for k, geo in enumerate(starts)]
    best = sorted(flat, key=lambda c: c.development)[:REWEIGHED]
    spots = flat + [judge.reweighed(c, weights) for c in best for weights in WEIGHTS]
    leaders = [min((c for c in spots if c.start == f.start), key=lambda c: c.development) for f in flat]
    leaders = sorted(leaders, key=lambda c: c.development)[:DESCENTS]
    flows = [judge.descended(c, k) for k, c in enumerate(leaders)]
    flows.append(judge.searched(min(flows, key=lambda c: c.development)))
    chosen = {
        "textbook": min(flat, key=lambda c: c.rms_px),
        "spots": min(spots, key=lambda c: c.development),
        "flow": min(flows, key=lambda c: c.development),
    }
    row: dict[str, Any] = {
        "trade": trade,
        "value": value,
        "at": at,
        "starts": len(starts),
        "efl_mm": judge.problem(chosen["spots"].geo).efl_mm,
        "candidates": {
            name: [
                {"start": c.start, "rms_px": c.rms_px, "development": c.development, **vars(c.weights)}
                for c in group
            ]
            for name, group in (("spots", spots), ("flow", flows), ("flow_from", leaders))
        },
    }
    for name, candidate in chosen.items():
        problem = judge.problem(candidate.geo)
        lens.save(candidate.geo, lens_file(folder, trade, at, name))
        row[name] = {
            "start": candidate.start,
            "weights": vars(candidate.weights),
            "rms_px": candidate.rms_px,
            "violation": problem.violation(candidate.geo),
            "track_mm": float(candidate.geo.thickness_mm.sum()),
            "held_out": log_errors(
                problem, light, candidate.geo, judge.cases(HELD_OUT, 9_000_000, effort.judged)
            ),
        }
    return row


@dataclass(frozen=True)
class _Candidate:
    geo: GeoLens
    start: str
    weights: Weights
    rms_px: float
    development: float


@dataclass(frozen=True)
class _Judge:
    """What the designers of one value work with."""

    trade: Trade
    value: float
    effort: Effort

    def problem(self, geo: GeoLens) -> Problem:
        return self.trade.problem(self.value, geo)

    @cached_property
    def development(self) -> list[Batch]:
        return self.cases(cases.DEVELOPMENT, 5_000_000, self.effort.development)

    def cases(self, names, first, count):
        efl_mm = self.problem(self.trade.template(self.value)).efl_mm
        return cases.judged_cases(names, first, count, efl_mm)

    def candidate(self, geo: GeoLens, weights: Weights, start: str) -> _Candidate:
        problem = self.problem(geo)
        error = mean_log_error(problem, self.trade.light, geo, self.development, SAMPLES)
        return _Candidate(geo, start, weights, problem.rms_px(geo), error)

    def reweighed(self, candidate: _Candidate, weights: Weights) -> _Candidate:
        problem = self.problem(candidate.geo)
        x = by_spots(problem, problem.variables(candidate.geo), weights, REFINE)
        return self.candidate(owned(problem.lens(x)), weights, candidate.start)

    def descended(self, candidate: _Candidate, seed: int) -> _Candidate:
        problem = self.problem(candidate.geo)
        x = by_flow(
            problem,
            self.trade.light,
            problem.variables(candidate.geo),
            self.effort.steps,
            self.effort.batch,
            seed,
        )
        return self.candidate(owned(problem.lens(x)), candidate.weights, candidate.start)

    def searched(self, candidate: _Candidate) -> _Candidate:
        problem = self.problem(candidate.geo)
        start = problem.variables(candidate.geo)
        x = by_search(problem, self.trade.light, start, self.effort.tries, seed=0)
        return self.candidate(owned(problem.lens(x)), candidate.weights, "search")


def run_jobs(jobs, workers: int):
    """Results of (key, function, arguments) as they come, by key: yields (key, result or the error's sentence)."""
    with ProcessPoolExecutor(workers, get_context("spawn"), one_thread) as pool:
        waiting = {pool.submit(function, *arguments): key for key, function, arguments in jobs}
        for done in as_completed(waiting):
            error = done.exception()
            if error is not None and not isinstance(error, DomainError):
                pool.shutdown(cancel_futures=True)
                raise error
            yield waiting[done], str(error) if error else done.result()
