"""Does the gain of a jointly designed camera survive lenses and mounts as they are made, and does it
come from motion that is seen?

Answers of a race (studies.codesign) are judged again under other conditions: made and mounted with
errors that the estimator does not know; thresholds a tenth higher than designed; a lens without any
blur; events whose order within the interval is lost; frames without contrast.
"""

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import nn

from codesign import lens
from codesign.errors import DomainError
from codesign.types import EventVolume
from scenes.robots import pair as robot_pair
from studies.codesign.cells import space_of
from studies.codesign.design import BLOCKS, Whole
from studies.codesign.problem import Drawn, Looked
from studies.codesign.race import ENOUGH, JUDGED, answers, compared
from studies.frame.config import check_least
from studies.frame.run import Run, StudyConfig, main
from studies.frame.show import tabulate
from studies.frame.sweep import plain, select, sweep

# standard deviations of what a workshop leaves: a hundredth of the focal length, a tenth of a
# dioptre, 5 mm and half a degree
MADE = {
    "efl_mm": lambda value, deviate: value * (1 + 0.01 * deviate),
    "focus_per_m": lambda value, deviate: value + 0.1 * deviate,
    "x_m": lambda value, deviate: value + 0.005 * deviate,
    "z_m": lambda value, deviate: value + 0.005 * deviate,
    "pitch_rad": lambda value, deviate: value + math.radians(0.5) * deviate,
}


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"starts": 1, "judged_worlds": 2}
    raw: Path = Path("docs/joint_race_outdoors.jsonl")
    """Judged answers of a race (answers.jsonl of its folder)."""
    arms: tuple[str, ...] = ("joint", "nested", "lens > mount > read-out", "book")
    """Answers that are judged again; the first is held against each of the others."""
    starts: int = 12
    """Starting designs whose answers are judged, from the first on."""
    judged_worlds: int = 24
    """Unseen worlds, two drives in each."""


def study(run: Run[Config]) -> None:
    config = run.config
    check_least(config, 1, "starts", "judged_worlds")
    setting, rows = answers(config.raw)
    found = {(row["seed"], row["arm"]): row["share"] for row in rows}
    seeds = sorted({seed for seed, _ in found})[: config.starts]
    lacking = [arm for arm in config.arms if any((seed, arm) not in found for seed in seeds)]
    if lacking or len(set(config.arms)) < max(2, len(config.arms)):
        raise DomainError(
            f"--arms {' '.join(lacking) or 'names fewer than two, or one twice'}: choose from "
            f"{', '.join(dict.fromkeys(arm for _, arm in found))}."
        )
    space = space_of(setting)
    drawn = Drawn(space, robot_pair.unseen(config.judged_worlds), config.judged_worlds, 2)

    def cell(seed, arm, control):
        share = torch.tensor(found[seed, arm], dtype=torch.float64)
        errors = CONTROLS[control](drawn, space.made(share), seed)
        return {"errors": errors.unflatten(0, (config.judged_worlds, -1)).mean(1).tolist()}

    judged = sweep(run, cell, "answers", seed=seeds, arm=config.arms, control=list(CONTROLS))
    ours, *others = config.arms
    lines = []
    for control in CONTROLS:
        mine = select(judged, control=control)
        over = compared(mine, ours)
        errors = torch.tensor([row["errors"] for row in select(mine, arm=ours)])
        line: dict[str, Any] = {"control": control, ours: float(errors.mean(1).quantile(0.5))}
        for arm in others:
            ratio = over[arm][0].ratio()
            line[f"over {arm}"] = f"{ratio:.2f}"
            run.record(**ratio.metrics(plain(control, ours, "over", arm)))
        lines.append(line)
    run.section(
        "Judged again",
        f"Median error of {ours} over {len(seeds)} starts, and its error over that of the others (95 % of resampled starts and "
        "worlds).",
    )
    tabulate(run, "Controls", lines, "control", prefix="control")
    plainly, made = lines[0], lines[1]
    blind = max(lines[-2:], key=lambda line: line[ours])
    arm = others[0]
    run.finish(
        "Controls of joint design",
        f"Made and mounted with errors, '{space.pair.name}' by {ours} has {made[ours]:.2f} where it has {plainly[ours]:.2f} as "
        f"designed; over {arm} {made[f'over {arm}']} where it was {plainly[f'over {arm}']}. What is left when events tell nothing "
        f"of motion: {blind[ours]:.2f} ({blind['control']})."
        + (" So few starts decide nothing." if len(seeds) < ENOUGH else ""),
    )


