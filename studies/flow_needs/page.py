"""Tables, figure and page of the study: the specification sheet of a lens for event flow."""

import math

import matplotlib.pyplot as plt
import numpy as np

from studies.flow_needs.conditions import BASE, BASE_VIEW, FAULTS, condition
from studies.flow_needs.results import RISES, TRIPLET, Results, Row
from studies.frame.run import Run

DPI = 66  # of the figure that is committed
BASE_NAME = condition(BASE_VIEW, BASE)
PANELS = {  # title -> fault, way it is judged, conditions
    "blur, by texture": ("blur", "", (BASE_NAME, "fine", "coarse", "rooms")),
    "blur, by sensor and light": ("blur", "", (BASE_NAME, "theta 0.1", "theta 0.4", "no noise", "dim light")),
    "blur, by speed": ("blur", "", ("0.5 px", BASE_NAME, "4 px")),
    "barrel distortion, ignored": ("barrel", "ignored", (BASE_NAME, "theta 0.4", "dim light", "4 px")),
    "falloff": ("falloff", "", (BASE_NAME, "theta 0.4", "dim light", "fine")),
    "lateral colour": ("lateral colour", "", (BASE_NAME, "theta 0.4", "dim light", "fine")),
}


def write(run: Run, results: Results, estimators: list[str]) -> None:
    """Record every figure and write the page."""
    rows = results.rows(estimators)
    first = estimators[0]
    for row in rows:
        _record(run, row)
    base = next(row for row in rows if row.condition == BASE_NAME and row.fault.name == "blur")
    told = {estimator: results.predictors(estimator) for estimator in estimators}
    for estimator, ranked in told.items():
        for name, residual, _ in ranked:
            run.record(**{f"left_out_residual_{_flat(name)}_{_flat(estimator)}": residual})
    run.card(
        "Blur that costs 10 %",
        f"{base.limits[0].text(base.curve.levels[-1])} px",
        f"RMS radius; {BASE_NAME}, {first}, without blur {base.error_px:.2f} px of error",
    )
    run.card(
        "Told best by",
        told[first][0][0],
        f"left-out lenses within {100 * math.expm1(told[first][0][1]):.0f} %",
    )
    run.section(
        "Specification sheet",
        "Size of a fault at which the flow error has grown by 10 and by 25 %: geometric mean over cases, each against "
        "itself without the fault. Intervals: 95 %, bootstrap over cases. One fault at a time.",
    )
    run.figure(
        figure(results, rows, first),
        "flow_needs",
        "Error over that without the fault. Dashed: +10 and +25 %.",
        DPI,
    )
    for fault in FAULTS:
        lines = [_cells(row) for row in rows if row.fault == fault]
        columns = [
            "condition",
            "estimator",
            "judged",
            "error without, px",
            "events per pixel",
            "+10 %",
            "+25 %",
        ]
        run.table(f"{fault.name}, {fault.scale}", columns, lines)
    run.section("Curves", "Error over that without the fault, and the 95 % interval.")
    for fault in FAULTS:
        lines = [
            _curve_cells(row, run.config.seed)
            for row in rows
            if row.fault == fault and row.estimator == first
        ]
        levels = next(row.curve.levels for row in rows if row.fault == fault)
        run.table(f"{fault.name}, {fault.scale}", ["condition", "judged", *(f"{x:g}" for x in levels)], lines)
    run.text(helped(rows, run.config.seed))
    run.section(
        "Which number tells the error",
        "RMS residual of families of lenses (disc, Gaussian, flare; a triplet with defocus, spherical aberration, "
        "coma, astigmatism, errors of assembly) from a rising rule fitted to the other families.",
    )
    for estimator, ranked in told.items():
        run.table(
            estimator,
            ["number", "residual, %", "its value at +10 %"],
            [[n, 100 * math.expm1(r), None if math.isinf(at) else at] for n, r, at in ranked],
            "1 - MTF grows with blur: 0.2 is an MTF of 0.8. The pixel's own box is in none of them.",
        )
    best = told[first][0][0]
    run.table(
        "Lenses",
        ["lens", "RMS, px", best, *estimators],
        [
            [
                unit.split(" / ")[0],
                results.numbers[unit]["RMS radius, px"],
                results.numbers[unit][best],
                *(math.exp(results.log_rise(unit, estimator)) for estimator in estimators),
            ]
            for unit in results.lenses()
        ],
        "Error over that of the ideal lens.",
    )
    run.finish(
        "What event flow needs of a lens",
        f"At threshold 0.2, photographs 2 m away and 2 px of motion, {base.limits[0].text(base.curve.levels[-1])} px of "
        f"RMS blur raise the flow error of the {first} by 10 %.",
    )


