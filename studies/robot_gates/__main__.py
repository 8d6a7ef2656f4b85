"""Does it matter where the camera of a robot sits, and can it be told? What every robot and world is asked before
anything is optimised.

Four gates: the default design is off every bound; its blur disc spans at least 4 px over the view at the default
aperture; over any two of focal length, focus, height and pitch the error differs by at least a factor of 1.5 between
its tenth and ninetieth percentile; 96 samples rank two designs 10 % apart rightly in at least 95 % of draws. Errors are
typical ones: that which every sample would have at the same mean of q / (1 + q), q the squared error of the velocities
that count in units of 0.05 m/s plus a tenth of the speed, and 0.15 rad/s. Training variants, hard counts.
"""

import itertools
import sys
from dataclasses import dataclass
from typing import ClassVar

import torch

from codesign.errors import DomainError
from scenes import robot_pair
from scenes.robot_pair import Design, Drives, RobotPair
from scenes.robot_pairs import PAIRS, check_pairs
from studies.frame.run import Run, StudyConfig, main
from studies.robot_gates import figures
from studies.robot_gates.measures import (
    APART,
    DRAWN,
    LEAST_BLUR_PX,
    LEAST_FACTOR,
    LEAST_RIGHT,
    MARGIN,
    PAIRED,
    PLANES,
    VARIABLES,
    Ranking,
    blur_over,
    blur_px,
    farther,
    fit,
    margin,
    odds,
    plane,
    ranking,
    shifted,
    spread,
    surface,
    typical,
)

STEP = 0.25  # of the way to the farther bound: designs that are ranked against each other
RESAMPLED = 400
FINE = 9  # values of a variable at which the fitted landscape is read


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"worlds": 1, "motions": 2, "pool": 2}
    pair: tuple[str, ...] = tuple(PAIRS)
    """Pairs to look at."""
    worlds: int = 4
    """Training worlds of the landscape."""
    motions: int = 3
    """Drives in each of them."""
    levels: int = 3
    """Values of every variable, the default in the middle; an odd number."""
    reach: float = 0.9
    """How far towards the bounds they go."""
    pool: int = 32
    """Training worlds with 3 drives each that draws of 96 samples are made from."""


POOL_MOTIONS = 3


def study(run: Run[Config]) -> None:
    config = run.config
    check_pairs(config.pair)
    if (
        config.levels < 3
        or config.levels % 2 == 0
        or min(config.worlds, config.motions) < 1
        or config.pool < 2
    ):
        raise DomainError(
            f"levels = {config.levels} must be odd and at least 3, worlds and motions at least 1, pool at least 2."
        )
    if not 0 < config.reach < 1:
        raise DomainError(
            f"--reach is {config.reach:g}; give a share of the way to the bounds between 0 and 1."
        )
    passed = {name: gates(run, name, Judged(run, name)) for name in config.pair}
    held = sum(all(found.values()) for found in passed.values())
    run.record(pairs=len(passed), pairs_that_pass=held, seconds=run.seconds)
    short = [f"{name}: {gate}" for name, found in passed.items() for gate, kept in found.items() if not kept]
    run.finish(
        "Robots and their worlds",
        f"{held} of {len(passed)} pairs keep all four gates."
        + (f" **Missed:** {'; '.join(short)}." if short else ""),
    )


class Judged:
    """Bounded errors of designs of one pair, kept in the run's state: a resumed run makes those that are missing."""

    def __init__(self, run: Run[Config], name: str):
        self.run = run
        self.name = name
        self.pair: RobotPair = PAIRS[name]()
        self.batches: dict[tuple[int, int], Drives] = {}

    def batch(self, worlds: int, motions: int) -> Drives:
        """The first training worlds with as many drives each."""
        if (worlds, motions) not in self.batches:
            numbers = robot_pair.training(worlds)
            self.batches[worlds, motions] = self.pair.batch(numbers, motions, self.run.config.seed)
        return self.batches[worlds, motions]

    def errors(self, what: str, designs: list[Design], worlds: int, motions: int) -> torch.Tensor:
        """[designs, worlds, motions]; ``what`` names them in the state."""
        stored = self.run.load_state()
        tensors = dict(stored.tensors) if stored else {}
        key = f"{self.name} {what}"
        found = list(tensors.get(key, torch.zeros(0)))
        if len(found) == len(designs):
            return torch.stack(found)
        batch = self.batch(worlds, motions)
        with self.run.progress(len(designs), f"{self.name}: {what}", len(found)) as bar:
            for design in designs[len(found) :]:
                bounded = self.pair.judged(design, batch).bounded()
                found.append(bounded.reshape(worlds, motions))
                self.run.save_state(tensors | {key: torch.stack(found)}, {})
                bar.advance(error=typical(bounded))
        return torch.stack(found)


