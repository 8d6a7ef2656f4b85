"""What should a placement descend? Objectives beside the errors of the hard sensor: how they rank designs, where their
gradients point, and what a sure direction costs.

Ranking: mounts spread over the pair's bounds behind two lenses; what is expected of each on training worlds (the default
objective, and the information of the estimator's own covariance alone) against its errors with single events in worlds
never seen. Gradients: at random mounts, of the error straight through the events; of what is expected through frames and
events; its slope through geometry, trend of the precision and cover by the robot, at the mount and in the mean along the
steps (three Gauss points); and the default, differences over geometry alone with the precision carried over by the trend.
All against differences over a quarter of the bounds of what is expected and of hard errors, every picture rendered, in the
same draws.
"""

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, TypeAlias

import torch
from scipy.stats import spearmanr
from torch import Tensor
from torch.quasirandom import SobolEngine

from codesign import place, task
from codesign.errors import DomainError
from codesign.place.criterion import LINEAR
from scenes import robot_pair
from scenes.robot_pair import RATE_RAD_S
from scenes.robot_pairs import PAIRS, check_pairs
from studies.frame.run import Run, StudyConfig, main
from studies.placement.problem import Problem, Samples, traced_camera
from studies.placement.race import STEP

Way: TypeAlias = Callable[[Problem, Tensor, Samples], tuple[Tensor, ...]]
LENSES = {"pair's own": None, "wide, near": (3.5, 2.0)}  # focal length mm, focus 1/m
NODE, MIDDLE, ENDS = math.sqrt(3 / 5), 8 / 18, 5 / 18  # of Gauss and Legendre's rule with three points
DEFAULT, DIFFERENCES, HARD = "expected, default", "differences, expected", "differences, hard"
UNIT_M_S, UNIT_RAD_S = 0.1, 0.15  # errors that count 1 of the criterion


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"pair": ("corridor",), "designs": 6, "judged": 2, "points": 1, "draws": 2}
    pair: tuple[str, ...] = tuple(PAIRS)
    """Pairs to look at."""
    designs: int = 40
    """Mounts behind each of two lenses; 0 for no ranking."""
    judged: int = 8
    """Unseen worlds of 12 drives each that designs are judged in."""
    points: int = 3
    """Mounts at which gradients are looked at, the first the pair's own."""
    draws: int = 8
    """Draws of 24 samples for each gradient."""
    ways: tuple[str, ...] = ()
    """Ways to the gradient that stand beside the default and the differences, such as "expected, slope"; all when left out."""
    lens: str = "cooke-triplet"
    """Traced lens through which gradients are looked at, scaled to the pair's focal length; "none": the pair's thin one."""


def study(run: Run[Config]) -> None:
    size = run.config
    check_pairs(size.pair)
    if size.draws < 2 or size.designs < 0 or size.designs == 1 or min(size.judged, size.points) < 1:
        raise DomainError(
            "--draws needs at least 2, --designs 0 or at least 2, --judged and --points at least 1."
        )
    for way in size.ways:
        if way not in WAYS:
            raise DomainError(f"--ways {way!r}: choose from {'; '.join(WAYS)}.")
    stored = run.load_state()
    kept: dict[str, Tensor] = dict(stored.tensors) if stored else {}
    said = []
    for name in size.pair:
        run.section(f"Pair '{name}'")
        ranked = f"rank correlation {ranking(run, kept, name):.2f}, " if size.designs else ""
        said.append(f"{name} {ranked}cosine {gradients(run, kept, name):.2f}")
    run.record(seconds=run.seconds)
    run.finish(
        "What a placement should descend",
        "The expected error: Spearman's rank correlation with errors of the hard sensor on unseen worlds, and the cosine of "
        f"its gradient with differences: {'; '.join(said)}.",
    )


def once(run: Run[Config], kept: dict[str, Tensor], key: str, make: Callable[[], Tensor]) -> Tensor:
    """What an earlier session made, or what is made and kept now."""
    if key not in kept:
        kept[key] = make().double()
        run.save_state(kept, {})
    return kept[key]


def problems(name: str, lens: str, judged: int) -> tuple[Problem, Problem]:
    """To expect in, and to judge in."""
    pair = PAIRS[name]()
    if (chosen := LENSES[lens]) is not None:
        pair = replace(pair, design=replace(pair.design, efl_mm=chosen[0], focus_per_m=chosen[1]))
    return (
        Problem(pair, robot_pair.training(8), 8, 6),
        Problem(pair, robot_pair.unseen(judged), judged, 12),
    )


