"""Is the slope that steers a design the slope of its errors? The objective's own against rendered
differences, of the errors it expects and of hard ones, over the same draws."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor

from studies.codesign.design import BLOCKS, Space
from studies.codesign.objective import STEP, Objective
from studies.codesign.problem import Drawn
from studies.frame.run import Run
from studies.frame.show import tabulate
from studies.frame.sweep import Row, sweep

FIRST = 5_000_000  # number of the first draw, beyond those of any race
LEARNT = 4  # draws from which a trend is learnt


@dataclass(frozen=True)
class Agreement:
    """Of a mean slope with a mean of differences over the same draws.

    cosine: between them, in the cube. length: of the slope over that of the differences. beyond:
    relative L2 distance that the standard errors of both do not explain. signal_to_noise: of the
    slope in one draw.
    """

    cosine: float
    length: float
    beyond: float
    signal_to_noise: float


def agreement(slopes: Tensor, differences: Tensor) -> Agreement:
    """Of slopes [draws, V] with differences [draws, V]."""
    ours, theirs = slopes.mean(0), differences.mean(0)
    noise = (slopes - differences).var(0).sum() / len(slopes)
    away = ((ours - theirs).square().sum() - noise).clamp_min(0).sqrt() / theirs.norm()
    scatter = slopes.var(0).sum().sqrt()
    return Agreement(
        float(ours @ theirs / (ours.norm() * theirs.norm())),
        float(ours.norm() / theirs.norm()),
        float(away),
        float(ours.norm() / scatter.clamp_min(1e-12)),
    )


def slopes(
    run: Run[Any], space: Space, drawn: Drawn, at: Mapping[str, Tensor], draws: int
) -> list[Row]:
    """Rows of every place, draw and number: the slope at shares [V], and the differences over a
    step to either side.

    The trend knows LEARNT draws before these.
    """
    free = range(len(space.free))

    @cache
    def objective(place):
        found = Objective(drawn, penalised=False)
        for draw in range(1, LEARNT + 1):
            found(at[place], drawn.draw(FIRST - draw), free)
        return found

    def of_slope(place, draw):
        objective(place).forget()
        looked_at = at[place], drawn.draw(FIRST + draw), free
        # a draw teaches the next nothing, so that a run goes on with the same numbers
        return {"slope": objective(place)(*looked_at, learn=False)[1].tolist()}

    def of_differences(place, draw, number):
        here = at[place]
        ends = here.repeat(2, 1)
        k = space.free.index(number)
        ends[:, k] = (here[k] + torch.tensor([-STEP, STEP], dtype=here.dtype)).clamp(0, 1)
        looked = [drawn.looked(space.made(share), drawn.draw(FIRST + draw)) for share in ends]
        width = float(ends[1, k] - ends[0, k])
        expected, hard = (
            [float(each.mean()) for each in of]
            for of in zip(*((e.expected, e.hard()) for e in looked), strict=True)
        )
        return {
            "expected": (expected[1] - expected[0]) / width,
            "hard": (hard[1] - hard[0]) / width,
        }

    found = sweep(run, of_slope, "slopes", place=list(at), draw=range(draws))
    known = {(row["place"], row["draw"]): row["slope"] for row in found}
    rows = sweep(
        run, of_differences, "differences", place=list(at), draw=range(draws), number=space.free
    )
    return [
        {**row, "slope": known[row["place"], row["draw"]][space.free.index(row["number"])]}
        for row in rows
    ]


def show(run: Run[Any], space: Space, rows: Sequence[Row]) -> None:
    """How the slopes agree, place by place, block by block and number by number."""
    draws = max(row["draw"] for row in rows) + 1
    lines, numbers = [], []
    for place in dict.fromkeys(row["place"] for row in rows):
        of = {
            kind: torch.tensor(
                [row[kind] for row in rows if row["place"] == place], dtype=torch.float64
            ).reshape(draws, -1)
            for kind in ("slope", "expected", "hard")
        }
        for name in ("all", *BLOCKS):
            places = list(range(len(space.free))) if name == "all" else space.block(name)
            for kind in ("expected", "hard") if places else ():
                found = agreement(of["slope"][:, places], of[kind][:, places])
                lines.append({"at": place, "block": name, "against": kind, **vars(found)})
        for k, name in enumerate(space.free):
            line: Row = {"at": place, "number": name}
            for kind, values in of.items():
                line |= {
                    kind: float(values[:, k].mean()),
                    f"{kind}_error": float(values[:, k].std()) / math.sqrt(draws),
                }
            numbers.append(line)
    run.section(
        "Is the slope right?",
        "At the first start and at the best joint answer (of a run without a race: the best design that was looked at), over "
        f"{draws} draws of fresh drives: the slope by geometry, trend and recorded frames against differences of rendered errors over {STEP} of the bounds to either side, on the same "
        "drives.",
    )
    tabulate(run, "Agreement", lines, "at", "block", "against", prefix="slope")
    tabulate(
        run, "Mean slopes, per share of the bounds", numbers, "at", "number", prefix="mean_slope"
    )
