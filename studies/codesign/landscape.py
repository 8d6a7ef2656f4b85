"""Is there anything to design, and does the objective rank it? Hard and expected errors of designs
all over the bounds, of others near the best of them, and along every number through the best,
before any race."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import scipy
import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from codesign.atomic import write_atomic
from codesign.errors import DomainError
from codesign.flow import checkpoint
from codesign.mount import FlowErrors, Readings
from studies.codesign import couplings
from studies.codesign.calibration import Calibration, Conditions, fitted
from studies.codesign.design import Space
from studies.codesign.problem import Drawn, Seen
from studies.codesign.race import kept, spread_over
from studies.frame.run import Run
from studies.frame.sweep import Row, sweep

MOST_REFUSED = 200  # designs drawn for each that keeps what is required
LOOKED = 12_345  # number of the draw
FIRST_WORLD = 500  # of those that no arm is trained in
BEST = 8  # designs, near which others are drawn
NEAR = 0.12  # of the cube, standard deviation
ENOUGH = 64  # designs, from which a calibration is fitted


@dataclass(frozen=True)
class Landscape:
    """designs: rows of hard and expected errors all over the bounds; near: near the best of them;
    grid: along every number through the best. calibration: by which errors were expected."""

    designs: list[Row]
    near: list[Row]
    grid: list[Row]
    calibration: Calibration

    @property
    def best(self) -> Tensor:
        """Shares [V] of the least hard error."""
        return couplings.share(self.best_row)

    @property
    def best_row(self) -> Row:
        """The row of the least hard error."""
        return min(self.designs + self.near, key=lambda row: row["hard"])

    @property
    def spread(self) -> float:
        """Ninetieth over tenth percentile of hard errors over the designs."""
        errors = torch.tensor([row["hard"] for row in self.designs], dtype=torch.float64)
        low, high = torch.quantile(errors, torch.tensor([0.1, 0.9], dtype=torch.float64)).tolist()
        return high / low

    @property
    def judged(self) -> list[Row]:
        """Designs near the best that no calibration was fitted to."""
        return self.near[1::2] if len(self.near) > 3 else self.near

    @property
    def rank(self) -> float | None:
        """Spearman's correlation of expected and hard errors over them."""
        return ranked(*([row[name] for row in self.judged] for name in ("expected", "hard")))

    @property
    def slope(self) -> float | None:
        """Of hard errors over expected ones, over them; None where these are all alike."""
        expected, hard = ([row[name] for row in self.judged] for name in ("expected", "hard"))
        alike = len(set(expected)) < 2
        return None if alike else float(scipy.stats.linregress(expected, hard).slope)

    def csv(self, space: Space) -> str:
        """Every design: where it was drawn, its numbers, and its errors; "near" are those that
        judge the fit."""
        lines = [",".join(("drawn", *space.free, "hard", "expected"))]
        for kind, rows in (
            ("all over", self.designs),
            ("near, fitted", self.near[::2]),
            ("near", self.near[1::2]),
        ):
            for row in rows:
                numbers = space.numbers(couplings.share(row))
                values = [numbers[name] for name in space.free] + [row["hard"], row["expected"]]
                lines.append(f'"{kind}",' + ",".join(f"{value:.5g}" for value in values))
        return "\n".join(lines) + "\n"

    def inside(self, name: str) -> bool:
        """Whether the best of a number's grid lies off its bounds."""
        rows = [row for row in self.grid if row["number_of"] == name and row["hard"] is not None]
        return bool(rows) and 0 < min(rows, key=lambda row: row["hard"])["at"] < 1


def ranked(one: Sequence[float], other: Sequence[float]) -> float | None:
    """Spearman's correlation; None where fewer than three, or all alike, tell none."""
    if len(one) < 3 or len(set(one)) == 1 or len(set(other)) == 1:
        return None
    return float(scipy.stats.spearmanr(one, other)[0])


def all_over(space: Space, count: int) -> list[Tensor]:
    """Shares [V] spread evenly over what is allowed."""
    requirements = space.pair.requirements()
    drawn = SobolEngine(len(space.free), scramble=True, seed=3).draw(
        MOST_REFUSED * count, dtype=torch.float64
    )
    found: list[Tensor] = []
    for share in drawn:
        if len(found) < count and kept(space, share, requirements):
            found.append(share)
    if len(found) < count:
        raise DomainError(
            f"of {len(drawn)} designs of '{space.pair.name}' {len(found)} keep what is required and {count} are needed; widen "
            "the bounds, or give fewer --designs."
        )
    return found


def near_by(space: Space, best: list[Tensor], count: int) -> list[Tensor]:
    """Shares [V] at random near some."""
    requirements = space.pair.requirements()
    generator = torch.Generator().manual_seed(5)
    found: list[Tensor] = []
    while len(found) < count:
        middle = best[int(torch.randint(len(best), (1,), generator=generator))]
        away = NEAR * torch.randn(len(space.free), generator=generator, dtype=torch.float64)
        share = (middle + away).clamp(0, 1)
        if kept(space, share, requirements):
            found.append(share)
    return found


