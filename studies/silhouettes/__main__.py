"""Is the gradient right where objects hide one another? Frames of occluders over a wall, to the camera's pose
and to the lens.

The loss is a fixed smooth weighting of one frame. Its differences, with many samples and common random
numbers at several seeds, are the truth and tell their own noise; beside them stand the interior gradient
(plain automatic differentiation), and the one with the boundary term, with many samples and with the usual
16.
"""

import sys
from dataclasses import dataclass
from typing import ClassVar

import matplotlib.pyplot as plt

from codesign.errors import DomainError
from scenes import silhouettes as silhouette_scenes
from studies.frame.run import Run, StudyConfig, main
from studies.silhouettes.judge import LENSES, USUAL, Effort
from studies.silhouettes.listed import listed
from studies.silhouettes.task import SAMPLES, Task, compare, cost

ASKED = {"pose": 0.03, "lens": 0.03, "single": 0.10, "interior": 0.005, "cost": 2.0}


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"many": 512, "seeds": 2}
    many: int = 1024
    """Samples per pixel of the differences and of the precise gradients."""
    seeds: int = 4
    """Seeds of the differences; as many of the single estimates."""
    only_listed: bool = False
    """Judge the listed worlds, which once were wrong, and nothing else."""


def study(run: Run[Config]) -> None:
    config = run.config
    if config.many < 64 or config.seeds < 2:
        raise DomainError(f"many = {config.many} and seeds = {config.seeds} must be at least 64 and 2.")
    effort = Effort(seeds=(4,)) if config.quick else USUAL
    if config.only_listed:
        missed = listed(run, effort)
        told = (
            f"**Missed:** {'; '.join(missed)}."
            if missed
            else "All are right, or refused where that is an answer."
        )
        run.finish("Gradients at silhouettes of listed worlds", told)
        return
    cases = [
        (scene, kind)
        for scene in silhouette_scenes.NAMES
        for kind in (LENSES if scene == "cubes" else ("pinhole", "traced"))
    ]
    cases = [("cubes", "pinhole"), ("cubes", "traced"), ("poles", "traced")] if config.quick else cases
    rows = []
    with run.progress(len(cases), "scenes") as progress:
        for scene, kind in cases:
            task = Task(silhouette_scenes.build(scene), kind)
            for group in ("pose", "lens") if kind == "traced" else ("pose",):
                rows.append(compare(run, task, scene, kind, group, config.many, config.seeds, config.seed))
            progress.advance()
    interior_s, boundary_s = cost()
    run.record(step_interior_cpu_s=interior_s, step_boundary_cpu_s=boundary_s)
    run.record(boundary_cost_ratio=boundary_s / interior_s)
    show(run, rows, boundary_s / interior_s, listed(run, effort))


def show(run, rows, ratio, missed):
    table = []
    for scene, kind, group, found in rows:
        asked = (
            ASKED["interior"] if scene == "wall" and kind == "pinhole" and group == "pose" else ASKED[group]
        )
        table.append(
            (
                scene,
                kind,
                group,
                *(found[name] for name in ("interior", "whole", "single", "noise", "worst_bias")),
            )
        )
        if found["whole"] > asked:
            missed.append(f"{scene}, {kind}, {group}: {found['whole']:.1%}")
        if found["single"] > ASKED["single"]:
            missed.append(
                f"{scene}, {kind}, {group}, one estimate of {SAMPLES} samples: {found['single']:.1%}"
            )
    if ratio > ASKED["cost"]:
        missed.append(f"cost {ratio:.2f} x")
    worst = max(found["whole"] for *_, found in rows)
    run.record(worst_error=worst, missed=len(missed))
    run.card("Worst error", f"{worst:.1%}", "with the boundary term, many samples; asked: 3 %")
    run.card("Cost", f"{ratio:.2f} x", "forward + backward with the boundary term over without; asked: 2")
    columns = (
        "scene",
        "lens",
        "to",
        "interior only",
        "with boundary",
        f"one estimate, {SAMPLES} samples, median",
        "noise of the differences",
        "largest bias, standard errors",
    )
    run.table("Relative L2 error of the gradient", columns, table)
    figure, axis = plt.subplots(figsize=(9, 3.6), layout="constrained")
    at = range(len(rows))
    series = (
        ("interior", "#c0392b", "interior only"),
        ("single", "#e08e0b", f"with boundary, {SAMPLES} samples"),
        ("whole", "#1b6ca8", "with boundary, many samples"),
        ("noise", "#888888", "noise of the differences"),
    )
    for name, colour, label in series:
        axis.semilogy(at, [found[name] for *_, found in rows], "o", color=colour, label=label)
    axis.axhline(ASKED["pose"], color="firebrick", lw=1)
    axis.set_xticks(at, [f"{scene}\n{kind}\n{group}" for scene, kind, group, _ in rows], fontsize=6)
    axis.set(ylabel="relative error")
    axis.legend(frameon=False, fontsize=7, ncols=4, bbox_to_anchor=(0.5, 1.14), loc="upper center")
    run.figure(
        figure,
        "errors",
        "Error of the gradient against differences. Red line: what is asked of many samples.",
    )
    run.finish(
        "Gradients at silhouettes",
        "All figures are met." if not missed else f"**Missed:** {'; '.join(missed)}.",
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
