"""Hard cases of every stage: what theory says of value, gradient and single precision, and what is
seen.

Nothing to see, everything lost, no turn, half a turn, one event, thresholds and coordinates at both
ends of their range, 1e5 frames, NaN: each is tried at the ends of its numbers and at random ones
between, and a cell of the matrix is the worst of them. Random lenses whose coincidences (equal
neighbours, flats, zeros) leave a surface without effect but not without a derivative are among
them. A miss is listed and explained, not hidden, and does not make the study fail.
"""

import sys
from dataclasses import dataclass
from typing import Any, ClassVar

from studies.frame.run import Run, StudyConfig, main
from studies.frame.show import table
from studies.frame.sweep import metrics, sweep
from studies.stability.case import Case, judge, trials, worst
from studies.stability.cases import CASES
from studies.stability.matrix import matrix

Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"tries": 0}
    tries: int = 10
    """Random numbers that a case is tried at, beside the ends of its spans."""


def cells(case: Case, tries: int, seed: int) -> Rows:
    """A row for each of the case's cells: the worst of its trials."""
    rows = zip(*[judge(case, numbers) for numbers in trials(case, tries, seed)], strict=True)
    return [{"stage": case.stage, **worst(of_kind)} for of_kind in rows]


def study(run: Run[Config]) -> None:
    given = {"tries": run.config.tries, "seed": run.config.seed}
    rows = sweep(run, cells, "cells", given=given, case=CASES)
    missed = [row for row in rows if not row["passed"]]
    explained = [row for row in missed if CASES[row["case"]].known]
    seen = len(rows) - len(missed)
    run.record(cells_total=len(rows), cells_passed=seen, cells_explained=len(explained))
    errors = [{k: row[k] for k in ("case", "kind", "off", "passed")} for row in rows]
    run.record(**metrics(errors, "case", "kind"))
    run.card("As theory says", f"{seen} of {len(rows)} cells", f"{len(CASES)} hard cases")
    run.card("Missed", str(len(missed)), f"{len(explained)} of them explained below")
    run.section("Cases by stages")
    run.figure(
        matrix(rows, CASES),
        "matrix",
        "Each stage has three columns: value (v), gradient (g), single beside double precision (s). "
        "Green: as theory says. Red: missed. Grey: does not apply.",
    )
    if missed:
        run.section("What was missed, and why")
        run.text("\n".join(f"- {_told(row)}" for row in missed))
    run.section("All cells")
    run.table(
        "Expected and seen",
        *table([_shown(row) for row in rows]),
        "The worst of all trials. Errors are over the largest number expected, or over the natural unit.",
    )
    lead = f"**{seen} of {len(rows)} cells are as theory says**" + (
        f"; missed: {', '.join(dict.fromkeys(row['case'] for row in missed))}." if missed else "."
    )
    run.finish("Hard cases", lead)


def _shown(row):
    case = CASES[row["case"]]
    shown = {"case": case.name, "stage": case.stage, "cell": row["kind"], "theory": case.theory}
    off = None if row["off"] is None else f"{row['off']:.1e}"
    errors = {"off": off, "allowed": f"{row['allowed']:.1e}", "pass": row["passed"]}
    return shown | {name: row[name] for name in ("expected", "seen")} | errors


def _told(row):
    case = CASES[row["case"]]
    outcome = f"Expected {row['expected']}, seen {row['seen']}"
    why = case.known or "Not explained yet."
    return f"**{case.label}, {row['kind']}.** Theory: {case.theory}. {outcome}. {why}"


if __name__ == "__main__":
    sys.exit(main(study, Config))
