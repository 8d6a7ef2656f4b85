"""The slope of the error that a whole design lets expect.

One set of drives is rendered for the design itself. What lens and mount change around it is
geometry: surfaces, their true flow, blur, what the robot covers; how well flow is told there is
carried over by a trend that knows blur and magnification; all of these designs are looked through
in one cast of rays. Behind one lens blur goes with distance, so what it does is learnt by
experiment: from the recorded frames behind a blur that is drawn. What sensor, estimator and light change is seen on the recorded frames, one of
these numbers a step.
"""

from collections.abc import Sequence

import scipy
import torch
from torch import Tensor

from codesign import mount
from codesign.mount import PrecisionTrend
from studies.codesign.design import BLOCKS, PARTS, Whole
from studies.codesign.problem import Drawn, Looked, Seen
from studies.placement.problem import Samples, of_bodies

STEP = 0.12  # of the cube, to either side
PENALTY_STEP = 0.01
SIMPLEX = 0.15  # of the cube, in which sensor and estimator begin to be settled
GEOMETRY = BLOCKS["lens"] + BLOCKS["mount"]
# geometry knows the blur of an f-number, recorded frames its light
ON_FRAMES = ("fno", *BLOCKS["sensor"], *BLOCKS["network"])


class Objective:
    """drawn: worlds and drives. penalised: with what is required, or errors alone. trend: what
    flow's precision does, learnt on the way.

    Of the numbers that act on recorded frames one takes its turn in every call; the others keep the
    slope that they had.
    """

    def __init__(self, drawn: Drawn, penalised: bool = True) -> None:
        self.drawn = drawn
        self.penalised = penalised
        self.space = drawn.space
        self.trend = PrecisionTrend()
        self._known: dict[int, float] = {}

    @torch.no_grad()
    def __call__(
        self, share: Tensor, samples: Samples, free: Sequence[int], learn: bool = True
    ) -> tuple[float, Tensor, Looked]:
        """Error to be expected of shares [V] with the penalty of what is required, its slope [V]
        along the free ones, and what was rendered."""
        looked = self.drawn.looked(self.space.made(share), samples)
        if learn:
            self._learn(looked)
        slope = torch.zeros_like(share)
        moved = [k for k in free if self.space.free[k] in GEOMETRY]
        if moved:
            slope[moved] = self._differences(
                share, moved, STEP, looked.whole, lambda wholes: self.carried(looked, wholes)
            )
        again = [k for k in free if self.space.free[k] in ON_FRAMES]
        for k in self._turn(again):
            found = self._differences(
                share, [k], STEP, looked.whole, lambda wholes: self._again(looked, wholes)
            )
            self._known[k] = float(found)
        for k in again:
            slope[k] += self._known[k]
        value = float(looked.expected.mean())
        penalty = self.penalty(share) if self.penalised else 0.0
        if penalty and moved:
            slope[moved] += self._differences(
                share, moved, PENALTY_STEP, looked.whole, self._penalties
            )
        return value + penalty, slope, looked

    def _learn(self, looked):
        """The trend takes in what was read, on the frames as they are and behind a drawn blur."""
        generator = torch.Generator().manual_seed(looked.samples.seed)
        for each, optics in ((looked, looked.optics), looked.blurred(generator)):
            seen = each.seen
            self.trend.add(seen.surfaces, seen.flow_px, seen.covered, optics)

    def look(self, share: Tensor, draw: int) -> tuple[float, Looked]:
        """Error to be expected of shares [V] on a draw, and what was rendered."""
        looked = self.drawn.looked(self.space.made(share), self.drawn.draw(draw))
        return float(looked.expected.mean()), looked

    def settled(self, share: Tensor, recorded: Sequence[Looked], tries: int) -> Tensor:
        """Shares [V] with the sensor and the estimator that let expect least error on recorded
        drives.

        Nothing is rendered: a simplex (Nelder and Mead) of so many tries from what they are now, on
        frames that are there. By expected errors, which rank good read-outs better than hard ones
        of so few drives do (0.93 and 0.85, docs/joint_race.md).
        """
        free = self.space.part("read-out")
        tried = []

        def error(numbers):
            moved = share.clone()
            moved[free] = torch.from_numpy(numbers).clamp(0, 1)
            whole = self.space.made(moved)
            chosen = {name: whole.numbers[name] for name in PARTS["read-out"]}
            errors = []
            for looked in recorded:
                errors.append(looked.again(looked.whole.with_numbers(**chosen)).expected)
            tried.append((float(torch.cat(errors).mean()), moved))
            return tried[-1][0]

        begun = share[free]
        # towards the middle, so that none leaves the bounds
        corners = begun + torch.diag(torch.where(begun < 0.5, SIMPLEX, -SIMPLEX))
        simplex = torch.cat([begun[None], corners]).numpy()
        options = {"maxfev": tries, "initial_simplex": simplex}
        scipy.optimize.minimize(error, begun.numpy(), method="Nelder-Mead", options=options)
        return min(tried, key=lambda one: one[0])[1]

    def forget(self) -> None:
        """All numbers that act on recorded frames take their turn in the next call."""
        self._known.clear()

    def _turn(self, places):
        """All of them until all are known; then the one that is known longest."""
        if not all(k in self._known for k in places):
            return places
        oldest = [k for k in self._known if k in places][:1]
        for k in oldest:
            del self._known[k]
        return oldest

    def _differences(self, share, places, step, whole, errors):
        """Slopes [places] of the errors [2 x places] of designs that are a step to either side of
        shares [V]."""
        ends = share.repeat(2 * len(places), 1)
        for number, k in enumerate(places):
            low, high = float(share[k]) - step, float(share[k]) + step
            ends[2 * number, k], ends[2 * number + 1, k] = max(low, 0.0), min(high, 1.0)
        names = [self.space.free[k] for k in places for _ in range(2)]
        wholes = [
            whole.with_numbers(**{name: self.space.numbers(end)[name]})
            for name, end in zip(names, ends, strict=True)
        ]
        low, high = errors(wholes).reshape(-1, 2).unbind(1)
        return (high - low) / torch.stack(
            [ends[1::2, k][n] - ends[::2, k][n] for n, k in enumerate(places)]
        )

    def _again(self, looked, wholes):
        """Mean errors [M] to be expected of other designs on the frames that were recorded, or on
        the events where these are the same."""
        same = all(
            whole.numbers[name] == looked.whole.numbers[name]
            for whole in wholes
            for name in ON_FRAMES
            if name not in BLOCKS["network"]
        )
        kept = {"events": looked.run["volume"]} if same else {}
        return torch.stack([looked.again(whole, **kept).expected.mean() for whole in wholes])

    def carried(self, looked: Looked, wholes: Sequence[Whole]) -> Tensor:
        """Mean errors [M] to be expected behind other lenses and of other mounts; nothing is
        rendered."""
        mounts = torch.stack([whole.T_body_cam for whole in wholes])
        worlds, each = len(looked.samples.numbers), len(looked.samples.which)
        which = (
            torch.arange(worlds * each)
            .reshape(worlds, 1, each)
            .expand(-1, len(mounts), -1)
            .flatten()
        )
        batch, twist = self.drawn.scenes(mounts, looked.samples)
        field = of_bodies(looked.run["field"], which, worlds * each)
        there, optics = self.drawn.seen(
            [whole.camera for whole in wholes], mounts, batch, twist, field
        )
        told = self._told(looked.seen, looked.optics)
        here = of_bodies(looked.seen.read, which, worlds * each)
        read = self.trend.carried(here, told[which], there.read, self._told(there, optics))
        errors = self.drawn.expected(there, read, looked.errors)
        return errors.reshape(worlds, len(mounts), each).mean((0, 2))

    def _told(self, seen: Seen, optics):
        return self.trend.told(seen.surfaces, seen.flow_px, seen.covered, optics)

    def penalty(self, share: Tensor) -> float:
        """0 where every requirement is kept with a step to spare."""
        return float(self._penalties([self.space.made(share)]))

    def _penalties(self, wholes):
        """[M] of designs; those behind one camera at once."""
        found = torch.zeros(len(wholes), dtype=torch.float64)
        for camera in dict.fromkeys(whole.camera for whole in wholes):
            mine = [number for number, whole in enumerate(wholes) if whole.camera is camera]
            mounts = torch.stack([wholes[number].T_body_cam for number in mine])
            found[mine] = mount.penalty(self.drawn.requirements, mounts, camera)
        return found
