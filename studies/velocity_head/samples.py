"""Designs of a pair, and what a velocity head gets of them: rendered once, judged by the hard sensor, kept as
evidence."""

import functools
from dataclasses import dataclass, fields, replace
from pathlib import Path

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from codesign import task
from codesign.flow import checkpoint
from scenes.robot_pair import Design, RobotPair

AT_ONCE = 6  # motions in each world, rendered together: 8 million rays for every 12 samples
DRIVES = 96  # of each world, out of which designs take theirs
MARGIN = 0.03  # of the bounds' range that designs keep from them


@dataclass(frozen=True)
class Samples:
    """Evidence of N bodies, their true twists [N, 6], and what plain least squares makes of them: velocities [N, 6] and
    covariances [N, 6, 6]. Samples of one world are neighbours. axes: the velocities that count."""

    seen: task.Evidence
    twist: Tensor
    velocity: Tensor
    covariance: Tensor
    axes: tuple[int, ...]

    def __getitem__(self, which: Tensor | slice) -> "Samples":
        parts = (self.seen[which], self.twist[which], self.velocity[which], self.covariance[which])
        return Samples(*parts, self.axes)

    @staticmethod
    def joined(parts: "list[Samples]") -> "Samples":
        """Those of several designs of a pair."""
        several = (
            torch.cat([getattr(each, n) for each in parts]) for n in ("twist", "velocity", "covariance")
        )
        return Samples(task.Evidence.joined([each.seen for each in parts]), *several, parts[0].axes)


def designs(pair: RobotPair, count: int, seed: int) -> list[Design]:
    """Spread evenly over the bounds, focal lengths by their logarithm."""
    names = [f.name for f in fields(Design) if getattr(pair.low, f.name) < getattr(pair.high, f.name)]
    found = []
    for shares in SobolEngine(len(names), scramble=True, seed=seed).draw(count).double().tolist():
        numbers = {}
        for name, share in zip(names, shares, strict=True):
            low, high = getattr(pair.low, name), getattr(pair.high, name)
            at = MARGIN + (1 - 2 * MARGIN) * share
            numbers[name] = low * (high / low) ** at if name == "efl_mm" else low + (high - low) * at
        found.append(pair.check(replace(pair.design, **numbers)))
    return found


class Drawn:
    """Samples of designs in worlds of a pair; worlds are made once, and every design has drives of its own.

    Args: folder: where samples are kept, a file for each design; one that is there is read instead.
    """

    def __init__(self, pair: RobotPair, numbers: range, folder: Path, seed: int):
        self.numbers = numbers
        self.folder = folder
        self.seed = seed
        self.plain = task.EgoVelocity(tuple(range(6)), pair.prior, pair.depth)
        self.head = task.VelocityHead(self.plain)
        self.world = functools.cache(pair.world)
        self.drives = functools.cache(functools.partial(_drives, pair))
        self.pair = pair

    def samples(self, kind: str, index: int, design: Design, motions: int) -> Samples:
        """Of the design with this number among those of a kind, ``motions`` in each world."""
        path = self.folder / f"{self.pair.name}_{kind}_{index:03d}.safetensors"
        if not path.exists():
            made = self._made(design, index, motions)
            tensors = {f"seen/{f.name}": getattr(made.seen, f.name).float() for f in fields(task.Evidence)}
            tensors |= {name: getattr(made, name).float() for name in ("twist", "velocity", "covariance")}
            self.folder.mkdir(parents=True, exist_ok=True)
            checkpoint.write_tensors(path, tensors, {"kind": "evidence"})
        tensors = {name: tensor.double() for name, tensor in checkpoint.read_tensors(path)[0].items()}
        seen = task.Evidence(*(tensors[f"seen/{f.name}"] for f in fields(task.Evidence)))
        return Samples(seen, tensors["twist"], tensors["velocity"], tensors["covariance"], self.pair.axes)

    @torch.no_grad()
    def _made(self, design, index, motions):
        offset = index * motions % (DRIVES - motions + 1)
        firsts = range(offset, offset + motions, AT_ONCE)
        parts = [self._part(design, first, min(AT_ONCE, offset + motions - first)) for first in firsts]
        joined = Samples.joined(parts)
        worlds = len(self.numbers)
        order = torch.cat([place.reshape(worlds, -1) for place in _places(parts)], 1)
        return joined[order.flatten()]

    def _part(self, design, first, motions):
        def drive(number, count):
            poses, twist = self.drives(number)
            return poses[first : first + count], twist[first : first + count]

        batch = replace(self.pair, world=self.world, drive=drive).batch(
            self.numbers, motions, self.seed + first
        )
        system = self.pair.system(design, "sensor")
        seen = system.replaced(estimate=self.head.evidence).begin(batch)["estimate"]
        velocity, covariance, _ = self.head.judged(seen)
        return Samples(seen, batch.twist, velocity, covariance, self.pair.axes)


def _places(parts):
    """Where the samples of each part are once parts are joined."""
    count = [len(part.twist) for part in parts]
    return torch.arange(sum(count)).split(count)


def _drives(pair, number):
    return pair.drive(number, DRIVES)