def gates(run: Run[Config], name: str, judged: Judged) -> dict[str, bool]:
    """Measure one pair, show it, and say which gates it keeps."""
    pair = judged.pair
    config = run.config
    small = judged.batch(config.worlds, config.motions)
    kept_off = margin(pair)
    blur = blur_over(blur_px(pair, small))
    shares = torch.linspace(-config.reach, config.reach, config.levels).tolist()
    maps, factors, samples = landscape(judged, shares)
    ranked = rankings(judged)
    near = [each for each in ranked if PAIRED[0] <= each.ratio <= PAIRED[1]] or ranked
    expected = sum(each.expected for each in near) / len(near)
    least = min(factors.values(), key=lambda each: each.value)
    found = {
        "default off its bounds": kept_off >= MARGIN,
        "blur over the view": blur.largest - blur.smallest >= LEAST_BLUR_PX,
        "landscape": least.value >= LEAST_FACTOR,
        "ranking": expected >= LEAST_RIGHT,
    }
    run.record(
        **{
            f"{name}_default_margin": kept_off,
            f"{name}_blur_smallest_px": blur.smallest,
            f"{name}_blur_largest_px": blur.largest,
            f"{name}_blur_span_px": blur.largest - blur.smallest,
            f"{name}_blur_span_in_a_frame_px": blur.frame,
            f"{name}_default_error": float(samples),
            f"{name}_least_factor": least.value,
            f"{name}_least_factor_low90": least.low,
            f"{name}_least_factor_high90": least.high,
            f"{name}_ranked_rightly_{DRAWN}": expected,
            f"{name}_ranked_rightly_least": min(each.expected for each in near),
            f"{name}_ranked_rightly_drawn": sum(each.right for each in near) / len(near),
            f"{name}_ranked_pairs": len(near),
            f"{name}_gates_kept": sum(found.values()),
        }
    )
    for names, factor in factors.items():
        label = f"{name}_factor_{'_'.join(names)}"
        run.record(**{label: factor.value, f"{label}_measured": factor.measured})
    run.card(name, f"{sum(found.values())} of {len(found)}", "gates kept")
    run.section(f"Pair '{name}'", sentence(found))
    shown = {
        "training": small,
        "unseen": pair.batch(robot_pair.unseen(1), config.motions, config.seed),
    }
    run.figure(
        figures.robot_and_frames(pair, shown),
        f"{name}_robot",
        "The robot in its own axes (m), its default camera and view; what it sees, windows outlined (gamma 2.2).",
    )
    run.table(
        "Gates",
        ("gate", "asked", "found", "kept"),
        [
            ("default off its bounds, of the range", MARGIN, kept_off, "yes" if kept_off >= MARGIN else "no"),
            (
                "blur disc over the view, px",
                LEAST_BLUR_PX,
                f"{blur.smallest:.2f} to {blur.largest:.2f}",
                "yes" if found["blur over the view"] else "no",
            ),
            (
                "ninetieth over tenth percentile, least plane",
                LEAST_FACTOR,
                f"{least.value:.2f} ({least.low:.2f} to {least.high:.2f})",
                "yes" if found["landscape"] else "no",
            ),
            (
                f"{DRAWN} samples rank designs {APART:.0%} apart",
                LEAST_RIGHT,
                expected,
                "yes" if found["ranking"] else "no",
            ),
        ],
        "In brackets: 90 % of resampled worlds. Ranking: mean over pairs of designs, by how they differ from world to "
        f"world. Within one frame the blur disc spans {blur.frame:.2f} px in the median.",
    )
    run.table(
        "Landscape over two variables",
        ("variables", "ninetieth over tenth percentile", "resampled, 5 %", "95 %", "as measured"),
        [
            (" and ".join(figures.LABELS[n] for n in names), f.value, f.low, f.high, f.measured)
            for names, f in factors.items()
        ],
        "Few samples leave noise that spreads a landscape; the factor is that of a second-order polynomial in the four "
        "variables, fitted to the logarithm of all errors measured.",
    )
    run.figure(
        figures.landscape(pair, config.reach, maps),
        f"{name}_landscape",
        f"Typical error over two variables, the others at the default (cross): a second-order polynomial through "
        f"{config.worlds * config.motions} samples of every design measured.",
    )
    run.figure(
        figures.rankings(ranked),
        f"{name}_ranking",
        "How often draws of worlds rank two designs as all of them do.",
    )
    return found


