"""Does the gradient stay right from frames to the flow loss where objects hide one another? A room with two boxes,
to the camera's pose and to its lens.

Differences with common random numbers, at several seeds of the camera, are the truth and tell their own noise; beside
them stand the interior gradient (plain automatic differentiation) and the one with the boundary term. Hard counts are
whole numbers: there both sides are means over many places of every pixel inside its threshold, other ones with every
seed, which cost little since frames are rendered once and events simulated many times.
"""

import math
import sys
from dataclasses import dataclass
from typing import ClassVar

import matplotlib.pyplot as plt
import torch
from torch import Tensor

from codesign.errors import DomainError
from studies.frame.run import Run, StudyConfig, main
from studies.silhouettes_chain.case import GROUPS, Case

ASKED = {"smooth": 0.05, "noise": 0.10, "cosine": 0.9}
USUAL = 16  # samples per pixel of one estimate as an optimiser takes it
PER_PX = 64.0  # of the precise ones
LOSSES = ("smooth counts", "smooth flow", "hard counts", "hard flow", "hard flow, one place")
KINDS = ("difference", "interior", "boundary", "single")


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"cases": 1, "seeds": 6, "samples": 128, "places": 16, "size_px": 32}
    cases: int = 2
    """Draws of textures, path and thresholds."""
    seeds: int = 8
    """Seeds of the camera's samples, and draws of places inside the threshold, of each."""
    samples: int = 256
    """Samples per pixel of the differences; the gradients take half as many."""
    places: int = 32
    """Places inside the threshold at every seed."""
    size_px: int = 48
    """Side of the film, pixels."""


@dataclass(frozen=True)
class Row:
    """Relative L2 errors against differences of one loss, to one group of numbers: interior, boundary, median of
    single estimates; noise of the differences and of the mean with the boundary term; cosines of the first two."""

    interior: float
    boundary: float
    single: float
    noise: float
    spread: float
    cosine_interior: float
    cosine_boundary: float


def study(run: Run[Config]) -> None:
    config = run.config
    if config.cases < 1 or config.seeds < 2 or config.samples < 4 or config.places < 2:
        raise DomainError(
            f"cases = {config.cases}, seeds = {config.seeds}, samples = {config.samples}, places = {config.places}: "
            "give at least 1, 2, 4 and 2."
        )
    stored = run.load_state()
    found = list(stored.tensors["found"]) if stored else []
    units = [(case, seed) for case in range(config.cases) for seed in range(config.seeds)]
    cases = {}
    with run.progress(len(units), "differentiating", len(found)) as progress:
        for number, seed in units[len(found) :]:
            if number not in cases:
                cases = {number: Case(config.seed + number, config.size_px)}
            found.append(measured(cases[number], config, 100 * (1 + config.seed) + seed))
            run.save_state({"found": torch.stack(found)}, {})
            progress.advance()
    values = torch.stack(found).reshape(config.cases, config.seeds, len(KINDS), len(LOSSES), 9)
    rows = {
        (loss, group): judged(values[:, :, :, number, which])
        for number, loss in enumerate(LOSSES)
        for group, which in GROUPS.items()
        if not (loss.endswith("counts") and group == "lens")  # a random pattern hardly answers to the lens
    }
    show(run, rows)


def measured(case: Case, config: Config, seed: int) -> Tensor:
    """Differences and gradients at one seed of the camera and one draw of places: [KINDS, LOSSES, 9]."""
    losses = case.losses(case.places(config.places, seed))
    half = config.samples // 2
    ways = (
        case.differences(losses, config.samples, seed),
        case.gradients(losses, half, seed, "interior", PER_PX),
        case.gradients(losses, half, seed, "boundary", PER_PX),
        case.gradients(losses, USUAL, seed + 50, "boundary", 2.5),
    )
    return torch.stack([torch.stack([way[key].detach() for key in LOSSES]) for way in ways])


