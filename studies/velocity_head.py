"""One velocity head for every design of a camera on a robot.

It sees lens and mount, and is trained on designs drawn all over the bounds of the pairs, by the
hard sensor. A quarter of the worlds chooses when to stop, and shows the head beside least squares.
A resumed run renders what is missing.
"""

import functools
import math
import sys
from dataclasses import asdict, dataclass, fields, replace
from typing import ClassVar

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from codesign import train
from codesign.errors import DomainError
from codesign.flow import checkpoint
from codesign.mount import EgoVelocity, Evidence, VelocityHead, velocity_errors
from codesign.report.prose import counted
from scenes.robots import pair as robot_pair
from scenes.robots.pair import Design, RobotPair
from scenes.robots.pairs import PAIRS, check_pairs
from studies.frame.compare import log_ratio
from studies.frame.config import check_least
from studies.frame.run import Run, StudyConfig, main

AT_ONCE = 6  # drives in each world, rendered together: 8 million rays for every 12 samples
DRIVES = 96  # of each world, out of which designs take theirs
MARGIN = 0.03  # of the bounds' range that designs keep from them
CLAIM = 0.05  # weight of the likelihood beside the bounded error
RATE = 3e-3
TAILS = 5.0  # degrees of freedom of Student's t, which forgives lost samples


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"pair": ("corridor",), "designs": 6, "worlds": 2, "steps": 60}
    pair: tuple[str, ...] = tuple(PAIRS)
    """Pairs whose designs one head serves."""
    designs: int = 40
    """Designs of each pair."""
    worlds: int = 8
    """Training worlds of each pair; a quarter of them chooses when to stop."""
    motions: int = 3
    """Drives of a design in every world."""
    steps: int = 900
    """Of AdamW."""
    batch: int = 192
    """Samples a step."""
    width: int = 32
    """Of the layers."""


@dataclass(frozen=True)
class Samples:
    """Evidence of N bodies, their true twists [N, 6], and the velocities that count."""

    seen: Evidence
    twist: Tensor
    axes: tuple[int, ...]

    def __getitem__(self, which: Tensor | slice) -> "Samples":
        return Samples(self.seen[which], self.twist[which], self.axes)


def study(run: Run[Config]) -> None:
    config = run.config
    check(config)
    lessons, held_out = zip(*(samples(run, PAIRS[name]()) for name in config.pair), strict=True)
    torch.manual_seed(config.seed)
    head = VelocityHead(EgoVelocity(tuple(range(6)), (1.0,) * 6), config.width)
    # fresh weights are least squares as it is
    plain = [errors(head, each) for each in held_out]
    fit(head, lessons, held_out, config)
    content = {name: str(value) for name, value in asdict(config).items()}
    head.save(run.path("head.safetensors"), {"config": content, "run": "studies.velocity_head"})
    ours = [errors(head, each) for each in held_out]
    said = []
    for name, *both in zip(config.pair, plain, ours, strict=True):
        before, after = map(typical, both)
        by_design = [each.unflatten(0, (config.designs, -1)).mean(1).tolist() for each in both]
        over = log_ratio(by_design[1], by_design[0])
        run.record(**{f"{name}_plain_error": before, f"{name}_head_error": after})
        run.record(**over.metrics(f"{name}_log_ratio"))
        run.card(name, f"{after:.2f}", f"typical error; {before:.2f} by least squares")
        said.append(
            f"{over.outcome} in '{name}' ({counted(len(both[0]), 'sample')} of {counted(over.count, 'design')}: bounded error "
            f"{over.percent()})"
        )
    run.finish(
        "One velocity head for all designs",
        f"Against least squares, in worlds that were kept from training, the one head {', '.join(said)}.",
    )


def check(config: Config) -> None:
    """Raises: DomainError for pairs that are unknown, and sizes out of range."""
    check_pairs(config.pair)
    check_least(config, 1, "designs", "steps", "batch", "width")
    check_least(config, 2, "worlds")
    if not 1 <= config.motions <= AT_ONCE:
        raise DomainError(f"--motions is {config.motions}; a design has 1 to {AT_ONCE} in a world.")


def designs(pair: RobotPair, count: int, seed: int) -> list[Design]:
    """Spread evenly over the bounds, focal lengths by their logarithm."""
    names = [
        f.name for f in fields(Design) if getattr(pair.low, f.name) < getattr(pair.high, f.name)
    ]
    found = []
    for shares in SobolEngine(len(names), scramble=True, seed=seed).draw(count).double().tolist():
        numbers = {}
        for name, share in zip(names, shares, strict=True):
            low, high = getattr(pair.low, name), getattr(pair.high, name)
            at = MARGIN + (1 - 2 * MARGIN) * share
            even = low + (high - low) * at
            numbers[name] = low * (high / low) ** at if name == "efl_mm" else even
        found.append(pair.check(replace(pair.design, **numbers)))
    return found


