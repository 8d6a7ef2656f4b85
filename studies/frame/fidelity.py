"""--tolerance: a study that renders no finer than its scene needs, as codesign.select finds it."""

import json
from dataclasses import asdict, dataclass, replace
from typing import Any

import codesign
from codesign.atomic import write_atomic
from codesign.errors import DomainError
from codesign.fidelity import Fidelity, Task, levels_of
from codesign.fidelity.levels import COARSER
from codesign.reading import read_json
from studies.frame.config import StudyConfig
from studies.frame.run import Run
from studies.frame.sweep import plain


@dataclass(frozen=True)
class Tolerant(StudyConfig):
    """Of a study whose camera may be cheaper than its options say."""

    tolerance: float = 0.0
    """How much the modelling may change the study's flow, px: the cheapest lens and rays per pixel
    within it are chosen on the study's own scene before it starts, with reasons. 0: those that the
    options say."""


def chosen(run: Run[Any], scene: Any, task: Task, events: str, bins: int, of: str) -> Fidelity:
    """The cheapest camera and samples within --tolerance, at most as fine as the task's own; chosen
    once per run, so that a resumed run goes on with them. Written to fidelity.json, with reasons,
    to metrics.json, and onto the page.

    Args:
      scene, task: as of ``codesign.select``; all frames of the task count, and its own flow.
      events, bins: of the task, as levels of ``codesign.select``.
      of: what it is chosen for, in words; a study may choose for several things.
    Raises: DomainError for a tolerance that is not above 0, or that nothing meets.
    """
    tolerance, path = run.config.tolerance, run.path("fidelity.json")
    if not tolerance > 0:
        raise DomainError(
            f"--tolerance is {tolerance:g}; give pixels of flow above 0, or 0 for the levels that the options say."
        )
    known = read_json(path) if path.exists() else {}
    if of not in known:
        # the finest samples are the reference alone
        finest = replace(
            task, camera=task.camera.with_samples(COARSER * task.camera.samples_per_pixel)
        )
        fixed = {"frames": (len(task.t_s),), "events": (events,), "bins": (bins,)}
        # by convolution no study renders
        cameras = [name for name in levels_of(task)["camera"] if name != "psf"]
        choice = codesign.select(
            scene, finest, tolerance, levels={**fixed, "camera": cameras}, seed=run.config.seed
        )
        said, levels_there = choice.reasons(), choice.survey.levels
        asked = replace(Fidelity.finest(levels_there), samples=task.camera.samples_per_pixel)
        known[of] = {
            "levels": asdict(choice.fidelity),
            "reasons": {stage: said[stage] for stage in ("camera", "samples")},
            "change_px": choice.change,
            "times_faster": choice.survey.cpu_s(asked) / choice.survey.cpu_s(choice.fidelity),
        }
        write_atomic(path, json.dumps(known, indent=2).encode())
    found = known[of]
    levels = found["levels"]
    rows = [(stage, levels[stage], reason) for stage, reason in found["reasons"].items()]
    run.say("\n".join([f"For {of}:", *(f"  {stage} {level}: {why}" for stage, level, why in rows)]))
    run.section(f"Levels chosen for {of}")
    run.table(
        f"Cheapest within {tolerance:g} px of flow",
        ("stage", "level", "why"),
        rows,
        f"A finer model changes the flow by {found['change_px']:.2g} px. As one measurement tells, this is "
        f"{found['times_faster']:.2g} times as fast as what the options say.",
    )
    numbers = {f"camera_{levels['camera']}": 1, "samples": levels["samples"]}
    numbers |= {name: found[name] for name in ("change_px", "times_faster")}
    run.record(**{plain("chosen", of, name): value for name, value in numbers.items()})
    return Fidelity(**levels)
