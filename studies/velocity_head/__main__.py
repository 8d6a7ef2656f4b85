"""Can one velocity head serve all designs of a camera on a robot, or does each need its own?

A head that sees lens and mount is trained on designs drawn all over the bounds of the pairs. On designs that it has
never seen, in unseen worlds, by the hard sensor, it is compared with plain least squares, with heads trained for one of
these designs alone (fresh ones, and the shared one trained on), and with one from which lens and mount are hidden.
Errors are typical ones, as in studies.robot_gates. Everything is rendered once; a resumed run renders what is missing.
"""

import copy
import sys
from dataclasses import asdict, dataclass
from typing import ClassVar

import torch
from torch import Tensor

from codesign import task
from codesign.errors import DomainError
from scenes import robot_pair
from scenes.robot_pairs import PAIRS, check_pairs
from studies.frame.run import Run, StudyConfig, main
from studies.velocity_head import page
from studies.velocity_head.compare import ARMS, Errors
from studies.velocity_head.samples import DRIVES, Drawn, Samples, designs
from studies.velocity_head.training import RATE, bounded, distance, judged, trained

TUNED = 0.3  # rate of a head that is trained on, of that of a fresh one


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {
        "pair": ("corridor",),
        "designs": 6,
        "held_out": 2,
        "worlds": 2,
        "unseen": 2,
        "own_motions": 6,
        "judged_motions": 6,
        "steps": 60,
        "own_steps": 40,
    }
    pair: tuple[str, ...] = tuple(PAIRS)
    """Pairs whose designs one head serves."""
    designs: int = 40
    """Designs of each pair to train on."""
    held_out: int = 4
    """Designs of each pair to compare on."""
    worlds: int = 8
    """Training worlds of each pair; a quarter of them chooses when to stop."""
    unseen: int = 6
    """Unseen worlds of each pair."""
    motions: int = 3
    """Drives in every world, of a design to train on."""
    own_motions: int = 24
    """Drives in every training world, of a head for one design."""
    judged_motions: int = 18
    """Drives in every unseen world."""
    steps: int = 900
    """Steps of the shared head."""
    own_steps: int = 300
    """Steps of a head for one design."""
    batch: int = 192
    """Samples a step."""
    width: int = 32
    """Of the layers."""


def study(run: Run[Config]) -> None:
    config = run.config
    _check(config)
    data = {name: Data(run, name) for name in config.pair}
    lessons, judge = zip(*(each.split(each.training) for each in data.values()), strict=True)
    heads = {
        arm: _trained(run, arm, list(lessons), list(judge), shown)
        for arm, shown in (("shared", True), ("hidden", False))
    }
    heads["shared"].save(
        run.path("head.safetensors"), {"config": _plain(config), "run": "studies.velocity_head"}
    )
    with run.progress(config.held_out * len(data), "heads for one design") as bar:
        errors = Errors([])
        for name, each in data.items():
            for index, design in enumerate(each.designs):
                found = _compared(run, each, index, heads)
                errors.add(name, design, found, config.unseen)
                bar.advance(shared=errors.rows[-1].typical["shared"], plain=errors.rows[-1].typical["plain"])
    calibration = _calibration(data, heads["shared"])
    run.record(**errors.figures(config.seed), **calibration, seconds=run.seconds)
    page.show(run, errors, calibration, sum(p.numel() for p in heads["shared"].parameters()))


def _check(config):
    check_pairs(config.pair)
    least = {"designs": 1, "held_out": 1, "worlds": 2, "unseen": 1, "motions": 1, "own_motions": 1}
    least |= {"judged_motions": 1, "steps": 1, "own_steps": 1, "batch": len(config.pair)}
    for name, value in least.items():
        if getattr(config, name) < value:
            raise DomainError(
                f"--{name.replace('_', '-')} is {getattr(config, name)}; at least {value} is needed."
            )
    if max(config.motions, config.own_motions, config.judged_motions) > DRIVES:
        raise DomainError(f"a world has {DRIVES} drives; ask for at most as many motions.")


def _plain(config):
    return {name: str(value) for name, value in asdict(config).items()}


