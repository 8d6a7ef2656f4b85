"""Hard cases: what theory expects of values and gradients, and what is seen.

Flat and black scenes, rays that are lost, poses that do not move, images without events, flows too small to
see, thresholds at both ends of their range, one pixel, strong surfaces, far objects; and gradients of random
lenses whose coincidences (equal neighbours, flats, zeros) leave a surface without effect but not without a
derivative. A miss is listed and shown, not hidden, and does not make the study fail.
"""

import sys
from dataclasses import dataclass

import torch

from codesign.errors import CodesignError
from studies.frame.run import Run, StudyConfig, main
from studies.stability import cases
from studies.stability import extreme as cases_extreme
from studies.stability.cases import Outcome
from studies.stability.systems import KINDS, errors_of_systems

CASES = {
    "flat scene": cases.flat_scene,
    "black frames": cases.black_frames,
    "total reflection": cases.total_reflection,
    "all rays lost": cases.all_rays_lost,
    "pose twist zero": cases.identity_twist,
    "pose near half a turn": cases_extreme.half_turn,
    "zero events": cases.zero_events,
    "flow below 1e-3 px": cases.tiny_flow,
    "threshold 1e-3": cases_extreme.smallest_threshold,
    "threshold 10": cases_extreme.largest_threshold,
    "one-pixel image": cases_extreme.one_pixel,
    "static camera": cases_extreme.static_camera,
    "motion there and back": cases_extreme.turning_point,
    "very strong surfaces": cases_extreme.strong_surfaces,
    "object 10 km away, float32": cases_extreme.far_object_single_precision,
}


@dataclass(frozen=True)
class Config(StudyConfig):
    systems: int = 100
    """Random lenses whose gradients are compared with differences."""


def judge(case):
    """Outcome of a case; one that stops with an error has failed, with what it said."""
    try:
        return case()
    except (CodesignError, RuntimeError, ArithmeticError, ValueError) as error:
        return Outcome("an outcome", f"stopped: {' '.join(str(error).split())[:160]}", 1.0, False)


ALLOWED = 1e-6  # relative error of a gradient


def random_systems(run):
    """Gradients of random lenses against differences; returns what was missed."""
    count = run.config.systems
    with run.progress(count, "random lenses") as progress:
        errors = errors_of_systems(
            count, torch.Generator().manual_seed(0), alone_every=10, advance=progress.advance
        )
    run.record(
        gradient_systems=count,
        gradient_relative_error=max(errors.values()),
        **{f"gradient_relative_error_{name}": errors[name] for name in KINDS},
    )
    run.card(
        "Gradients of random lenses", f"{max(errors.values()):.1e}", f"worst relative error of {count} lenses"
    )
    run.section("Gradients")
    run.table(
        "Worst relative error of a gradient",
        ("numbers", "error", "pass"),
        [(name, f"{error:.1e}", error <= ALLOWED) for name, error in errors.items()],
        f"{count} random lenses with equal neighbours, flats, concentric surfaces, zero conics and asphere terms, stops "
        "in air, mirrors and zero phases, against differences of a trace in extended precision. In every tenth, each "
        "kind of number asks for a gradient alone.",
    )
    return [f"gradient to {name}" for name, error in errors.items() if not error <= ALLOWED]


def study(run: Run[Config]) -> None:
    found = {}
    with run.progress(len(CASES), "hard cases") as progress:
        for name, case in CASES.items():
            found[name] = judge(case)
            progress.advance(passed=sum(outcome.passed for outcome in found.values()))
    numbers = {
        "_".join("".join(c if c.isalnum() else " " for c in name).split()): outcome
        for name, outcome in found.items()
    }
    run.record(cases_total=len(found), cases_passed=sum(outcome.passed for outcome in found.values()))
    run.record(
        **{f"{name}_number": outcome.number for name, outcome in numbers.items()},
        **{f"{name}_passed": int(outcome.passed) for name, outcome in numbers.items()},
    )
    missed = [name for name, outcome in found.items() if not outcome.passed]
    run.card(
        "Cases passed",
        f"{len(found) - len(missed)} of {len(found)}",
        "value and gradient" if not missed else "missed: " + ", ".join(missed),
    )
    run.section("Cases")
    run.table(
        "Expected and seen",
        ("case", "expected", "seen", "pass"),
        [(name, o.expected, o.seen, o.passed) for name, o in found.items()],
    )
    missed += random_systems(run)
    lead = "All cases end as theory says." if not missed else f"**Missed:** {', '.join(missed)}."
    run.finish("Hard cases", f"What happens at the edges, in value and in gradient. {lead}")


if __name__ == "__main__":
    sys.exit(main(study, Config))