class Looks:
    """Designs looked at: the rows of a sweep, and beside them what expected errors are made of, in
    files."""

    def __init__(self, run: Run[Any], space: Space) -> None:
        size = run.config
        numbers = range(FIRST_WORLD, FIRST_WORLD + size.worlds)
        self.run = run
        self.drawn = Drawn(space, numbers, *spread_over(size.worlds, size.per_draw))
        self.space = space

    def row(self, name: str, share: Tensor) -> Row:
        """Hard errors of single events and of the memory layer; the expected one without
        calibration; by how much blur differs over the windows of a drive."""
        whole = self.space.made(share)
        looked = self.drawn.looked(whole, self.drawn.draw(LOOKED))
        single = looked.again(whole, "sensor")
        path = self.run.path(f"looks/{name}.safetensors")
        path.parent.mkdir(exist_ok=True)
        conditions = {key: float(value) for key, value in vars(looked.conditions).items()}
        checkpoint.write_tensors(
            path, _flat(looked.seen), {"windows": looked.seen.read.windows, **conditions}
        )
        hard = torch.cat([single.hard(), looked.hard()]).mean()
        plain = self.drawn.expected(looked.seen, looked.seen.read, FlowErrors()).mean()
        # diameters of even discs of that root mean square radius
        blur_px = 8**0.5 * looked.optics[..., 1].expm1()
        span = (blur_px.amax(1) - blur_px.amin(1)).median()
        row = {"share": share.tolist(), "hard": float(hard), "plain": float(plain)}
        return {**row, "blur_span_px": float(span)}

    def stored(self, name: str) -> tuple[Seen, Conditions]:
        """What was seen of a design."""
        tensors, content = checkpoint.read_tensors(self.run.path(f"looks/{name}.safetensors"))
        conditions = Conditions(*(content[each.name] for each in fields(Conditions)))
        return _unflat(tensors, content["windows"]), conditions

    def expected(self, name: str, calibration: Calibration) -> float:
        """Mean error to be expected of a design by a calibration."""
        seen, at = self.stored(name)
        return float(self.drawn.expected(seen, seen.read, calibration.errors(at)).mean())


def _flat(seen: Seen) -> Mapping[str, Tensor]:
    found = {f"seen.{f.name}": getattr(seen, f.name) for f in fields(Seen)}
    tensors = {name: value for name, value in found.items() if torch.is_tensor(value)}
    for part in ("read", "surfaces"):
        read = getattr(seen, part)
        tensors |= {f"{part}.{f.name}": getattr(read, f.name) for f in fields(Readings)}
    return {
        name: value.float().contiguous()
        for name, value in tensors.items()
        if torch.is_tensor(value)
    }


def _unflat(tensors: Mapping[str, Tensor], windows: int) -> Seen:
    def of(part):
        mine = f"{part}."
        return {k.removeprefix(mine): v.double() for k, v in tensors.items() if k.startswith(mine)}

    parts = {part: Readings(**of(part), windows=windows) for part in ("read", "surfaces")}
    return Seen(**of("seen"), **parts)


def landscape(run: Run[Any], space: Space, count: int) -> Landscape:
    """Look at ``count`` designs, at as many near the best, fit the calibration to the first and
    every second of the others where there are enough, then look along every number through the
    best."""
    looks = Looks(run, space)
    shares = all_over(space, count)
    designs = sweep(
        run,
        lambda number: looks.row(f"all_{number}", shares[number]),
        "designs",
        number=range(count),
    )
    order = sorted(designs, key=lambda row: row["hard"])
    others = near_by(space, list(map(couplings.share, order[:BEST])), count)
    near = sweep(
        run, lambda number: looks.row(f"near_{number}", others[number]), "near", number=range(count)
    )
    every = [f"all_{k}" for k in range(count)] + [f"near_{k}" for k in range(0, count, 2)]
    calibration = Calibration()
    if count >= ENOUGH:
        run.say("fitting what flow's covariance does not know to the hard errors of these designs")
        calibration = _fit(looks, every, designs + near[::2])
    for name, rows in (("all", designs), ("near", near)):
        for number, row in enumerate(rows):
            row["expected"] = looks.expected(f"{name}_{number}", calibration)
    found = Landscape(designs, near, [], calibration)
    found = replace(found, grid=_along(run, looks, found.best, calibration))
    write_atomic(run.path("landscape.csv"), found.csv(space).encode())
    return found


def _fit(looks, names, rows):
    stored = [looks.stored(name) for name in names]
    hard = torch.tensor([row["hard"] for row in rows], dtype=torch.float64)

    def expected(number, errors):
        seen = stored[number][0]
        return float(looks.drawn.expected(seen, seen.read, errors).mean())

    return fitted(expected, [at for _, at in stored], hard)


def _along(run, looks, best, calibration):
    """Errors along every number, the others as in the best design; None where something required is
    missed."""
    space = looks.space
    requirements = space.pair.requirements()

    last = run.config.grid - 1

    def cell(number_of, step):
        share = best.clone()
        share[space.free.index(number_of)] = step / last
        row = {"at": step / last, "value": space.numbers(share)[number_of]}
        hard = (
            looks.row(f"grid_{number_of}_{step}", share)["hard"]
            if kept(space, share, requirements)
            else None
        )
        return {**row, "hard": hard}

    rows = sweep(run, cell, "grid", number_of=space.free, step=range(last + 1))
    for row in rows:
        name = f"grid_{row['number_of']}_{row['step']}"
        row["expected"] = None if row["hard"] is None else looks.expected(name, calibration)
    return rows