def sentence(found: dict[str, bool]) -> str:
    """Which gates are kept."""
    short = [gate for gate, kept in found.items() if not kept]
    return "All four gates are kept." if not short else f"**Missed: {', '.join(short)}.**"


@dataclass(frozen=True)
class Factor:
    """Ninetieth over tenth percentile of a landscape: smoothed, with 5 and 95 % of resampled worlds, and as measured."""

    value: float
    low: float
    high: float
    measured: float


def landscape(
    judged: Judged, shares: list[float]
) -> tuple[dict[tuple[str, str], torch.Tensor], dict[tuple[str, str], Factor], float]:
    """Maps [FINE, FINE] of the typical error per plane, the factor of each, and the default's error. Designs on the
    crosses of planes are shared."""
    config = judged.run.config
    points: dict[tuple[tuple[str, float], ...], int] = {}

    def index(**at):
        key = tuple((name, at[name]) for name in VARIABLES if at.get(name, 0.0) != 0.0)
        return points.setdefault(key, len(points))

    middle = config.levels // 2
    exact = [0.0 if k == middle else share for k, share in enumerate(shares)]
    default = index()
    grids = {
        (first, second): torch.tensor([[index(**{first: a, second: b}) for b in exact] for a in exact])
        for first, second in PLANES
    }
    designs = [shifted(judged.pair, **dict(key)) for key in points]
    bounded = judged.errors("landscape", designs, config.worlds, config.motions).double()
    at = torch.tensor([[dict(key).get(name, 0.0) for name in VARIABLES] for key in points]).double()
    generator = torch.Generator().manual_seed(config.seed)
    picked = torch.randint(config.worlds, (RESAMPLED, config.worlds), generator=generator)
    means = bounded.mean(2)
    errors = odds(means.mean(1))
    fitted = fit(at, errors[:, None])
    again = fit(at, odds(means[:, picked].mean(2)))  # one column for each resampling
    maps = {}
    factors = {}
    for names, grid in grids.items():
        fine = plane(names, shares[-1], FINE)
        maps[names] = surface(fitted, fine).reshape(FINE, FINE)
        drawn = spread(surface(again, fine))
        low, high = torch.quantile(drawn, torch.tensor([0.05, 0.95]).double()).tolist()
        measured = float(spread(errors[grid].reshape(-1, 1)))
        factors[names] = Factor(float(spread(maps[names].reshape(-1, 1))), low, high, measured)
    return maps, factors, float(errors[default])


def rankings(judged: Judged) -> list[Ranking]:
    """Rankings of all pairs out of the default and its neighbours."""
    config = judged.run.config
    designs = [judged.pair.design]
    designs += [shifted(judged.pair, **{name: STEP * farther(judged.pair, name)}) for name in VARIABLES]
    bounded = judged.errors("ranking", designs, config.pool, POOL_MOTIONS)
    generator = torch.Generator().manual_seed(config.seed)
    return [ranking(a, b, generator) for a, b in itertools.combinations(bounded, 2)]


if __name__ == "__main__":
    sys.exit(main(study, Config))
