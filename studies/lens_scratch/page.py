"""The page of studies.lens_scratch: cards, layouts, spots over seeds, loss over steps, and the limits of the
designs."""

import math

import matplotlib.pyplot as plt
from matplotlib.ticker import FixedLocator, NullLocator

from codesign.lens.design.constraints import active
from codesign.report import lens_figures
from studies.lens_scratch.search import METHODS
from studies.lens_scratch.task import JUDGED_FIELDS, LIMITS, SPARE_MM

COLOURS = {"curriculum": "#1b6ca8", "direct": "#2e8b57", "adam": "#c0392b"}
TIGHT = 0.2  # share of a limit's scale within which it is said to bind
SAME = 0.02  # designs whose curvatures differ by less than this share of the largest count as one


def show(run, published, yardstick, goal_um, outcomes, verdicts):
    """Write the page. yardstick: spots (um) of the published lens by spectrum; verdicts: one or None per
    outcome."""
    metrics = run.metrics
    methods = list(dict.fromkeys(o.method for o in outcomes))
    for method in methods:
        low = metrics[f"{method}_success_low"]
        high = metrics[f"{method}_success_high"]
        run.card(
            method.capitalize(),
            f"{metrics[f'{method}_seeds_succeeded']} of {metrics[f'{method}_seeds']} seeds",
            f"{METHODS[method]}; 95 % interval {low:.0%} to {high:.0%}",
        )
    run.card(
        "Published lens",
        f"{metrics['published_mean_spot_um']:.2f} µm",
        f"mean RMS spot in F, d, C; the goal is {goal_um:.2f} µm",
    )
    first = [(o, v) for o, v in zip(outcomes, verdicts, strict=True) if o.method == methods[0]]
    run.section(
        "Designs",
        f"Method: {methods[0]}. {distinct(first)} different designs came out (curvatures within {SAME:.0%} "
        "count as one).",
    )
    run.figure(
        layouts(published, first),
        "layouts",
        "The published lens and the final design of every seed, with the rays of fields 0, 0.7 and 1.",
    )
    run.figure(
        spot_figure(outcomes, verdicts, metrics["published_mean_spot_um"], goal_um),
        "spots",
        "Mean RMS spot in F, d, C of every seed. A mark at the top edge lies beyond it.",
    )
    run.section("Way")
    run.figure(
        loss_figure(outcomes),
        "losses",
        "Half the sum of squared residuals (units of 0.01 mm RMS) before every step of the last attempt. "
        "In the curriculum it jumps where a stage with a larger aperture and field begins.",
    )
    columns = [
        "method",
        "seed",
        "success",
        "attempts",
        "steps",
        "evaluations",
        "seconds",
        "mean F, d, C (µm)",
        "field 0",
        "0.7",
        "1",
        "mean d (µm)",
        "rays",
        "limits that bind or fail",
    ]
    rows = [
        [
            "published",
            None,
            None,
            None,
            None,
            None,
            None,
            *_spots(yardstick["F, d, C"]),
            round(sum(yardstick["d"]) / 3, 2),
            "all pass",
            None,
        ]
    ]
    for o, v in zip(outcomes, verdicts, strict=True):
        figures = (
            [None] * 6
            if v is None
            else [
                *_spots(v.spots_um),
                round(sum(v.spots_d_um) / 3, 2),
                "all pass" if v.rays_pass else "some fail",
            ]
        )
        tight = (
            None
            if v is None
            else "; ".join(f"{c.name} ({c.state(TIGHT)})" for c in active(v.limits, TIGHT)) or "none"
        )
        rows.append(
            [
                o.method,
                o.seed,
                "yes" if o.succeeded else "no",
                o.attempts,
                o.steps,
                o.evaluations,
                round(o.seconds, 1),
                *figures,
                tight,
            ]
        )
    run.table(
        "Seeds",
        columns,
        rows,
        f"A limit binds within {TIGHT * LIMITS.scale_mm:g} mm: the optimiser aims {SPARE_MM} mm inside it.",
    )
    held = "; ".join(
        f"{name} {value:g}"
        for name, value in vars(LIMITS).items()
        if isinstance(value, float) and not name.startswith("scale")
    )
    run.text(
        f"Limits: {held}; incidence at most 60 degrees; every ray of the full field and pupil passes. "
        "Semi-apertures are those of the rays plus 5 %."
    )
    run.finish(
        "A lens from plane plates",
        "Three glasses in a given order, a stop, a focal length and limits; no start design, no drawing "
        "from known lenses.",
    )