@dataclass(frozen=True)
class Changed(Whole):
    """A design with another event stage, or another lens at the same light."""

    stage: Callable[[nn.Module], nn.Module] = lambda stage: stage

    def events(self, kind: str, bins: int = robot_pair.BINS) -> nn.Module:
        return self.stage(super().events(kind, bins))


class Altered(nn.Module):
    """An event stage of which something is taken away."""

    def __init__(self, stage: nn.Module) -> None:
        super().__init__()
        self.stage = stage


class Shuffled(Altered):
    """Events whose order in the interval is lost: bins in an order drawn for every pixel."""

    def volume(self, frames: Any, t_s: Any, bins: int, generator: Any = None) -> EventVolume:
        made = self.stage.volume(frames, t_s, bins, generator)
        generator = torch.Generator().manual_seed(0)
        drawn = torch.rand(made.counts[:, :1].shape, generator=generator, dtype=torch.float64)
        order = drawn.argsort(2).expand_as(made.counts)
        return replace(made, counts=made.counts.gather(2, order))


class Bland(Altered):
    """Frames at their mean, in which nothing moves."""

    def volume(self, frames: Any, t_s: Any, bins: int, generator: Any = None) -> EventVolume:
        level = frames.mean((-3, -2, -1), keepdim=True).expand_as(frames).contiguous()
        return self.stage.volume(level, t_s, bins, generator)


def looked(drawn: Drawn, whole: Whole) -> Looked:
    return drawn.looked(whole, drawn.draw(JUDGED), "sensor")


def as_designed(drawn, whole, seed):
    return looked(drawn, whole).hard()


def made_and_mounted(drawn, whole, seed):
    """Seen by a lens and from a place that are a little off, read as if they were not. What the
    lens's bounds do not have is off the other way."""
    deviates = torch.randn(len(MADE), generator=torch.Generator().manual_seed(seed)).tolist()
    off = {}
    for (name, change), deviate in zip(MADE.items(), deviates, strict=True):
        one, other = (change(whole.numbers[name], sign * deviate) for sign in (1, -1))
        low, high = whole.space.limits(name)
        off[name] = one if name in BLOCKS["mount"] or low <= one <= high else other
    return looked(drawn, whole.with_numbers(**off)).again(whole, "sensor").hard()


def higher_thresholds(drawn, whole, seed):
    return looked(drawn, whole.with_numbers(theta=1.1 * whole.numbers["theta"])).hard()


def without_blur(drawn, whole, seed):
    """Behind a pinhole of the same focal length that passes as much light, evenly."""
    other = replace(whole)
    pinhole = whole.camera.with_lens(lens.Pinhole(whole.numbers["efl_mm"]))
    # the falloff of a pinhole is the fourth power of a cosine, which the lens has not
    vars(other)["camera"] = pinhole.in_one_colour()
    return looked(drawn, other).hard()


def staged(stage, drawn, whole, seed):
    return looked(drawn, Changed(whole.space, whole.numbers, stage)).hard()


CONTROLS: Mapping[str, Callable[[Drawn, Whole, int], torch.Tensor]] = {
    "as designed": as_designed,
    "made and mounted with errors": made_and_mounted,
    "thresholds a tenth higher": higher_thresholds,
    "without blur": without_blur,
    "order of events lost": partial(staged, Shuffled),
    "no contrast": partial(staged, Bland),
}

if __name__ == "__main__":
    sys.exit(main(study, Config))
