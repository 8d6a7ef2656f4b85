"""Stage "chain": time and error of every level of every stage, and of the whole chain, before a
textured wall."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.fidelity import Fidelity, Task, levels_of, survey
from codesign.fidelity.levels import Levels, batch_of, system_of
from codesign.fidelity.search import cheapest as cheapest_combination
from codesign.fidelity.survey import change, outcome
from scenes import worlds
from studies.frame.bench import Timing, turns
from studies.frame.compare import median_ratio
from studies.frame.run import Run
from studies.frame.show import Panel, panels, tabulate
from studies.frame.sweep import select, sweep
from studies.speed_error import Config
from studies.speed_error.select import Case, once, triplet

WALL = Case(
    partial(worlds.smooth_plane, 0, finest_period_m=0.03, coarsest_period_m=0.3),
    partial(triplet, 50.0),
    0.15,
    ((0.0, -0.01, 2.0), (0.0, 0.0, 0.0)),
    (0.4, 0.25, 0.5, 0.0, 0.0, 0.0),
)
TOLERANCES_PX = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12, 0.08)  # of the whole chain
SHARES = (0.01, 0.1)  # of the flow, within which the cheapest chain is named
LEAST_PX = 1e-3  # what is drawn of a change that is 0
MADE = {"frames": "frames", "events": "volume"}  # at the junctions that stages start from


@dataclass(frozen=True)
class Measure:
    """Where a stage is timed and judged: what it makes, the junction that it starts from, what
    about it is judged, and how much of that is tolerated."""

    made: str
    begins_at: str
    off: Callable[[Any, Any], float]
    what: str
    tolerated: float


def off_frames(found: Tensor, finest: Tensor) -> float:
    """RMS difference over RMS contrast."""
    off = (found.double() - finest.double()).square().mean().sqrt()
    return float(off / finest.double().std())


def off_counts(found: Any, finest: Any) -> float:
    """Wrong counts of the pixels over the whole window, per true one."""
    counts, truth = (volume.counts.double().sum(2) for volume in (found, finest))
    return float((counts - truth).abs().sum() / truth.sum())


def off_flow(found: Any, finest: Any) -> float:
    """Root mean square change, px."""
    return change(found.flow_px[None], finest.flow_px[None])


IMAGE = Measure("frames", "", off_frames, "RMS difference of frames over contrast", 0.05)
EVENTS = Measure("volume", "frames", off_counts, "wrong counts per true one", 0.1)
FLOW = Measure("field", "events", off_flow, "RMS change of the flow, px", 0.3)
MEASURES = {
    "camera": IMAGE,
    "samples": replace(IMAGE, tolerated=0.01),
    "frames": replace(EVENTS, begins_at=""),
    "events": EVENTS,
    "bins": replace(FLOW, begins_at="frames"),
    "flow": FLOW,
}


def stage(run: Run[Config]) -> list[str]:
    """Every level of every stage, all else finest: its own processor time and its error where it
    ends. Then whole chains, those that are chosen for tolerances from coarse to fine: time and
    change of the flow against the finest chain. All times are medians of turns; ratios are medians
    of pairs with 95 % intervals, and a level is undecided against the quickest that is tolerated
    where that interval holds 1."""
    world, task = WALL.scene(), WALL.task(run.config.seed)
    levels = {
        name: found[:2] + found[-1:] if run.config.quick else found
        for name, found in levels_of(task).items()
    }
    cell = partial(of_stage, world, task, levels, rounds=run.config.repeats)
    rows = sweep(run, cell, "levels", stage=list(levels))
    for name, measure in MEASURES.items():
        found = select(rows, stage=name)
        caption = f"Error: {measure.what}; {measure.tolerated:g} is tolerated."
        tabulate(run, name.capitalize(), found, "stage", "level", caption=caption)
    chains = sweep(run, lambda: of_chains(world, task, levels, run.config), "whole_chains")
    tabulate(run, "Whole chains", chains, "levels", prefix="chain")
    lines = {"found": ("cpu_s", "change"), "forecast": ("forecast_s", "forecast")}
    series = {name: _front(chains, *columns) for name, columns in lines.items()}
    chart = Panel(series, "processor time of the chain, ms", "change of the flow, px", "xy")
    caption = "Whole chains that no other of them is both faster and nearer to the finest than."
    run.figure(panels(chart, width=7), "speed_error_chain", caption)
    return [headline(chains)]


def headline(chains: list[dict[str, Any]]) -> str:
    """One sentence: the cheapest whole chain within each of SHARES of the finest chain's flow, and
    how many times as fast as the finest it is. chains: rows of ``of_chains``, the finest last."""
    said = []
    for share in SHARES:
        found = min((row for row in chains if row["share"] <= share), key=lambda row: row["cpu_s"])
        which = f"is {found['faster']} times as fast as the finest ({found['levels']})"
        which = "is the finest itself" if found is chains[-1] else which
        said.append(f"within {100 * share:g} % of its flow the cheapest {which}")
    return f"Held against the finest chain, {'; '.join(said)}."


def _front(rows, seconds, change_px):
    """Milliseconds and changes of the rows that no quicker one equals."""
    front = []
    for row in sorted(rows, key=lambda row: row[seconds]):
        if not front or row[change_px] < front[-1][change_px]:
            front.append(row)
    return (
        [1e3 * row[seconds] for row in front],
        [max(row[change_px], LEAST_PX) for row in front],
    )


def of_stage(
    world: Any, task: Task, levels: Levels, stage: str, rounds: int
) -> list[dict[str, Any]]:
    measure = MEASURES[stage]
    finest = Fidelity.finest(levels)
    run = system_of(world, task, finest).begin(batch_of(task, finest))
    with torch.no_grad():
        given = {name: run[MADE[name]] for name in (measure.begins_at,) if name}

    @torch.no_grad()
    def work(level):
        tried = replace(finest, **{stage: level})
        return system_of(world, task, tried).begin(batch_of(task, tried), given)[measure.made]

    timed = turns({level: partial(work, level) for level in levels[stage]}, rounds)
    best = work(levels[stage][-1])
    errors = {level: measure.off(work(level), best) for level in timed}
    return verdicts(timed, errors, measure.tolerated)


def verdicts(
    timed: Mapping[Any, Timing], errors: Mapping[Any, float], tolerated: float
) -> list[dict[str, Any]]:
    """Rows of levels that were timed in turns: error, median time, its ratio to that of the
    quickest level that is tolerated (of the one of least error, where none is), and the verdict.

    Raises: DomainError when there is no level.
    """
    if not timed:
        raise DomainError("there is no level to choose from; give at least one.")
    enough = [level for level in timed if errors[level] <= tolerated]
    best = (
        min(enough, key=lambda level: timed[level].cpu)
        if enough
        else min(timed, key=lambda level: errors[level])
    )
    ratios = {level: median_ratio(timed[level].cpu_s, timed[best].cpu_s) for level in timed}
    alike = [level for level in enough if ratios[level].low <= 1 <= ratios[level].high]
    rows = []
    for level, timing in timed.items():
        verdict = "not tolerated" if level not in enough else "dearer"
        if level in alike:
            verdict = "cheapest" if alike == [best] else "undecided"
        found = {"cpu_ms": 1e3 * timing.cpu, "ratio": f"{ratios[level]:.2f}", "verdict": verdict}
        rows.append({"level": str(level), "error": errors[level], **found})
    return rows


def of_chains(world: Any, task: Task, levels: Levels, config: Config) -> list[dict[str, Any]]:
    """Rows of the combinations that are chosen for TOLERANCES_PX, and of the finest, timed in
    turns; forecasts of the survey beside what was found."""
    known = survey(world, task, levels, config.seed)
    finest = Fidelity.finest(known.levels)
    picks = [cheapest_combination(known, task, tolerance) for tolerance in TOLERANCES_PX]
    tried = [*(pick for pick in dict.fromkeys(picks) if pick != finest), finest]
    timed = turns({each: once(world, task, each) for each in tried}, config.repeats)
    reference = outcome(world, task, finest).judged
    changes = {each: change(outcome(world, task, each).judged, reference) for each in tried}
    return [
        {
            "levels": str(each),
            "change": changes[each],
            "share": changes[each] / change(reference, torch.zeros_like(reference)),
            "forecast": known.predicted(each),
            "cpu_s": timed[each].cpu,
            "forecast_s": known.cpu_s(each),
            "faster": f"{median_ratio(timed[finest].cpu_s, timed[each].cpu_s):.2f}",
        }
        for each in tried
    ]