def helped(rows: list[Row], seed: int) -> str:
    """Where a fault lowers the error: steps whose 95 % interval lies below 1, in a sentence."""
    found = []
    tried = 0
    for row in rows:
        tried += len(row.curve.levels) - 1
        high = row.curve.ratio_interval(seed)[1]
        steps = [f"{x:g}" for x, top in zip(row.curve.levels[1:], high[1:], strict=True) if top < 1]
        if steps:
            found.append(
                f"- {' '.join(f'{row.fault.name} {row.way}'.split())}, {row.condition}, {row.estimator}: {', '.join(steps)}"
            )
    chance = f"Of {tried} steps about {0.025 * tried:.0f} would by chance alone."
    if not found:
        return f"No step of any fault has an interval below 1. {chance}"
    return "\n".join([f"Steps whose interval lies below 1. {chance}\n", *found])


def _record(run, row):
    for rise, limit in zip(RISES, row.limits, strict=True):
        last = row.curve.levels[-1]
        name = f"{row.label}_at_plus_{100 * rise:.0f}_percent"
        for end in ("value", "low", "high"):
            at = getattr(limit, end)
            suffix = "" if end == "value" else f"_{end}"
            run.record(**{f"{name}{suffix}{'_is_beyond' if math.isinf(at) else ''}": min(at, last)})
    run.record(**{f"{row.label}_error_without_px": row.error_px})
    run.record(
        **{
            f"{row.label}_ratio_at_{x:g}": r
            for x, r in zip(row.curve.levels, row.curve.ratio, strict=True)
            if x
        }
    )


def _flat(name):
    return "_".join("".join(c if c.isalnum() or c == "." else " " for c in name).split())


def _cells(row: Row):
    limits = [limit.text(row.curve.levels[-1]) for limit in row.limits]
    return [
        row.condition,
        row.estimator,
        row.way,
        f"{row.error_px:.2f}",
        f"{row.events_per_pixel:.2f}",
        *limits,
    ]


def _curve_cells(row: Row, seed):
    low, high = row.curve.ratio_interval(seed)
    cells = [
        f"{r:.2f} ({a:.2f} to {b:.2f})"
        for r, a, b in zip(row.curve.ratio[1:], low[1:], high[1:], strict=True)
    ]
    return [row.condition, row.way, "1", *cells]


def figure(results: Results, rows: list[Row], estimator: str):
    """Figure of the curves by condition, and of the errors of all lenses over their RMS radius and over the number that
    tells them best."""
    drawn, axes = plt.subplots(2, 4, figsize=(15.5, 6.6), layout="constrained")
    curves = [*axes[0, :3], *axes[1, :3]]
    for axis, (title, (fault, way, conditions)) in zip(curves, PANELS.items(), strict=True):
        for row in rows:
            if (row.fault.name, row.way, row.estimator) == (
                fault,
                way,
                estimator,
            ) and row.condition in conditions:
                low, high = row.curve.ratio_interval(results.seed)
                (line,) = axis.plot(
                    row.curve.levels, row.curve.ratio, "o-", markersize=3, label=row.condition
                )
                axis.fill_between(
                    row.curve.levels, low, high, color=line.get_color(), alpha=0.15, linewidth=0
                )
        scale = next(f.scale for f in FAULTS if f.name == fault)
        axis.set(title=title, xlabel=scale, yscale="log")
        axis.legend(fontsize=7, loc="upper left")
    best = results.predictors(estimator)[0][0]
    family = results.lenses()
    for axis, name in zip(axes[:, 3], ("RMS radius, px", best), strict=True):
        for kind in dict.fromkeys(family.values()):
            units = [unit for unit in family if family[unit] == kind]
            at = [results.numbers[unit][name] for unit in units]
            ratios = np.exp([results.log_rise(unit, estimator) for unit in units])
            axis.plot(at, ratios, "x" if units[0].startswith(TRIPLET) else ".", label=kind)
        axis.set(
            title="all lenses, theta 0.2", xlabel=name if "MTF" not in name else f"1 - {name}", yscale="log"
        )
    axes[0, 3].legend(fontsize=7)
    for axis in axes.reshape(-1):
        for rise in RISES:
            axis.axhline(1 + rise, color="0.6", linewidth=0.8, linestyle="--")
        axis.axhline(1, color="0.6", linewidth=0.8)
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("{x:g}")
        axis.tick_params(labelsize=7, which="both")
    axes[0, 0].set_ylabel("error over that without")
    axes[1, 0].set_ylabel("error over that without")
    return drawn
