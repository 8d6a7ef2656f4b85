"""Hard cases: what theory expects of values and gradients, and what is seen.

Flat and black scenes, rays that are lost, poses that do not move, images without events, flows too
small to see, thresholds at both ends of their range, one pixel, strong surfaces, far objects; and
gradients of random lenses whose coincidences (equal neighbours, flats, zeros) leave a surface
without effect but not without a derivative. A miss is listed and shown, not hidden, and does not
make the study fail.
"""

import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch

from codesign.errors import CodesignError
from studies.frame.run import Run, StudyConfig, main
from studies.frame.show import table
from studies.frame.sweep import metrics, select, sweep
from studies.stability.cases import CASES, Check
from studies.stability.systems import errors_of_systems

ALLOWED = 1e-6  # relative error of a gradient


@dataclass(frozen=True)
class Config(StudyConfig):
    systems: int = 100
    """Random lenses whose gradients are compared with differences."""


def judge(case: Callable[[], Iterable[Check]]) -> list[dict[str, object]]:
    """Rows of a case's checks; one that stops with an error has failed, with what it said."""
    rows: list[dict[str, object]] = []
    try:
        for check in case():
            figures = {"off_by": check.off, "allowed": check.allowed, "passed": check.passed}
            rows.append(
                {
                    "what": check.what,
                    "expected": _text(check.expected),
                    "seen": _text(check.seen),
                    **figures,
                }
            )
    except (CodesignError, RuntimeError, ArithmeticError, ValueError) as error:
        said = f"stopped: {' '.join(str(error).split())[:160]}"
        rows.append({"what": "an outcome", "seen": said, "passed": False})
    return rows


def _text(value):
    """A number, or the ends of several."""
    value = torch.as_tensor(value, dtype=torch.float64).detach()
    ends = dict.fromkeys((float(value.min()), float(value.max())))
    return " to ".join(f"{end:.6g}" for end in ends)


def study(run: Run[Config]) -> None:
    rows = sweep(run, judge, "hard cases", case=CASES)
    missed = [name for name in CASES if not all(row["passed"] for row in select(rows, case=name))]
    run.record(cases_total=len(CASES), cases_passed=len(CASES) - len(missed))
    run.record(
        **metrics(
            [{k: v for k, v in row.items() if k != "allowed"} for row in rows], "case", "what"
        )
    )
    run.card("Cases passed", f"{len(CASES) - len(missed)} of {len(CASES)}", ", ".join(missed))
    run.section("Cases")
    run.table("Expected and seen", *table(rows))
    missed += random_systems(run)
    lead = f"**Missed:** {', '.join(missed)}." if missed else "All cases end as theory says."
    run.finish("Hard cases", f"What happens at the edges, in value and in gradient. {lead}")


def random_systems(run: Run[Config]) -> list[str]:
    """Gradients of random lenses against differences; returns what was missed."""
    count = run.config.systems
    with run.progress(count, "random lenses") as progress:
        errors = errors_of_systems(
            count, torch.Generator().manual_seed(0), alone_every=10, advance=progress.advance
        )
    worst = max(errors.values())
    run.record(gradient_systems=count, gradient_relative_error=worst)
    run.record(**{f"gradient_relative_error_{name}": error for name, error in errors.items()})
    run.card(
        "Gradients of random lenses", f"{worst:.1e}", f"worst relative error of {count} lenses"
    )
    run.section("Gradients")
    run.table(
        "Worst relative error of a gradient",
        ("numbers", "error", "pass"),
        [(name, f"{error:.1e}", error <= ALLOWED) for name, error in errors.items()],
        f"{count} random lenses with equal neighbours, flats, concentric surfaces, zero conics and asphere "
        "terms, stops in air, mirrors and zero phases, against differences of a trace in extended "
        "precision. In every tenth, each kind of number asks for a gradient alone.",
    )
    return [f"gradient to {name}" for name, error in errors.items() if not error <= ALLOWED]


if __name__ == "__main__":
    sys.exit(main(study, Config))