def samples(run: Run[Config], pair: RobotPair) -> tuple[Samples, Samples]:
    """Of all designs of a pair: those to train on, and those of the last quarter of the worlds."""
    config = run.config
    pair = replace(pair, world=functools.cache(pair.world), drive=functools.cache(pair.drive))
    parts: list[Samples] = []
    with run.progress(config.designs, f"{pair.name}: samples") as bar:
        for index, design in enumerate(designs(pair, config.designs, config.seed)):
            path = run.folder / "samples" / f"{pair.name}_{index:03d}.safetensors"
            if not path.exists():
                path.parent.mkdir(exist_ok=True)
                found = rendered(pair, design, index, config)
                checkpoint.write_tensors(path, found, {"kind": "evidence"})
            stored, _ = checkpoint.read_tensors(path)
            seen = Evidence(*(stored[f.name].double() for f in fields(Evidence)))
            parts.append(Samples(seen, stored["twist"].double(), pair.axes))
            bar.advance()
    seen = Evidence.joined([part.seen for part in parts])
    first = config.worlds - max(1, config.worlds // 4)  # of those to choose by
    world = torch.arange(config.worlds).repeat_interleave(config.motions).repeat(config.designs)
    every = Samples(seen, torch.cat([part.twist for part in parts]), pair.axes)
    return every[world < first], every[world >= first]


@torch.no_grad()
def rendered(pair: RobotPair, design: Design, index: int, config: Config) -> dict[str, Tensor]:
    """What a head hears of a design, by the name of its field, and "twist"; every design has drives
    of its own."""
    first = index * config.motions % (DRIVES - config.motions + 1)

    def drive(number, count):
        poses, twist = pair.drive(number, DRIVES)
        return poses[first : first + count], twist[first : first + count]

    numbers = robot_pair.training(config.worlds)
    batch = replace(pair, drive=drive).batch(numbers, config.motions, config.seed + first)
    plain = EgoVelocity(tuple(range(6)), pair.prior, pair.depth)
    system = pair.system(design, "sensor").replaced(estimate=VelocityHead(plain).evidence)
    seen = system.begin(batch)["estimate"]
    return {f.name: getattr(seen, f.name).float() for f in fields(seen)} | {
        "twist": batch.twist.float()
    }


def bounded(velocity: Tensor, samples: Samples) -> Tensor:
    """[N]: the error of the task, q / (1 + q)."""
    axes = list(samples.axes)
    return velocity_errors(velocity[:, axes], samples.twist, axes).bounded()


@torch.no_grad()
def errors(head: VelocityHead, samples: Samples) -> Tensor:
    """[N]: the bounded errors of a head."""
    return bounded(head.judged(samples.seen)[0], samples)


def typical(errors: Tensor) -> float:
    """The error, in units of the task, that all samples would have at their mean bounded one."""
    mean = float(errors.mean())
    return math.sqrt(mean / (1 - mean))


def unlikelihood(velocity: Tensor, covariance: Tensor, samples: Samples) -> Tensor:
    """[N]: negative logarithm of the likelihood under Student's t, up to a constant."""
    axes = list(samples.axes)
    miss, spread = (velocity - samples.twist)[:, axes], covariance[:, axes][:, :, axes]
    distance = (torch.linalg.solve(spread, miss[..., None])[..., 0] * miss).sum(1)
    return torch.logdet(spread) / 2 + (TAILS + len(axes)) / 2 * torch.log1p(distance / TAILS)


def lesson(predictions: list[tuple[Tensor, ...]], batch: list[Samples]) -> Tensor:
    """Loss: bounded error and likelihood, a mean over pairs."""
    losses = []
    for (velocity, covariance, _), samples in zip(predictions, batch, strict=True):
        claim = unlikelihood(velocity, covariance, samples).mean()
        losses.append(bounded(velocity, samples).mean() + CLAIM * claim)
    return torch.stack(losses).mean()


def fit(head: VelocityHead, lessons, held_out, config: Config) -> None:
    """Train on samples of each pair in equal shares; of the weights on its way those that judge
    best."""
    generator = torch.Generator().manual_seed(config.seed)

    def judged(network, batch):
        return [network.judged(samples.seen) for samples in batch]

    def draw(step):
        each = max(1, config.batch // len(lessons))
        return [
            part[torch.randint(len(part.twist), (each,), generator=generator)] for part in lessons
        ]

    train.fit(
        head,
        draw,
        steps=config.steps,
        loss=lesson,
        predict=judged,
        optimiser=torch.optim.AdamW(head.parameters(), RATE, weight_decay=1e-3),
        clip=1.0,
        validate=lambda network: float(lesson(judged(network, held_out), held_out)),
        validate_every=math.ceil(config.steps / 12),
        seed=config.seed,
    )
    head.eval()


if __name__ == "__main__":
    sys.exit(main(study, Config))
