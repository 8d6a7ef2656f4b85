"""Where does designing lens, mount, sensor and estimator in one descent beat one after the other?

Cells of light, f-number and speed are raced each by itself (studies.codesign): joint, and the
orders of lens and mount before the read-out. Beside the measured ratio of a cell stands what the
same arms leave in the valley that second differences around its best joint answer make: what the
couplings alone would let expect.
"""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from statistics import fmean
from typing import Any, ClassVar

import matplotlib.pyplot as plt
import torch
from matplotlib.figure import Figure
from scipy.stats import rankdata
from torch import Tensor

from studies.codesign import couplings
from studies.codesign.cells import CellsConfig, answers, pulls_of, setting, space_of
from studies.codesign.landscape import ranked
from studies.codesign.page import best_order
from studies.codesign.race import ENOUGH, compared, start
from studies.frame.compare import Interval, bootstrap
from studies.frame.run import Run, main
from studies.frame.show import tabulate
from studies.frame.sweep import Row, column, select, typical

ORDERS = ("lens > mount > read-out", "mount > lens > read-out")
CELLS = 6  # below which nothing is said of the prediction


@dataclass(frozen=True)
class Config(CellsConfig):
    QUICK: ClassVar = {**CellsConfig.QUICK, "lights": (1.0,), "fnos": (4.0,), "couplings": 0}
    lights: tuple[float, ...] = (1.0, 0.1)
    """Shares of daylight."""
    fnos: tuple[float, ...] = (0.0, 2.0, 8.0)
    """f-numbers at which the lens is held; 0: it is designed."""
    speeds: tuple[float, ...] = (1.0, 0.3)
    """Shares of the drives' speed."""
    couplings: int = 1
    """Draws of twelve drives by which second differences are measured in each cell; 0: none."""


def study(run: Run[Config]) -> None:
    config = run.config
    cells = {
        f"light {light:g}, {f'f/{fno:g}' if fno else 'f free'}, speed {speed:g}": setting(
            config, light, speed, {"fno": fno} if fno else {}
        )
        for speed, light, fno in product(config.speeds, config.lights, config.fnos)
    }
    rows = answers(run, cells, ("joint", *ORDERS))
    pulls = pulls_of(run, cells, rows, config.couplings) if config.couplings else []
    lines, ratios = [], {}
    for cell, given in cells.items():
        mine = select(rows, regime=cell)
        order = best_order(mine)
        over = compared(mine)[order][0].ratio()
        ratios[cell] = over
        line = {
            "cell": cell,
            "best order": order,
            "joint": typical(mine, arm="joint"),
            "order": typical(mine, arm=order),
            **{name: getattr(over, name) for name in ("value", "low", "high")},
            "rank": ranked(column(mine, "expected"), [fmean(row["errors"]) for row in mine]),
        }
        if pulls:
            line |= _foretold(config, given, select(pulls, regime=cell), order)
        lines.append(line)
    run.section(
        "Cells",
        "Medians over starts of errors in unseen worlds; the joint error over that of the better order, with 95 % of "
        "resampled starts and worlds. Foretold: the same in the valley of second differences, at this budget and at the "
        "bottom. Rank: of the error expected at an arm's last step against its answer's hard one (Spearman). Expected errors are "
        "calibrated outdoors.",
    )
    titles = {
        "cell": "cell",
        "best order": "better order",
        "joint": "joint",
        "order": "order",
        "value": "joint over order",
        "low": "low",
        "high": "high",
        "at_budget": "foretold",
        "at_the_bottom": "at the bottom",
        "rank": "rank",
    }
    tabulate(run, "Joint over the better order", lines, "cell", prefix="cell", **titles)
    foretold = {line["cell"]: line["at_budget"] for line in lines if line.get("at_budget")}
    run.figure(
        drawn(ratios, foretold),
        "map",
        "Joint error over that of the better order in each cell (dots, 95 %), and what its couplings let expect (crosses).",
    )
    run.finish("A map of joint design", _answer(run, ratios, foretold))


def _foretold(config: Config, given: Mapping[str, Any], pulls: Sequence[Row], order: str) -> Row:
    """Joint error over that of an order in the valley, as the measured ratio is; nothing where
    there is no valley."""
    space = space_of(given)
    raw, _, error = couplings.hessian(space, pulls)
    curvature = couplings.bowl(raw)
    if curvature is None:
        return {}
    at = torch.tensor(pulls[0]["at"], dtype=torch.float64)
    valley = couplings.Valley(space, curvature, at, error)
    starts = [start(space, seed) for seed in range(config.seed, config.seed + config.seeds)]
    told = couplings.foretold(valley, starts, config.steps, order)
    return {name: 1 / value for name, value in told.items()}


def _answer(run: Run[Config], ratios: Mapping[str, Interval], foretold: Mapping[str, float]) -> str:
    """The map in one sentence, and the rank of what was foretold."""
    won = sum(over.high < 1 for over in ratios.values())
    lost = sum(over.low > 1 for over in ratios.values())
    run.record(cells=len(ratios), cells_won=won, cells_lost=lost)
    said = (
        f"Of {len(ratios)} cells one joint descent beats the better order of single blocks in {won}, loses in {lost}, and is "
        f"undecided in {len(ratios) - won - lost}."
    )
    if len(ratios) < CELLS or run.config.quick or run.config.seeds < ENOUGH:
        return f"{said} So few cells or starts decide nothing."
    if len(foretold) < CELLS:
        return f"{said} Couplings foretell {len(foretold)} of them, too few to rank."

    def rank(measured: Tensor, told: Tensor) -> Tensor:
        # equal values share their mean rank
        one, other = (torch.from_numpy(rankdata(each, axis=-1)) for each in (measured, told))
        one, other = (each - each.mean(-1, keepdim=True) for each in (one, other))
        # equal values alone rank nothing
        size = one.norm(dim=-1) * other.norm(dim=-1)
        return torch.where(size > 0, (one * other).sum(-1) / size.clamp_min(1e-300), 0.0)

    measured = [ratios[cell].value for cell in foretold]
    found: Interval = bootstrap(rank, measured, list(foretold.values()))
    run.record(**found.metrics("rank_of_foretold"), cells_foretold=len(foretold))
    return (
        f"{said} What couplings foretold ranks {len(foretold)} of them by {found:.2f} (Spearman)."
    )


def drawn(ratios: Mapping[str, Interval], foretold: Mapping[str, float]) -> Figure:
    """Dots with whiskers for the ratio of each cell, crosses for ratios that were foretold."""
    figure, axis = plt.subplots(figsize=(7, 1 + 0.35 * len(ratios)), layout="constrained")
    for at, over in enumerate(ratios.values()):
        axis.plot([over.low, over.high], [at, at], color="#1b6ca8")
        axis.plot(over.value, at, "o", color="#1b6ca8")
    places = [list(ratios).index(cell) for cell in foretold]
    axis.plot(list(foretold.values()), places, "x", color="#c44e17")
    axis.axvline(1, color="0.5", linewidth=1)
    axis.set_yticks(range(len(ratios)), list(ratios), fontsize=8)
    axis.set(xlabel="joint / better order", xscale="log")
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_formatter("{x:g}")
    axis.set_ylim(len(ratios) - 0.4, -0.6)
    return figure


if __name__ == "__main__":
    sys.exit(main(study, Config))
