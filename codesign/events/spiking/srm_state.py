"""What a spike response layer carries from one chunk of time to the next."""

from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError, check_finite


@dataclass(frozen=True)
class PlayState:
    """What ``gradient="play"`` carries on. memory: state of ``events.memory``. centre: [...] centre of the
    play that holds the level back to a threshold per step. level: [...] sum of the drive so far."""

    memory: Tensor
    centre: Tensor
    level: Tensor

    def detach(self) -> "PlayState":
        """The same state without its graph."""
        return PlayState(self.memory.detach(), self.centre.detach(), self.level.detach())


@dataclass(frozen=True)
class SrmState:
    """State after the last step of a chunk. It keeps its graph: ``detach`` it to cut the gradient between
    chunks.

    response: [states, ...] of the response kernel, float64 whatever the drive (0 to 2 states; the last taps -
      1 drives with ``srm_truncated``).
    reset: [states, ...] of the reset kernel, likewise (1 or 2 states; the last taps - 1 spikes).
    play: PlayState with ``gradient="play"``, else None.
    mean: [1 + states, ages, ...] with ``gradient="mean"``, in the type of the drive: shares of neurons by
      the age of their last spike, and the mean states of their resets; else None.
    """

    response: Tensor
    reset: Tensor
    play: PlayState | None = None
    mean: Tensor | None = None

    def detach(self) -> "SrmState":
        """The same state without its graph."""
        play = None if self.play is None else self.play.detach()
        mean = None if self.mean is None else self.mean.detach()
        return SrmState(self.response.detach(), self.reset.detach(), play, mean)


def entering_state(state, counts, pixels, device, dtype=torch.float64):
    """The state a chunk begins with: the given one, checked, or rest.

    Args:
      state: SrmState or None.
      counts: number of states of response and reset. pixels: shape of one frame.
    Raises: DomainError for something else than an SrmState, or values that are not finite; ShapeError for a
      state of other size, type or device.
    """
    shapes = [(count, *pixels) for count in counts]
    if state is None:
        return SrmState(*(torch.zeros(shape, dtype=dtype, device=device) for shape in shapes))
    if not isinstance(state, SrmState):
        raise DomainError(
            f"state is a {type(state).__name__}; pass the SrmState that the chunk before returned, or None "
            "to begin at rest."
        )
    for name, shape in zip(("response", "reset"), shapes, strict=True):
        given = getattr(state, name)
        if tuple(given.shape) != shape or given.dtype != dtype or given.device.type != device.type:
            raise ShapeError(
                f"state.{name} is {given.dtype} {list(given.shape)} on {given.device}, this layer keeps "
                f"{dtype} {list(shape)} on {device}; pass the state of the same layer and frame."
            )
        check_finite(given, f"state.{name}", "begin again from a state that is finite")
    return state
