"""What the hard sensor does on average: counts and streams over many places where a pixel may have begun
inside its thresholds. The same beginnings serve both ends of a step (common random numbers)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Generator, Tensor

from codesign import events
from codesign.events.sensor.state import begin
from codesign.types import EventStream

BEGINNINGS = 32
AT_ONCE = 8  # beginnings that a kernel walks through side by side


def offsets(shape: tuple[int, ...], count: int, seed: int = 0) -> Tensor:
    """[count, *shape] places in [0, 1): evenly spaced over the beginnings, with a random start and in random
    order for every pixel, so that their mean over beginnings is far less noisy than that of free draws."""
    generator = Generator().manual_seed(seed)
    first = torch.rand(shape, generator=generator)
    order = torch.rand((count, *shape), generator=generator).argsort(0)
    return (order + first) / count


def distance(place: Tensor, theta_on: Tensor | float, theta_off: Tensor | float) -> Tensor:
    """How far the level lies above the memorised one at the first frame, for a place in [0, 1): even over -C_off/2
    to C_on/2, which is what the memory layer assumes of a pixel without a history."""
    return place * (theta_on + theta_off) / 2 - theta_off / 2


@dataclass(frozen=True)
class Judge:
    """Mean over beginnings of something that the hard sensor gives.

    sensor: SensorModel. count: beginnings. seed: of the beginnings and of what the sensor draws itself, the same for
      every one of them.
    """

    sensor: events.SensorModel
    count: int = BEGINNINGS
    seed: int = 0

    @torch.no_grad()
    def mean(self, frames: Tensor, t_s: Tensor, observe: Callable[[Tensor], Tensor]) -> Tensor:
        """Mean of ``observe(counts)`` over beginnings.

        Args: frames: [T, H, W], 0-255 scale. t_s: [T]. observe: counts [T-1, 2, B, H, W] of some beginnings to
          what is wanted [K, B, H, W].
        Returns: [K, H, W].
        """
        places = offsets(tuple(frames.shape[1:]), self.count, self.seed).to(frames)
        total: Any = 0
        for chosen in places.split(AT_ONCE):
            several = frames[:, None].expand(-1, len(chosen), -1, -1)
            state = self._begun(several[0], float(t_s[0]), chosen)
            counts = events.dense_counts(several[1:], t_s[1:], self.sensor, state=state)
            total = total + observe(counts).sum(1)
        return total / self.count

    @torch.no_grad()
    def mean_of_streams(
        self, frames: Tensor, t_s: Tensor, observe: Callable[[EventStream], Tensor]
    ) -> Tensor:
        """Mean of ``observe(stream)`` [K, H, W] over beginnings, for what depends on the time of each event."""
        places = offsets(tuple(frames.shape[1:]), self.count, self.seed).to(frames)
        total: Any = 0
        for place in places:
            state = self._begun(frames[:1], float(t_s[0]), place[None])
            for name, value in state.tensors().items():
                setattr(state, name, value[0])
            total = total + observe(events.simulate(frames[1:], t_s[1:], self.sensor, state=state))
        return total / self.count

    def _begun(self, first, start_s, places):
        """SensorState of frames [B, H, W] whose memorised levels lie at these places of the thresholds."""
        generator = Generator().manual_seed(self.seed)
        level = events.lin_log(first[:1])[0]
        state = events.SensorState()
        begin(state, self.sensor, first[0], level, start_s, generator)  # one draw of the sensor for all
        for name, value in state.tensors().items():
            setattr(state, name, value.expand(len(places), *value.shape).contiguous())
        state.generator = generator
        state.reference = level - distance(places, state.theta_on, state.theta_off)
        return state
