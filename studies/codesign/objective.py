"""The slope of the error that a whole design lets expect.

One set of drives is rendered for the design itself. What lens and mount change around it is geometry: surfaces, their
true flow, blur, what the robot covers; how well flow is told there is carried over by a trend that knows blur and
magnification. What sensor and estimator change is seen on the recorded frames, one of their numbers a step.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from codesign import mount
from codesign.mount import PrecisionTrend, window_optics
from studies.codesign.design import BLOCKS
from studies.codesign.problem import Drawn, Looked, Seen
from studies.placement.problem import Samples, of_bodies

STEP = 0.12  # of the cube, to either side
PENALTY_STEP = 0.01
GEOMETRY = BLOCKS["lens"] + BLOCKS["mount"]


class Objective:
    """drawn: worlds and drives. trend: what flow's precision does, learnt on the way.

    Of the numbers of sensor and estimator one takes its turn in every call; the others keep the slope that they had.
    """

    def __init__(self, drawn: Drawn) -> None:
        self.drawn = drawn
        self.space = drawn.space
        self.trend = PrecisionTrend()
        self._known: dict[int, float] = {}

    @torch.no_grad()
    def __call__(
        self, share: Tensor, samples: Samples, free: Sequence[int], learn: bool = True
    ) -> tuple[float, Tensor, Looked]:
        """Error to be expected of shares [V] with the penalty of what is required, its slope [V] along the free ones,
        and what was rendered."""
        looked = self.drawn.looked(self.space.made(share), samples)
        optics = window_optics(looked.whole.camera, looked.seen.read)
        if learn:
            self.trend.add(looked.seen.surfaces, looked.seen.flow_px, looked.seen.covered, optics)
        slope = torch.zeros_like(share)
        turns = [k for k in free if self.space.free[k] not in GEOMETRY]
        for k in [k for k in free if self.space.free[k] in GEOMETRY] + self._turn(turns):
            ends = share.repeat(2, 1)
            ends[:, k] = (share[k] + torch.tensor([-STEP, STEP], dtype=share.dtype)).clamp(0, 1)
            low, high = self._at(ends, k, looked, optics)
            slope[k] = (high - low) / float(ends[1, k] - ends[0, k])
            self._known[k] = float(slope[k])
        for k in turns:
            slope[k] = self._known[k]
        value = float(looked.expected.mean())
        penalty = self.penalty(share)
        if penalty:
            slope = slope + self.penalty_slope(share, free)
        return value + penalty, slope, looked

    def forget(self) -> None:
        """All numbers of sensor and estimator take their turn in the next call."""
        self._known.clear()

    def _turn(self, places):
        """All of them until all are known; then the one that is known longest."""
        if not all(k in self._known for k in places):
            return places
        oldest = [k for k in self._known if k in places][:1]
        for k in oldest:
            del self._known[k]
        return oldest

    def _at(self, ends, k, looked, optics):
        """Mean errors [2] to be expected at shares [2, V] that differ from what was rendered in number ``k`` alone."""
        name = self.space.free[k]
        wholes = [self.space.made(each) for each in ends]
        if name in BLOCKS["mount"]:
            poses = torch.stack([whole.T_body_cam for whole in wholes])
            return self.carried(looked, looked.whole.camera, poses, optics).tolist()
        if name in BLOCKS["lens"]:
            pose = looked.whole.T_body_cam[None]
            sharp = [float(self.carried(looked, whole.camera, pose, optics)) for whole in wholes]
            if name != "fno":
                return sharp
            # geometry knows the blur, recorded frames the light
            here = float(looked.expected.mean())
            return [
                blur + light - here for blur, light in zip(sharp, self._again(looked, wholes), strict=True)
            ]
        return self._again(looked, wholes, name in BLOCKS["network"])

    def _again(self, looked, wholes, same_events=False):
        """Mean errors to be expected of other designs on the frames, or on the events, that were recorded."""
        recorded = {"frames": looked.run["frames"]}
        if same_events:
            recorded["events"] = looked.run["volume"]
        return [
            float(self.drawn.looked(whole, looked.samples, recorded=recorded).expected.mean())
            for whole in wholes
        ]

    def carried(self, looked: Looked, camera, mounts: Tensor, optics: Tensor) -> Tensor:
        """Mean errors [M] to be expected behind another lens, or of other mounts [M, 4, 4]; nothing is rendered.

        optics: of what was rendered (``window_optics``).
        """
        worlds, each = len(looked.samples.numbers), len(looked.samples.which)
        which = torch.arange(worlds * each).reshape(worlds, 1, each).expand(-1, len(mounts), -1).flatten()
        batch, twist = self.drawn.scenes(mounts, looked.samples)
        field = of_bodies(looked.run["field"], which, worlds * each)
        there = self.drawn.seen(camera, mounts, batch, twist, field)
        told = self._told(looked.seen, optics)
        told_there = self._told(there, window_optics(camera, there.read))
        here = of_bodies(looked.seen.read, which, worlds * each)
        read = self.trend.carried(here, told[which], there.read, told_there)
        errors = self.drawn.expected(there, read, looked.errors)
        return errors.reshape(worlds, len(mounts), each).mean((0, 2))

    def _told(self, seen: Seen, optics):
        return self.trend.told(seen.surfaces, seen.flow_px, seen.covered, optics)

    def penalty(self, share: Tensor) -> float:
        """0 where every requirement is kept with a step to spare."""
        whole = self.space.made(share)
        return float(mount.penalty(self.drawn.requirements, whole.T_body_cam, whole.camera))

    def penalty_slope(self, share: Tensor, free: Sequence[int]) -> Tensor:
        """[V] along the free numbers, by small differences."""
        slope = torch.zeros_like(share)
        for k in free:
            if self.space.free[k] in GEOMETRY:
                ends = share.repeat(2, 1)
                ends[0, k] = (share[k] - PENALTY_STEP).clamp(0, 1)
                ends[1, k] = (share[k] + PENALTY_STEP).clamp(0, 1)
                low, high = (self.penalty(each) for each in ends)
                slope[k] = (high - low) / float(ends[1, k] - ends[0, k])
        return slope
