"""How strongly the blocks of a design pull at each other, and what the arms would leave there:
second differences of the errors to be expected around one design, and a race in the valley that
they make."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import torch
from torch import Tensor

from studies.codesign.arms import ARMS, Task, read_out
from studies.codesign.design import PARTS, Space
from studies.codesign.problem import Drawn
from studies.frame.run import Run
from studies.frame.show import tabulate
from studies.frame.sweep import Row

STEP = 0.12  # of the cube, to either side
FIRST = 5_500_000  # number of the first draw, beyond those of any race
NULLS = 200  # draws of noise
FLATTEST = 0.02  # of the largest curvature, below which none is taken
DESCENTS = [name for name in ARMS if " > " in name or name.split()[0] in ("alternating", "nested")]


def best_of(drawn: Drawn, rows: Sequence[Row]) -> Row:
    """The answer of which least error is expected on one fresh draw."""
    fresh = drawn.draw(FIRST - 1)
    return min(
        rows,
        key=lambda row: float(drawn.looked(drawn.space.made(share(row)), fresh).expected.mean()),
    )


def share(row: Row) -> Tensor:
    """Of an answer [V]."""
    return torch.tensor(row["share"], dtype=torch.float64)


def curvatures(drawn: Drawn, at: Tensor, draw: int) -> list[Row]:
    """Rows of every pair of numbers around shares [V], a STEP off the bounds, on one draw: the
    mixed second difference of the mean expected error, and that error itself."""
    names = drawn.space.free
    samples = drawn.draw(FIRST + draw)

    def error(*moves):
        share = at.clone()
        for place, step in moves:
            share[place] += step
        return float(drawn.looked(drawn.space.made(share), samples).expected.mean())

    here = error()
    rows = []
    for a in range(len(names)):
        ends = sum(error((a, step)) for step in (-STEP, STEP))
        rows.append({"one": names[a], "other": names[a], "curvature": (ends - 2 * here) / STEP**2})
    for a, b in combinations(range(len(names)), 2):
        mixed = sum(i * j * error((a, i * STEP), (b, j * STEP)) for i in (-1, 1) for j in (-1, 1))
        rows.append({"one": names[a], "other": names[b], "curvature": mixed / (4 * STEP**2)})
    return [{**row, "error": here} for row in rows]


@dataclass(frozen=True)
class Valley:
    """The second-order model of the errors around a design, which arms descend as they do the true
    ones; every slope is exact there and every draw the same.

    curvature: [V, V], positive definite. bottom: [V] shares, and the error there. Errors stay below
    1, as true ones do.
    """

    space: Space
    curvature: Tensor
    bottom: Tensor
    error: float

    @property
    def drawn(self) -> "Valley":
        """Itself, whose draws are their numbers."""
        return self

    def draw(self, number: int) -> int:
        """That draw."""
        return number

    def over(self, share: Tensor) -> float:
        """Error at shares [V]."""
        away = share - self.bottom
        height = float(away @ self.curvature @ away) / 2
        room = 1 - self.error
        return self.error + height * room / (height + room)

    def __call__(
        self, share: Tensor, samples: int, free: Sequence[int]
    ) -> tuple[float, Tensor, None]:
        """Error, its slope [V] along the free numbers (its direction; arms take no more of it)."""
        slope = torch.zeros_like(share)
        slope[list(free)] = (self.curvature @ (share - self.bottom))[list(free)]
        return self.over(share), slope, None

    def look(self, share: Tensor, draw: int) -> tuple[float, None]:
        """Error at shares [V]."""
        return self.over(share), None

    def settled(self, share: Tensor, recorded: Any = None, tries: int = 0) -> Tensor:
        """Shares [V] with the read-out at its bottom."""
        return self.lowest(share, "read-out")

    def lowest(self, share: Tensor, part: str) -> Tensor:
        """Shares [V] with a part at its bottom, the others as they are; within the bounds."""
        mine = self.space.part(part)
        rest = [k for k in range(len(share)) if k not in mine]
        away = share - self.bottom
        found = share.clone()
        pulled = self.curvature[mine][:, rest] @ away[rest]
        found[mine] = self.bottom[mine] - torch.linalg.solve(self.curvature[mine][:, mine], pulled)
        return found.clamp(0, 1)

    def one_pass(self, start: Tensor, order: Sequence[str]) -> float:
        """Error where parts are brought to their bottoms in an order, and the read-out once
        more."""
        share = start
        for part in (*order, "read-out"):
            share = self.lowest(share, part)
        return self.over(share)

    def raced(self, start: Tensor, arm: str, steps: int) -> float:
        """Error of an arm's answer here."""
        task = Task(self, start, steps, 0, 0)
        answer, way = ARMS[arm](task)
        return self.over(read_out(task, answer, way))


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


def foretold(valley: Valley, starts: Sequence[Tensor], steps: int, arm: str) -> dict[str, float]:
    """Error of an arm over that of the joint one, median over the starts: ``at_budget`` after so
    many steps, and for an order ``at_the_bottom``, where every part is brought to its own."""
    joint = [valley.raced(start, "joint", steps) for start in starts]
    mine = [valley.raced(start, arm, steps) for start in starts]
    found = {"at_budget": _median(a / b for a, b in zip(mine, joint, strict=True))}
    order = arm.split(" > ")
    if len(order) == len(PARTS):
        bottoms = (valley.one_pass(start, order) for start in starts)
        found["at_the_bottom"] = _median(error / valley.error for error in bottoms)
    return found


def _median(values):
    return float(torch.tensor(list(values), dtype=torch.float64).quantile(0.5))


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
    valley = Valley(space, curvature, at, error)
    lines = [
        {"arm": arm, **foretold(valley, starts, run.config.steps, arm), "measured": ratio}
        for arm, ratio in measured.items()
        if arm in DESCENTS
    ]
    if lines:
        run.text(
            "The same arms raced in the valley that these differences make, from the same starts and with exact slopes: after "
            "as many steps as here, and with every part brought to its bottom."
        )
        tabulate(run, "Error of an arm over the joint one", lines, "arm", prefix="arm_over_joint")
    steepness = curvature.diagonal().sqrt() / math.sqrt(2 * error)
    each = [
        {"number": name, "per_share": float(value)}
        for name, value in zip(space.free, steepness, strict=True)
    ]
    tabulate(run, "How steep the valley is along each number", each, "number", prefix="steepness")
