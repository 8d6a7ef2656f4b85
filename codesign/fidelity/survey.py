"""What every level of every stage changes and costs on a scene, one stage at a time against the
finest.

Changes add up: what a combination changes is at most the sum of what its levels change one after
the other. Seconds multiply: half as many frames take half the time of rendering whatever the
camera, so every part of the chain takes its time at the finest times the ratios of the levels.
"""

import itertools
import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Generator, Tensor

from codesign.errors import CodesignError, DomainError
from codesign.events import SensorModel
from codesign.fidelity.levels import (
    Fidelity,
    Levels,
    batch_of,
    events_at,
    levels_in,
    pickable,
    system_of,
)
from codesign.fidelity.task import Task

PARTS = ("frames", "volume", "field", "judged")  # of which the seconds are told apart
TAKES = {  # parts whose time a stage changes
    "camera": ("frames",),
    "samples": ("frames",),
    "frames": ("frames", "volume"),
    "events": ("volume",),
    "bins": ("volume", "field"),
    "flow": ("field",),
}
DRAWS = 4  # of a noisy sensor
NOISE = (
    *("theta_sigma", "leak_jitter", "rate_cov_decades", "shot_rate_hz", "photoreceptor_noise"),
    *("leak_rate_hz", "hot_pixel_share"),  # leaks begin at random phases
)
TURNS = 3  # of which the quickest counts: the first compiles, and others use the machine too


@dataclass(frozen=True)
class Outcome:
    """One combination on a scene. judged: [draws, N, ...] of the sensor's noise. cpu_s: processor
    seconds of each of PARTS that was run. frames: as rendered."""

    judged: Tensor
    cpu_s: dict[str, float]
    frames: Tensor


class _Drawn:
    """An event layer with noise of its own seed."""

    def __init__(self, layer: Any, seed: int):
        self.layer = layer
        self.seed = seed

    def __call__(self, frames, t_s, bins):
        generator = Generator().manual_seed(self.seed)
        if hasattr(self.layer, "volume"):
            return self.layer.volume(frames, t_s, bins, generator)
        return self.layer(frames, t_s, generator)


@torch.no_grad()
def outcome(
    scene: Any,
    task: Task,
    fidelity: Fidelity,
    seed: int = 0,
    frames: Tensor | None = None,
    turns: int = 1,
) -> Outcome:
    """What a combination makes of a scene.

    Args:
      seed: of the sensor's noise; a noisy sensor gets DRAWS draws.
      frames: where they are rendered already.
      turns: times that it is run; the least seconds count.
    """
    layer, batch = events_at(task, fidelity), batch_of(task, fidelity)
    judged, seconds = [], {}
    for draw in range(max(turns, DRAWS if is_noisy(task.sensor) else 1)):
        system = system_of(scene, task, fidelity, events=_Drawn(layer, seed + draw))
        run = system.begin(batch, {} if frames is None else {"frames": frames})
        for part in PARTS[frames is not None :]:
            begun = time.process_time()
            value = run.objective(task.name) if part == "judged" else run[part]
            seconds[part] = min(seconds.get(part, math.inf), time.process_time() - begun)
        judged.append(value)
        if draw + 1 >= turns:
            frames = run["frames"]  # further draws are of the noise alone
    drawn = judged if is_noisy(task.sensor) else judged[:1]
    return Outcome(torch.stack(drawn), seconds, run["frames"])


def is_noisy(sensor: SensorModel) -> bool:
    """Whether two draws of a sensor differ."""
    return any(getattr(sensor, name) for name in NOISE)


def change(found: Tensor, reference: Tensor) -> float:
    """Root mean square length of the change of what is judged, [draws, N, components, ...], the
    sensor's noise taken out.

    Of several draws the products of every two stand for the square: noise, which is independent
    from draw to draw, leaves their mean alone. Infinite for what is not finite itself.

    Raises: DomainError where the reference is not.
    """
    off = found.double() - reference.double()
    if not bool(reference.isfinite().all()):
        raise DomainError(
            "what is judged is not finite on every draw; judge by numbers that a drive without motion has too."
        )
    if not bool(off.isfinite().all()):
        return math.inf
    count = len(off)
    square = off[0].square()
    if count > 1:
        square = (off.sum(0).square() - off.square().sum(0)) / (count * (count - 1))
    if square.ndim > 1:
        square = square.sum(1)
    return math.sqrt(max(0.0, float(square.mean())))


@dataclass(frozen=True)
class Survey:
    """rows: stage, level, change (of what is judged, against the reference) and cpu_s (of the chain
    with this level, all else finest). reference: seconds of every part of the finest chain. ratios:
    (stage, level) -> seconds of every part over the reference's. refused: (stage, level) ->
    sentence, of levels that this scene does not allow. judged: of the finest chain."""

    levels: Levels
    rows: list[dict[str, Any]]
    reference: dict[str, float]
    ratios: dict[tuple[str, Any], dict[str, float]]
    refused: dict[tuple[str, Any], str]
    judged: Tensor

    def changed(self, stage: str, level: Any) -> float:
        """What one level changes."""
        return next(
            row["change"] for row in self.rows if (row["stage"], row["level"]) == (stage, level)
        )

    def predicted(self, fidelity: Fidelity) -> float:
        """Sum of what the levels of a combination change."""
        return sum(self.changed(*level) for level in levels_in(fidelity))

    def likely(self, fidelity: Fidelity) -> float:
        """Root of the sum of squares: what a combination changes where its levels do so
        independently."""
        return math.hypot(*(self.changed(*level) for level in levels_in(fidelity)))

    def cpu_s(self, fidelity: Fidelity) -> float:
        """Processor seconds of a combination."""
        ratios = [self.ratios[level] for level in levels_in(fidelity)]
        return sum(
            seconds * math.prod(ratio[part] for ratio in ratios)
            for part, seconds in self.reference.items()
        )

    def combinations(self, task: Task) -> Iterable[Fidelity]:
        """Every combination that may be chosen."""
        allowed = pickable(task, self.levels)
        return map(Fidelity, *zip(*itertools.product(*allowed.values()), strict=True))


def survey(scene: Any, task: Task, levels: Levels, seed: int = 0) -> Survey:
    """Run every level of every stage on a scene, all else finest.

    Raises: DomainError where the finest chain itself cannot be run.
    """
    finest = Fidelity.finest(levels)
    best = outcome(scene, task, finest, seed, turns=TURNS)
    rows, ratios, refused = [], {}, {}
    known: Levels = dict.fromkeys(levels, ())
    for stage, level in [(name, level) for name, found in levels.items() for level in found]:
        tried = replace(finest, **{stage: level})
        frames = None if "frames" in TAKES[stage] else best.frames
        try:
            new = best if tried == finest else outcome(scene, task, tried, seed, frames, TURNS)
        except CodesignError as error:
            refused[stage, level] = str(error)
            continue
        off = change(new.judged, best.judged)
        if off == math.inf:
            refused[stage, level] = "what is judged is not finite on every draw"
            continue
        known[stage] += (level,)
        cpu_s = best.cpu_s | {part: new.cpu_s[part] for part in TAKES[stage]}
        ratios[stage, level] = {part: cpu_s[part] / best.cpu_s[part] for part in PARTS}
        rows.append({"stage": stage, "level": level, "change": off, "cpu_s": sum(cpu_s.values())})
    return Survey(known, rows, best.cpu_s, ratios, refused, best.judged)
