"""Random worlds through three lenses: is every gradient that can be judged right, or refused?

Judged by differences with common random numbers, in two random directions of every walk instead of
six components. One line a case is written as soon as it is judged, and a later call goes on from
there.
"""

import json
import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from tests.hostile import random_worlds
from tests.hostile.judge import HIGHEST, LENSES, RIGHT, Case, Effort, judge, nearest_m, optics_of
from tests.studies.runs import lines

EFFORT = Effort(samples=512, per_px=24.0, seeds=(3, 10), directions=2, enough=0.06)
EACH = 10_000  # worlds of one seed
REFUSED = 0.03  # of all cases, at most


def case_of(draw: random_worlds.Draw, kind: str) -> Case:
    """The draw before one of LENSES, focused as it says."""
    scale = 1.0 if kind == "pinhole" else draw.lens_scale
    optics = optics_of(kind, scale, draw.focus_m)
    width_px = random_worlds.WIDTH_PX
    pitch_mm = 2 * 11.0 * scale * draw.half_slope / width_px
    near = nearest_m(draw.scene, optics, draw.T_world_cam, pitch_mm, width_px)
    return Case(draw.scene, optics, draw.T_world_cam, pitch_mm, width_px, near, draw.seed)


def measure(
    count: int, seed: int, say: Callable[[str], None] = print, path: str | Path | None = None
) -> tuple[dict[str, float], list[str]]:
    """Figures and findings of ``count`` worlds before each of the lenses. path: of the cases, a
    line each, else CODESIGN_WORLDS, else runs/hostile/worlds.jsonl."""
    path = Path(path or os.environ.get("CODESIGN_WORLDS", "runs/hostile/worlds.jsonl"))
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = {(row["world"], row["lens"]): row for row in lines(path)}
    wanted = [(EACH * seed + k, kind) for k in range(count) for kind in LENSES]
    for world, kind in wanted:
        if (world, kind) in rows:
            continue
        found = judge(case_of(random_worlds.draw(world), kind), effort=EFFORT).row()
        rows[world, kind] = row = {"world": world, "lens": kind, **found}
        with path.open("a") as file:
            file.write(json.dumps(row) + "\n")
        if _fate(row) not in ("right", "noisy", "empty"):
            say(_told(row))
    return summary([rows[key] for key in wanted])


def summary(rows: list[dict]) -> tuple[dict[str, float], list[str]]:
    """Figures and findings of judged cases."""
    counts = Counter(map(_fate, rows))
    names = ("right", "wrong", "noisy", "refused")
    figures = {f"worlds_{name}": float(counts[name]) for name in names}
    figures["worlds_judged"] = figures["worlds_right"] + figures["worlds_wrong"]
    figures["cpu_s"] = sum(row["cpu_s"] for row in rows)
    findings = [_told(row) for row in rows if _fate(row) == "wrong"]
    if counts["refused"] > REFUSED * len(rows):
        told = f"{counts['refused']} of {len(rows)} random worlds are refused"
        findings.append(f"{told}, {REFUSED:.0%} may be.")
    return figures, findings


def _fate(row):
    if row["verdict"] in ("empty", "refused"):
        return row["verdict"]
    if row["noise"] > HIGHEST:
        return "wrong" if row["verdict"] == "wrong" else "noisy"
    return "right" if row["error"] <= RIGHT + 2 * row["noise"] else "wrong"


def _told(row):
    where = f"world {row['world']} through the lens '{row['lens']}'"
    if row["verdict"] == "refused":
        return f"{where} is refused: {row['sentence']}"
    return f"{where} is {row['error']:.1%} wrong at a noise of {row['noise']:.1%}."
