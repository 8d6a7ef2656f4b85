"""The page of velocity heads."""

from typing import Any

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from studies.frame.run import Run
from studies.velocity_head.compare import ARMS, Errors

NAMES = {
    "plain": "least squares",
    "hidden": "shared, design hidden",
    "shared": "shared",
    "alone": "for this design alone",
    "trained on": "shared, trained on",
}
COLOURS = {
    "plain": "0.6",
    "hidden": "#c58b00",
    "shared": "#1b6ca8",
    "alone": "firebrick",
    "trained on": "#5a9e4b",
}


def show(run: Run[Any], errors: Errors, calibration: dict[str, float], weights: int) -> None:
    """Cards, tables and figure of a finished run."""
    metrics = run.metrics
    rows = errors.rows
    run.card(
        "shared over own, median", f"{metrics['shared_over_own_median']:.3f}", "the better of two own heads"
    )
    run.card(
        "worst of the designs", f"{metrics['shared_over_own_worst']:.3f}", f"{len(rows)} held-out designs"
    )
    run.card("shared over least squares", f"{metrics['shared_over_plain_median']:.3f}", "median")
    run.card("weights", f"{weights:,}", "of one head for all pairs")
    run.section("On held-out designs, in unseen worlds", "Typical errors, by the hard sensor.")
    run.table(
        "Errors",
        (
            "pair",
            "focal length, mm",
            "height, m",
            "pitch, rad",
            *(NAMES[arm] for arm in ARMS),
            "shared over own",
        ),
        [
            (
                r.pair,
                r.design.efl_mm,
                r.design.z_m,
                r.design.pitch_rad,
                *(r.typical[a] for a in ARMS),
                float(ratio),
            )
            for r, ratio in zip(rows, errors.ratios("own"), strict=True)
        ],
        "Own: the better of a fresh head and of the shared one trained on, both on samples of that design alone.",
    )
    overs = ("own", "alone", "trained_on", "hidden", "plain")
    run.table(
        "Ratios of the shared head's error",
        ("over", "median", "5 %", "95 %", "best", "worst", "designs at most 1.1"),
        [
            (
                over.replace("_", " "),
                *(
                    metrics[f"shared_over_{over}_{what}"]
                    for what in ("median", "low90", "high90", "best", "worst")
                ),
                metrics[f"shared_over_{over}_within_1_1"],
            )
            for over in overs
        ],
        "5 and 95 %: medians over resampled designs and worlds.",
    )
    run.figure(_figure(errors), "errors", "Typical error of each held-out design by who reads its velocity.")
    run.text(
        f"Errors within the ellipsoid that should hold 90 %: {calibration['shared_within_90_share']:.0%} with the head, "
        f"{calibration['plain_within_90_share']:.0%} with least squares."
    )
    run.finish(
        "One velocity head for all designs",
        f"On {len(rows)} held-out designs the shared head's error is {metrics['shared_over_own_median']:.2f} "
        f"({metrics['shared_over_own_low90']:.2f} to {metrics['shared_over_own_high90']:.2f}) of that of the design's own "
        f"head, at worst {metrics['shared_over_own_worst']:.2f}; of plain least squares' "
        f"{metrics['shared_over_plain_median']:.2f}.",
    )


def _figure(errors: Errors) -> Figure:
    figure, axis = plt.subplots(figsize=(10, 3.6), layout="constrained")
    for place, arm in enumerate(ARMS):
        at = [index + 0.16 * (place - 2) for index in range(len(errors.rows))]
        axis.bar(at, [row.typical[arm] for row in errors.rows], 0.15, color=COLOURS[arm], label=NAMES[arm])
    axis.set_xticks(range(len(errors.rows)), [row.pair for row in errors.rows], rotation=30, ha="right")
    axis.set_ylabel("typical error")
    axis.legend(ncols=len(ARMS), fontsize=8, frameon=False)
    return figure