def judged(values: Tensor) -> Row:
    """Row of values [cases, seeds, KINDS, n]; cases stand side by side, so that no error cancels another's."""
    seeds = values.shape[1]
    truth, interior, boundary, _ = values.mean(1).transpose(0, 1).flatten(1)
    size = float(truth.norm())
    deviation = values.std(1).transpose(0, 1).flatten(1) / math.sqrt(seeds)
    single = (values[:, :, 3].transpose(0, 1).flatten(1) - truth).norm(dim=1) / size
    return Row(
        float((interior - truth).norm()) / size,
        float((boundary - truth).norm()) / size,
        float(single.median()),
        float(deviation[0].norm()) / size,
        float(deviation[2].norm()) / size,
        float(interior @ truth / interior.norm()) / size,
        float(boundary @ truth / boundary.norm()) / size,
    )


def missed(loss: str, row: Row) -> bool:
    """Whether a row misses what is asked of it: 5 % and twice the noise for smooth counts; for the mean over places
    of hard ones a noise below 10 % and a cosine of 0.9. Nothing is asked of one place."""
    if loss.startswith("smooth"):
        return row.boundary > ASKED["smooth"] + 2 * row.noise
    return loss.endswith(("counts", "flow")) and (
        row.noise > ASKED["noise"] or row.cosine_boundary < ASKED["cosine"]
    )


def show(run: Run[Config], rows: dict[tuple[str, str], Row]) -> None:
    short = []
    for (loss, group), row in rows.items():
        name = f"{loss}_to_{group}".replace(", ", "_").replace(" ", "_")
        run.record(
            **{f"{name}_{part}": getattr(row, part) for part in Row.__dataclass_fields__},
        )
        if missed(loss, row):
            short.append(f"{loss} to {group} ({row.boundary:.1%}, cosine {row.cosine_boundary:.3f})")
    run.record(rows_missed=len(short))
    flow = rows["smooth flow", "pose"], rows["hard flow", "pose"]
    run.card(
        "Smooth counts, flow loss to pose", f"{flow[0].boundary:.1%}", f"interior {flow[0].interior:.0%}"
    )
    run.card(
        "Hard counts, flow loss to pose",
        f"cosine {flow[1].cosine_boundary:.3f}",
        f"interior {flow[1].cosine_interior:.2f}",
    )
    columns = (
        "loss",
        "to",
        "interior only",
        "with boundary",
        f"one estimate, {USUAL} samples, median",
        "noise of the differences",
        "noise of the mean with boundary",
        "cosine, interior",
        "cosine, boundary",
    )
    order = ("interior", "boundary", "single", "noise", "spread", "cosine_interior", "cosine_boundary")
    run.table(
        "Relative L2 error of the gradient against differences",
        columns,
        [(loss, group, *(getattr(row, part) for part in order)) for (loss, group), row in rows.items()],
        "The loss of hard counts is a mean over places of every pixel inside its threshold; that of one place alone "
        "is another, rough function, whose differences nothing can be judged by.",
    )
    figure, axis = plt.subplots(figsize=(8, 3.4), layout="constrained")
    for part, colour, label in (
        ("interior", "#c0392b", "interior only"),
        ("single", "#e08e0b", f"with boundary, {USUAL} samples"),
        ("boundary", "#1b6ca8", "with boundary, precise"),
        ("noise", "#888888", "noise of the differences"),
    ):
        axis.semilogy(
            range(len(rows)), [getattr(r, part) for r in rows.values()], "o", color=colour, label=label
        )
    axis.set_xticks(range(len(rows)), [f"{loss}\nto {group}" for loss, group in rows], fontsize=6)
    axis.set(ylabel="relative error")
    axis.legend(frameon=False, fontsize=7, ncols=4, bbox_to_anchor=(0.5, 1.14), loc="upper center")
    run.figure(figure, "errors", "Error of the gradient against differences, along the chain.")
    run.finish(
        "Gradients at silhouettes through the chain",
        "All figures are met." if not short else f"**Missed:** {'; '.join(short)}.",
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
