"""Certificate of the gradients along the chain: autograd against central differences with common random
numbers.

One row per junction and parameter group: lens rays and spots in float64, frames (textured room, no
silhouettes) with respect to lens and pose, event counts, flow, and the final loss with respect to three
curvatures and all six pose components, once with the smooth event layer and once with the straight-through
layer against differences of the hard loss.
"""

import sys
from dataclasses import dataclass
from typing import ClassVar

import torch

from codesign.errors import DomainError
from codesign.grad import worst
from codesign.report import chain_figures
from studies.frame.run import Run, StudyConfig, main
from studies.gradient_flow import cases as gradient_cases


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"hard_cases": 6}
    hard_cases: int = 32
    """Motions and textures averaged for the straight-through layer against the hard loss."""


def study(run: Run[Config]):
    if run.config.hard_cases < 1:
        raise DomainError(f"hard_cases = {run.config.hard_cases} must be at least 1.")
    cases = [
        *gradient_cases.smooth_cases(run.config.seed),
        *gradient_cases.hard_cases(run.config.seed, run.config.hard_cases),
    ]
    rows = []
    with run.progress(len(cases), "certifying") as bar:
        for label, required, certificate in cases:
            for row in certificate():
                rows.append((label, required, row))
                name = f"{label}_{row.name}".replace(",", "").replace(" ", "_")
                run.record(
                    **{
                        f"{name}_relative_error": row.relative_error,
                        f"{name}_cosine": row.cosine,
                        f"{name}_signed_bias": row.signed_bias,
                        f"{name}_noise_floor": row.noise_floor,
                    }
                )
            bar.advance(error=worst([r for n, _, r in rows if n == label])[0])
    passed = [_passes(required, row) for _, required, row in rows]
    run.record(rows_total=len(rows), rows_passed=sum(passed))
    run.card("Rows within their figure", f"{sum(passed)} of {len(rows)}")
    for label in ("final loss, smooth events", "final loss, hard events"):
        found = [row for n, _, row in rows if n == label]
        if found:
            run.card(
                label,
                f"cosine {min(r.cosine for r in found):.3f}",
                f"relative error {max(r.relative_error for r in found):.3g}",
            )
    run.section(
        "Certificate",
        "Relative error is |autograd − difference| / |difference| over the group; the noise floor is the "
        "disagreement of neighbouring step sizes, in the same unit.",
    )
    columns = [
        "junction",
        "parameters",
        "relative error",
        "cosine",
        "signed bias",
        "noise floor",
        "plateau step",
        "required",
        "met",
    ]
    run.table(
        "Autograd against differences",
        columns,
        [
            [
                label,
                row.name,
                row.relative_error,
                row.cosine,
                row.signed_bias,
                row.noise_floor,
                sorted(row.step_plateau)[len(row.step_plateau) // 2],
                _words(required),
                "yes" if ok else "NO",
            ]
            for (label, required, row), ok in zip(rows, passed, strict=True)
        ],
    )
    junctions = list(dict.fromkeys(label for label, _, _ in rows))
    groups = list(dict.fromkeys(row.name for *_, row in rows))
    matrix = torch.full((len(junctions), len(groups)), float("nan"))
    for label, _, row in rows:
        matrix[junctions.index(label), groups.index(row.name)] = row.relative_error
    run.figure(
        chain_figures.heat_map(matrix.numpy(), junctions, groups, "relative error"),
        "gradient_heat_map",
        "Relative error of autograd against differences, per junction and parameter group.",
    )
    run.section("Components", "What each row compared, number by number (per step unit).")
    for label, _, row in rows:
        run.table(
            f"{label}: {row.name}",
            ["component", "autograd", "difference"],
            [[k + 1, a, d] for k, (a, d) in enumerate(zip(row.autograd, row.difference, strict=True))],
        )
    run.finish(
        "Gradients along the chain",
        "Autograd against central differences with common random numbers, over a ladder of step sizes.",
    )
    for (label, required, row), ok in zip(rows, passed, strict=True):
        run.say(
            f"{'ok  ' if ok else 'MISS'} {label:28s} {row.name:12s} relative error {row.relative_error:.2e} "
            f" cosine {row.cosine:.4f}  bias {row.signed_bias:+.3f}  floor {row.noise_floor:.1e}  "
            f"({_words(required)})"
        )


def _passes(required, row):
    return (row.relative_error <= required.get("error", float("inf"))) and row.cosine >= required.get(
        "cosine", -1.0
    )


def _words(required):
    signs = {"error": "≤", "cosine": "≥"}
    return ", ".join(f"{name} {signs[name]} {value:g}" for name, value in required.items())


if __name__ == "__main__":
    sys.exit(main(study, Config))