class Data:
    """All samples of a pair."""

    def __init__(self, run: Run[Config], name: str):
        config = run.config
        pair = PAIRS[name]()
        self.config = config
        self.designs = designs(pair, config.held_out, config.seed + 1000)
        folder = run.folder / "samples"
        known = Drawn(pair, robot_pair.training(config.worlds), folder, config.seed)
        new = Drawn(pair, robot_pair.unseen(config.unseen), folder, config.seed)
        self.plain = known.plain
        jobs = [
            (known, "training", index, design, config.motions)
            for index, design in enumerate(designs(pair, config.designs, config.seed))
        ]
        jobs += [
            (known, "own", index, design, config.own_motions) for index, design in enumerate(self.designs)
        ]
        jobs += [
            (new, "unseen", index, design, config.judged_motions) for index, design in enumerate(self.designs)
        ]
        found: dict[str, list[Samples]] = {"training": [], "own": [], "unseen": []}
        with run.progress(len(jobs), f"{name}: samples") as bar:
            for drawn, kind, index, design, motions in jobs:
                found[kind].append(drawn.samples(kind, index, design, motions))
                made = found[kind][-1]
                bar.advance(error=float(bounded(made.velocity, made).mean()))
        self.training = found["training"]
        self.own = found["own"]
        self.unseen = found["unseen"]

    def split(self, parts: list[Samples]) -> tuple[Samples, Samples]:
        """Samples to train on, and those of the last quarter of the worlds, to choose by."""
        first = self.config.worlds - max(1, self.config.worlds // 4)
        shares = [len(part.twist) * first // self.config.worlds for part in parts]
        lessons = Samples.joined([part[:share] for part, share in zip(parts, shares, strict=True)])
        judge = Samples.joined([part[share:] for part, share in zip(parts, shares, strict=True)])
        return lessons, judge


def _trained(run, arm, lessons, judge, shown):
    config = run.config
    run.say(f"training the head '{arm}' on {sum(len(part.twist) for part in lessons)} samples")
    torch.manual_seed(config.seed)
    plain = task.EgoVelocity(tuple(range(6)), (1.0,) * 6)
    head = task.VelocityHead(plain, config.width, design=shown)
    return trained(head, lessons, judge, config.steps, config.batch, config.seed)


def _compared(run, data, index, heads) -> dict[str, Tensor]:
    """Bounded errors [N] of each arm on unseen samples of a design."""
    config = run.config
    lessons, judge = data.split([data.own[index]])
    torch.manual_seed(config.seed)
    fresh = task.VelocityHead(heads["shared"].plain, config.width)
    rates = {"alone": (fresh, RATE), "trained on": (copy.deepcopy(heads["shared"]), TUNED * RATE)}
    own = {
        arm: trained(head, [lessons], [judge], config.own_steps, config.batch, config.seed, rate)
        for arm, (head, rate) in rates.items()
    }
    samples = data.unseen[index]
    found = {"plain": bounded(samples.velocity, samples)}
    with torch.no_grad():
        for arm, head in {**heads, **own}.items():
            found[arm] = bounded(judged(head, [samples])[0][0], samples)
    return {arm: found[arm] for arm in ARMS}


@torch.no_grad()
def _calibration(data, head) -> dict[str, float]:
    """Share of unseen samples whose error lies within the ellipsoid that should hold nine tenths."""
    inside = {"plain": [], "shared": []}
    for each in data.values():
        for samples in each.unseen:
            axes = samples.axes
            chi = torch.distributions.Chi2(torch.tensor(float(len(axes)), dtype=torch.float64))
            velocity, covariance, _ = judged(head, [samples])[0]
            told = {"plain": (samples.velocity, samples.covariance), "shared": (velocity, covariance)}
            for arm, (found, spread) in told.items():
                inside[arm].append(chi.cdf(distance(found, spread, samples)) <= 0.9)
    return {
        f"{arm}_within_90_share": float(torch.cat(parts).double().mean()) for arm, parts in inside.items()
    }


if __name__ == "__main__":
    sys.exit(main(study, Config))