def ranking(run: Run[Config], kept: dict[str, Tensor], name: str) -> float:
    """Rank correlations with hard errors; returns that of the default objective."""
    size = run.config
    shares = 0.05 + 0.9 * SobolEngine(6, scramble=True, seed=size.seed).draw(
        size.designs, dtype=torch.float64
    )
    rows = []
    with run.progress(len(LENSES) * size.designs, f"{name}: ranking") as bar:
        for lens in LENSES:
            training, unseen = problems(name, lens, size.judged)
            for number, share in enumerate(shares):
                found = once(
                    run,
                    kept,
                    f"{name}/ranking/{lens}/{number}",
                    lambda share=share, training=training, unseen=unseen: judgements(training, unseen, share),
                )
                rows.append(found)
                bar.advance(error=float(found[0]))
    table = torch.stack(rows)
    hard, halves, ours, alone = table[:, 0], table[:, 1:3], table[:, 3], table[:, 4]
    agree = spearmanr(halves[:, 0], halves[:, 1])[0]
    found = {
        "expected": spearmanr(hard, ours)[0],
        "observability": spearmanr(hard, alone)[0],
        "halves": agree,
        "ceiling": math.sqrt(max(0.0, 2 * agree / (1 + agree))),
    }
    run.record(**{f"{name}_spearman_{key}": value for key, value in found.items()})
    run.table(
        "Rank correlation with errors of the hard sensor",
        ("objective", "Spearman"),
        [
            ["expected error (default)", found["expected"]],
            ["information of the estimator's own covariance alone", found["observability"]],
            ["one half of the samples that judge with the other", found["halves"]],
            ["what a perfect objective would have, by that", found["ceiling"]],
        ],
        f"{len(table)} designs, {size.designs} mounts behind two lenses; errors from {float(hard.min()):.2f} to {float(hard.max()):.2f}.",
    )
    return float(found["expected"])


def judgements(training: Problem, unseen: Problem, share: Tensor) -> Tensor:
    """[5]: hard error, of either half of its samples, expected error, and that of the information alone."""
    mount = training.ranges.pose(share)
    hard = unseen.judged(mount, unseen.draw(0), "sensor").bounded()
    samples = training.draw(0)
    with torch.no_grad():
        ours = training.expected(mount, samples).mean()
        batch = training.batch(samples)
        told = training.system(mount).begin(batch)["estimate"]
        axes = list(training.pair.axes)
        unit = [UNIT_M_S if axis < LINEAR else UNIT_RAD_S for axis in axes]
        prior = [max(training.pair.prior[axis], RATE_RAD_S if axis >= LINEAR else 0.1) for axis in axes]
        covariance = told.covariance[:, axes][:, :, axes]
        information = torch.linalg.inv(covariance) - torch.diag(torch.tensor(prior).double() ** -2)
        alone = place.expected_error(information, unit, prior).square()
    return torch.stack([hard.mean(), hard[::2].mean(), hard[1::2].mean(), ours, (alone / (1 + alone)).mean()])


def gradients(run: Run[Config], kept: dict[str, Tensor], name: str) -> float:
    """Cosines, lengths, noise and cost of the ways to a gradient; returns the cosine of the one in question."""
    size = run.config
    asked = {*(size.ways or WAYS), DEFAULT, DIFFERENCES}
    ways = {way: slope for way, slope in WAYS.items() if way in asked}
    pair = PAIRS[name]()
    camera = pair.design.camera() if size.lens == "none" else traced_camera(pair, size.lens)
    problem = Problem(pair, robot_pair.training(12), camera=camera)
    random = torch.Generator().manual_seed(size.seed + 5)
    points = [problem.start]
    points += [
        0.15 + 0.7 * torch.rand(6, generator=random, dtype=torch.float64) for _ in range(size.points - 1)
    ]
    rows = []
    slopes: dict[str, list[Tensor]] = {}
    costs: dict[str, list[float]] = {}
    with run.progress(size.points * size.draws, f"{name}: gradients") as bar:
        for number, point in enumerate(points):
            trend_of(problem, point)
            draws = [
                drawn_ways(
                    run, kept, f"{name}/gradient/{number}/{draw}", ways, problem, point, problem.draw(draw)
                )
                for draw in stepped(bar, size.draws)
            ]
            found = torch.stack(draws)  # [draws, ways, 7]: gradient and processor seconds
            for index, way in enumerate((*ways, HARD)):  # differences are two
                slopes.setdefault(way, []).append(found[:, index, :6])
                costs.setdefault(way, []).append(float(found[1:, index, 6].mean()))
    drawn = {way: torch.cat(parts, 1) for way, parts in slopes.items()}  # [draws, 6 points]
    wide, hard = drawn[DIFFERENCES].mean(0), drawn[HARD].mean(0)
    for way, each in drawn.items():
        ours, missed = each.mean(0), each - drawn[DIFFERENCES]
        cost = sum(costs[way]) / len(costs[way])
        sure = float(ours.norm() / spread(each))
        values = {
            "cosine_expected": cosine(ours, wide),
            "cosine_hard": cosine(ours, hard),
            "length_over_expected": float(ours.norm() / wide.norm()),
            "relative_l2": float(missed.mean(0).norm() / wide.norm()),
            "relative_l2_noise": spread(missed) / math.sqrt(size.draws) / float(wide.norm()),
            "signal_over_noise": sure,
            "cpu_s": cost,
            "signal_over_noise_per_root_cpu_s": sure / math.sqrt(cost),
        }
        label = way.replace(",", "").replace(" ", "_").replace("-", "_")
        run.record(**{f"{name}_{label}_{key}": value for key, value in values.items()})
        rows.append([way, *values.values()])
    run.table(
        "Ways to the gradient",
        (
            "way",
            "cosine, expected",
            "cosine, hard",
            "length",
            "relative L2",
            "of it noise",
            "signal/noise",
            "CPU-s",
            "signal/noise per root CPU-s",
        ),
        rows,
        f"At {len(points)} mounts together, mean of {size.draws} draws of {problem.samples} samples. Cosines with differences "
        "over a quarter of the bounds of what is expected and of hard errors; length over that of the former; signal over "
        "noise of one draw.",
    )
    return cosine(drawn[DEFAULT].mean(0), wide)


