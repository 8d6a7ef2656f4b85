"""How strongly the blocks of a design pull at each other, and what designing them one after the
other would leave there:
second differences of the errors to be expected around one design."""

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import torch
from torch import Tensor

from studies.codesign.design import PARTS, Space
from studies.codesign.problem import Drawn
from studies.frame.run import Run
from studies.frame.show import tabulate
from studies.frame.sweep import Row, sweep

STEP = 0.12  # of the cube, to either side
FIRST = 5_500_000  # number of the first draw, beyond those of any race
NULLS = 200  # draws of noise
FLATTEST = 0.02  # of the largest curvature, below which none is taken


def curvatures(run: Run[Any], drawn: Drawn, at: Tensor, draws: int) -> list[Row]:
    """Rows of every draw and pair of numbers around shares [V], a STEP off the bounds: the mixed
    second difference of the mean expected error, and that error itself."""
    names = drawn.space.free

    def error(draw, *moves):
        share = at.clone()
        for place, step in moves:
            share[place] += step
        looked = drawn.looked(drawn.space.made(share), drawn.draw(FIRST + draw))
        return float(looked.expected.mean())

    def cell(draw):
        here = error(draw)
        rows = []
        for a in range(len(names)):
            ends = sum(error(draw, (a, step)) for step in (-STEP, STEP))
            rows.append(
                {"one": names[a], "other": names[a], "curvature": (ends - 2 * here) / STEP**2}
            )
        for a, b in combinations(range(len(names)), 2):
            mixed = sum(
                i * j * error(draw, (a, i * STEP), (b, j * STEP)) for i in (-1, 1) for j in (-1, 1)
            )
            rows.append({"one": names[a], "other": names[b], "curvature": mixed / (4 * STEP**2)})
        return [{**row, "error": here} for row in rows]

    return sweep(run, cell, "couplings", draw=range(draws))


def hessian(space: Space, rows: Sequence[Row]) -> tuple[Tensor, Tensor, float]:
    """Mean curvature [V, V] over the draws, its standard error [V, V], and the mean error there."""
    size, draws = len(space.free), len({row["draw"] for row in rows})
    found = torch.zeros(draws, size, size, dtype=torch.float64)
    for row in rows:
        a, b = space.free.index(row["one"]), space.free.index(row["other"])
        found[row["draw"], a, b] = found[row["draw"], b, a] = row["curvature"]
    spread = found.std(0) if draws > 1 else torch.zeros_like(found[0])
    return found.mean(0), spread / math.sqrt(draws), sum(row["error"] for row in rows) / len(rows)


def bowl(curvature: Tensor) -> Tensor | None:
    """The same [V, V] made positive definite; None where it bends upwards along nothing."""
    values, vectors = torch.linalg.eigh(curvature)
    if not float(values.max()) > 0:
        return None
    return vectors @ torch.diag(values.clamp_min(FLATTEST * float(values.max()))) @ vectors.mT


def by_noise(space: Space, curvature: Tensor, error: Tensor) -> dict[str, float]:
    """What couplings nineteen in twenty times are not above if there is none, by the standard
    errors [V, V] alone."""
    generator = torch.Generator().manual_seed(0)
    found: dict[str, list[float]] = {}
    for _ in range(NULLS):
        draw = torch.randn(curvature.shape, generator=generator, dtype=torch.float64).triu(1)
        null = bowl(torch.diag(curvature.diagonal()) + error * (draw + draw.mT))
        for name, value in (coupled(space, null) if null is not None else {}).items():
            found.setdefault(name, []).append(value)
    return {name: float(torch.tensor(values).quantile(0.95)) for name, values in found.items()}


def coupled(space: Space, curvature: Tensor) -> dict[str, float]:
    """Of every two parts the largest canonical coupling, 0 to 1: one pass over both leaves at most
    its square of the error above the bottom."""
    found = {}
    for one, other in combinations(PARTS, 2):
        a, b = space.part(one), space.part(other)
        if a and b:
            roots = [torch.linalg.cholesky(curvature[p][:, p]) for p in (a, b)]
            half = torch.linalg.solve_triangular(roots[0], curvature[a][:, b], upper=False)
            normal = torch.linalg.solve_triangular(roots[1], half.mT, upper=False)
            found[f"{one} and {other}"] = float(torch.linalg.svdvals(normal).max())
    return found


def left_by(
    space: Space,
    curvature: Tensor,
    error: float,
    at: Tensor,
    starts: Sequence[Tensor],
    order: Sequence[str],
) -> float:
    """Error of one pass over the parts in an order and, as in the race, over the read-out once
    more, each brought to its bottom, over that of the joint bottom: median over the starts, by the
    second-order model."""
    ratios = []
    for start in starts:
        away = start - at
        for part in (*order, "read-out"):
            mine = space.part(part)
            rest = [k for k in range(len(away)) if k not in mine]
            away[mine] = -torch.linalg.solve(
                curvature[mine][:, mine], curvature[mine][:, rest] @ away[rest]
            )
        ratios.append(1 + float(away @ curvature @ away) / 2 / error)
    return float(torch.tensor(ratios).quantile(0.5))


def show(
    run: Run[Any],
    space: Space,
    rows: Sequence[Row],
    at: Tensor,
    starts: Sequence[Tensor],
    measured: Mapping[str, float],
) -> None:
    """Couplings, and the orders' errors over the joint one as predicted and as ``measured``."""
    raw, spread, error = hessian(space, rows)
    curvature = bowl(raw)
    run.section(
        "How the parts pull at each other",
        f"Second differences of expected errors over {STEP} of the bounds around the joint answer of which least error is "
        "expected. A coupling of 0 means that parts can be designed by themselves; of 1, that neither knows its place "
        "without the other. By noise: what nineteen in twenty times is not passed where there is none.",
    )
    if curvature is None:
        run.text(
            "Errors bend upwards along nothing there: no valley, and nothing to be said of couplings."
        )
        return
    noise = by_noise(space, curvature, spread)
    lines = [
        {"parts": name, "coupling": value, "by_noise": noise.get(name)}
        for name, value in coupled(space, curvature).items()
    ]
    tabulate(run, "Canonical couplings", lines, "parts", prefix="parts")
    lines = []
    for arm, ratio in measured.items():
        order = arm.split(" > ")
        if len(order) == len(PARTS):
            predicted = left_by(space, curvature, error, at, starts, order)
            lines.append({"order": arm, "predicted": predicted, "measured": ratio})
    if lines:
        tabulate(
            run, "Error of an order over the joint one", lines, "order", prefix="order_over_joint"
        )
    steepness = curvature.diagonal().sqrt() / math.sqrt(2 * error)
    each = [
        {"number": name, "per_share": float(value)}
        for name, value in zip(space.free, steepness, strict=True)
    ]
    tabulate(run, "How steep the valley is along each number", each, "number", prefix="steepness")
