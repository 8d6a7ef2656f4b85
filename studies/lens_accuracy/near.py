"""The part of lens_accuracy about objects at finite distances: random lenses against the long-double lens."""

import math

from studies.lens_accuracy.draw import FARTHEST_M, NEAREST_M, draw
from studies.lens_accuracy.finite import compare

NEAR_ASKED = 1e-9


def near_objects(run):
    """Largest relative error by figure over the random lenses; recorded as metrics."""
    found = []
    with run.progress(run.config.systems, "near objects") as progress:
        for k in range(run.config.systems):
            found.append(compare(*draw(1000 * run.config.seed + k)))
            progress.advance()
    worst = {name: max((row[name] for row in found), key=_badness) for name in found[0]}
    run.record(
        finite_distance_systems=len(found),
        finite_distance_relative_error_max=max(worst.values(), key=_badness),
        **{f"finite_distance_relative_error_max_{name}": value for name, value in worst.items()},
    )
    return worst


def show_near_objects(run, worst):
    """Card and table."""
    largest = max(worst, key=lambda name: _badness(worst[name]))
    run.card(
        "Near objects",
        f"{worst[largest]:.1e}",
        f"relative, the largest ({largest.replace('_', ' ')}); asked: {NEAR_ASKED:g}",
    )
    run.section(
        "Finite distances",
        f"Random lenses of 2 to 7 surfaces (spheres, conics, aspheres, a plane; the stop on any of them) with objects at "
        f"{NEAREST_M:g} to {FARTHEST_M:g} m, fields to 0.2 rad, f/4 to f/10, against an independent trace in long "
        "double. An error is relative to the largest true value of its kind in the lens (MTFs: to 1). Point spread, "
        "MTF and wavefront are taken with the lens stopped down until 24 pupil cells resolve its wavefront.",
    )
    run.table(
        "Largest relative errors",
        ("figure", "error", "asked"),
        [(name.replace("_", " "), f"{value:.1e}", f"{NEAR_ASKED:g}") for name, value in worst.items()],
    )


def _badness(value):
    return math.inf if math.isnan(value) else value