def stepped(bar, count):
    """Numbers of draws, the bar moved after each."""
    for draw in range(count):
        yield draw
        bar.advance()


@torch.no_grad()
def trend_of(problem: Problem, point: Tensor) -> None:
    """Fit the trend of precision at a point and a step to all sides, on other draws than those that are looked at."""
    problem.trend = task.PrecisionTrend()
    steps = STEP * torch.cat([torch.zeros(1, 6), torch.eye(6), -torch.eye(6)]).double()
    for draw, step in enumerate(steps):
        problem.expected(problem.ranges.pose(point + step), problem.draw(1000 + draw), learn=True)


def drawn_ways(
    run: Run[Config],
    kept: dict[str, Tensor],
    key: str,
    ways: dict[str, Way],
    problem: Problem,
    point: Tensor,
    samples: Samples,
) -> Tensor:
    """[ways, 7]: gradients to the shares, and processor seconds of each."""

    def rows(way):
        began = time.process_time()
        slopes = torch.stack(way(problem, point, samples))
        seconds = (time.process_time() - began) / len(slopes)
        return torch.cat([slopes, slopes.new_full((len(slopes), 1), seconds)], 1)

    return torch.cat([once(run, kept, f"{key}/{name}", partial(rows, way)) for name, way in ways.items()])


def _straight(problem, point, samples):
    share = point.clone().requires_grad_()
    batch = problem.batch(samples)
    told = problem.system(problem.ranges.pose(share)).begin(batch)["estimate"]
    return torch.autograd.grad(problem.pair.errors(told, batch).bounded().mean(), share)


def _through_frames(problem, point, samples):
    share = point.clone().requires_grad_()
    value = problem.expected(problem.ranges.pose(share), samples, frames=True)
    return torch.autograd.grad(value.mean(), share)


def _slope(problem, point, samples):
    share = point.clone().requires_grad_()
    return torch.autograd.grad(problem.expected(problem.ranges.pose(share), samples).mean(), share)


def _along(problem, point, samples):
    """The mean of the slope along the way of every difference."""
    middle = _slope(problem, point, samples)[0]
    found = MIDDLE * middle
    for index, direction in enumerate(STEP * torch.eye(6, dtype=torch.float64)):
        for sign in (-1, 1):
            found[index] += ENDS * _slope(problem, point + sign * NODE * direction, samples)[0][index]
    return (found,)


def _default(problem, point, samples):
    return (problem.expected_around(point, samples, STEP)[1],)


def _differences(problem, point, samples):
    """Of what is expected, and of hard errors."""
    found = []
    for direction in STEP * torch.eye(6, dtype=torch.float64):
        low, high = (
            problem.expected_and_hard(problem.ranges.pose(point + sign * direction), samples).mean(1)
            for sign in (-1, 1)
        )
        found.append((high - low) / (2 * STEP))
    return tuple(torch.stack(found, 1))


WAYS: dict[str, Way] = {
    "straight through, bounded error": _straight,
    "expected, through frames": _through_frames,
    "expected, slope": _slope,
    "expected, mean slope along the steps": _along,
    DEFAULT: _default,
    DIFFERENCES: _differences,
}


def spread(drawn: Tensor) -> float:
    """Root mean square distance of vectors [draws, N] from their mean."""
    return math.sqrt(float(drawn.var(0).sum()))


def cosine(a: Tensor, b: Tensor) -> float:
    """Of two vectors."""
    return float(torch.cosine_similarity(a, b, dim=0))


if __name__ == "__main__":
    sys.exit(main(study, Config))