def distinct(found):
    """Number of different designs among those that succeeded."""
    kinds = []
    for outcome, verdict in found:
        if outcome.succeeded:
            curvature = verdict.geo.curvature_per_mm.detach()
            if all(float((curvature - other).abs().max() / other.abs().max()) > SAME for other in kinds):
                kinds.append(curvature)
    return len(kinds)


def layouts(published, found):
    """Small layouts, the published lens first."""
    shown = [("published", published)] + [
        (f"seed {o.seed}{'' if o.succeeded else ' (no success)'}: {v.mean_um:.1f} µm", v.geo)
        for o, v in found
        if v is not None and v.rays_pass
    ]
    figure, axes = plt.subplots(
        math.ceil(len(shown) / 3),
        3,
        figsize=(13, 2.6 * math.ceil(len(shown) / 3)),
        squeeze=False,
        layout="constrained",
    )
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, (title, geo) in zip(axes.flat, shown, strict=False):
        lens_figures.draw_layout(axis, geo, JUDGED_FIELDS, rays=3)
        axis.set_title(title, loc="left", fontsize=9)
        if axis is not axes.flat[0] and (legend := axis.get_legend()):
            legend.remove()  # one is enough
    return figure


def spot_figure(outcomes, verdicts, published_um, goal_um):
    figure, axis = plt.subplots(figsize=(8, 3.4), layout="constrained")
    methods = list(dict.fromkeys(o.method for o in outcomes))
    top = 4 * goal_um
    for shift, method in enumerate(methods):
        found = [
            (o.seed, min(v.mean_um, top) if v is not None else top, o.succeeded)
            for o, v in zip(outcomes, verdicts, strict=True)
            if o.method == method
        ]
        for done, face in ((True, COLOURS[method]), (False, "white")):
            at = [(s + 0.2 * (shift - (len(methods) - 1) / 2), y) for s, y, ok in found if ok == done]
            if at:
                axis.plot(
                    *zip(*at, strict=True),
                    "o",
                    color=COLOURS[method],
                    markerfacecolor=face,
                    label=method + ("" if done else ", no success"),
                )
    axis.axhline(published_um, color="k", linewidth=1, label="published")
    axis.axhline(goal_um, color="k", linewidth=1, linestyle=":", label="goal: twice that")
    axis.set(xlabel="seed", ylabel="mean RMS spot (µm)", yscale="log", ylim=(0.6 * published_um, 1.1 * top))
    axis.yaxis.set_major_locator(FixedLocator([10, 15, 20, 30, 40, 60, 80]))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_locator(NullLocator())
    axis.legend(frameon=False, fontsize=8, ncols=3)
    return figure


def loss_figure(outcomes):
    methods = list(dict.fromkeys(o.method for o in outcomes))
    figure, axes = plt.subplots(
        1, len(methods), figsize=(4 * len(methods), 3.2), sharey=True, squeeze=False, layout="constrained"
    )
    for axis, method in zip(axes[0], methods, strict=True):
        for o in outcomes:
            if o.method == method:
                axis.plot(o.losses, color=COLOURS[method], linewidth=0.9, alpha=0.7)
        axis.set(title=method, xlabel="step", yscale="log")
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("loss")
    return figure


def _spots(spots):
    return [round(sum(spots) / len(spots), 2), *(round(s, 2) for s in spots)]
