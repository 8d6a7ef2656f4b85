"""Worlds in which gradients at silhouettes once were wrong without a word: each judged, or refused
where its shapes pass through each other. Shown by ``python -m tests.hostile listed``."""

from collections.abc import Callable

import torch

from codesign import pose
from scenes import silhouettes
from tests.hostile import outline_cases
from tests.hostile.judge import (
    RIGHT,
    USUAL,
    Case,
    Effort,
    Judged,
    compared,
    differences,
    gradient,
    judge,
    optics_of,
)
from tests.numbers import f64

WIDTH_PX = 28
HALF_SLOPE = 4 / 11


def case_of(world: outline_cases.World, kind: str) -> Case:
    """A listed world before one of the lenses."""
    scale = 1.0 if kind == "pinhole" else world.lens_scale
    pitch_mm = 2 * 11.0 * scale * HALF_SLOPE * world.narrow / WIDTH_PX
    optics = optics_of(kind, scale, world.focus_m)
    return Case(world.scene, optics, world.T_world_cam, pitch_mm, WIDTH_PX, world.nearest_m)


def measure(
    count: int, seed: int, say: Callable[[str], None] = print, effort: Effort = USUAL
) -> tuple[dict[str, float], list[str]]:
    """Figures and findings of the first ``count`` listed worlds, each before its lenses."""
    cases = [(name, kind) for name, build in outline_cases.CASES.items() for kind in build().kinds]
    jobs = {
        f"{name}_{kind}": lambda name=name, kind=kind: judge(
            case_of(outline_cases.CASES[name](), kind), effort=effort
        )
        for name, kind in cases
    }
    jobs["auto_after_wall_pinhole"] = lambda: auto_after_wall(effort)
    figures = {}
    findings = []
    for label, work in list(jobs.items())[:count]:
        found = work()
        if found.verdict == "refused":
            figures[f"{label}_refused"] = 1.0
        else:
            figures |= {f"{label}_error": found.error or 0.0, f"{label}_noise": found.noise or 0.0}
        beside = f"noise {found.noise}, interior {found.interior}"
        say(f"{label}: {found.verdict}, error {found.error}, {beside}")
        if not passes(label.rsplit("_", 1)[0], found):
            findings.append(f"{label}: {found.verdict} {found.error or 0.0:.1%} {found.sentence}")
    return figures, findings


def passes(name: str, found: Judged) -> bool:
    """Within RIGHT + twice the noise, or refused where shapes pass through each other."""
    if found.verdict == "refused":
        return name in outline_cases.CROSSING
    if found.error is None or found.verdict in ("noisy", "doubtful"):
        return False
    return found.error <= RIGHT + 2 * (found.noise or 0)


def auto_after_wall(effort: Effort = USUAL) -> Judged:
    """gradient="auto" before the boxes, with a scene that was asked first where it shows nothing
    but its wall."""
    scene = silhouettes.build("cubes")
    boxes = pose.look_at((0.05, -1.2, 1.0), (0.0, 1.0, 0.7))
    wall = pose.look_at((0.0, 0.0, 2.4), (0.0, 2.5, 2.4)) @ pose.se3_exp(f64([0, 0, 0, 0, 0, 0.2]))
    optics = optics_of("pinhole")
    pitch_mm = 2 * 11.0 * HALF_SLOPE / WIDTH_PX
    before = Case(scene, optics, wall, pitch_mm, WIDTH_PX, 3.0)
    gradient(before, effort, 0, "auto")
    case = Case(scene, optics, boxes, pitch_mm, WIDTH_PX, 1.0)
    seeds = range(effort.seeds[0])
    truth = torch.stack([differences(case, effort, 1000 + k) for k in seeds])
    got = torch.stack([gradient(case, effort, k, "auto") for k in seeds])
    return compared(truth, got, gradient(case, effort, 0, "interior"))
