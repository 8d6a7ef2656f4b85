"""The coupled spike response layer with step kernels, which memorises a level, and its gradient: that of the
mean count of ``events.memory``, for a level that runs no faster than one threshold per step.

Such a layer fires at most once a step and polarity; what is left of a larger step fires in the steps after
it. With the memorised level r spread evenly over one threshold C below the edge E of the last engaged step,
all pixels fire once where the level exceeds E + C, and r then fills the C below E + C: as if the level
itself had stopped there. For C_on = C_off the mean is exact; otherwise E is the edge of a play of their mean
width.
"""

import torch
from torch import Tensor
from torch.autograd import Function

from codesign.errors import DomainError
from codesign.events.entry import check_per_pixel
from codesign.events.layers.memory import memory
from codesign.events.spiking.srm_state import PlayState, SrmState
from codesign.events.spiking.step_by_step import recursion


def with_play(
    spikes: Tensor,
    level: Tensor,
    theta_on: Tensor | float,
    theta_off: Tensor | float,
    state: PlayState | None,
) -> tuple[Tensor, PlayState]:
    """The spikes with the gradient of the mean count.

    Args: spikes: [T-1, 2, ...] of a level [T, ...], or [T, 2, ...] with a state of the chunk before.
    Returns: the same spikes; state to carry on, with its graph. Gradient: level, thetas, state.
    """
    theta_on = check_per_pixel(theta_on, "theta_on", level)
    theta_off = check_per_pixel(theta_off, "theta_off", level)
    if state is None:
        slow, centre = held_back(level[1:], level[0], theta_on, theta_off)
        counts, after = memory(torch.cat((level[:1], slow)), theta_on, theta_off, log_input=True)
    else:
        slow, centre = held_back(level, state.centre, theta_on, theta_off)
        counts, after = memory(slow, theta_on, theta_off, state=state.memory, log_input=True)
    return instead(spikes, counts), PlayState(after, centre, level[-1])


def held_back(level: Tensor, centre: Tensor, theta_on: Tensor, theta_off: Tensor) -> tuple[Tensor, Tensor]:
    """The level [T, ...], held back to one threshold beyond a play, and the centre [...] of the play after
    it."""
    pixels = level.shape[1:]
    numbers = torch.stack([theta.expand(pixels).reshape(-1) for theta in (theta_on, theta_off)])
    slow, after = recursion(_follow, level.reshape(len(level), -1), numbers, centre.reshape(1, -1))
    return slow.reshape(level.shape), after.reshape(pixels)


def _follow(dr, level, thetas, centres):
    """One step: a play as wide as the mean threshold is pushed by the level, by no more than a threshold."""
    on, off = thetas
    (centre,) = centres
    half = (on + off) * 0.25
    rise = dr.maximum(level - centre - half, 0)
    fall = dr.maximum(centre - half - level, 0)
    late = (rise > on) | (fall > off)
    after = centre + (dr.minimum(rise, on) - dr.minimum(fall, off))
    edge = after + dr.select(rise > 0, half, -half)
    return dr.select(late, edge, level), [after]


def check_play(
    drive: Tensor, kernel: str, response: str, reset_scale: float, coupled: bool, state: SrmState | None
) -> None:
    """Raises: DomainError where a layer memorises no level, so that its mean count is not that of a play, or
    a state comes from a layer with another gradient."""
    given = {"kernel": kernel, "response": response, "reset_scale": reset_scale, "coupled": coupled}
    for name, needed in {"kernel": "step", "response": "step", "reset_scale": 1.0, "coupled": True}.items():
        if given[name] != needed:
            raise DomainError(
                f"gradient 'play' goes with {name}={needed!r}, got {given[name]!r}: only a layer that "
                "memorises a level has it; use gradient='surrogate'."
            )
    if not torch.equal(drive[:, 0], -drive[:, 1]):
        raise DomainError(
            "gradient 'play' needs the OFF drive to be minus the ON drive, steps of one level; use "
            "gradient='surrogate' for two drives of their own."
        )
    if state is not None and getattr(state, "play", None) is None:
        raise DomainError(
            "the state comes from a layer without gradient='play'; begin with that gradient, or go on with "
            "gradient='surrogate'."
        )


def played(spikes: Tensor, drive: Tensor, theta: Tensor, state: SrmState | None) -> tuple[Tensor, PlayState]:
    """``with_play`` for a drive [T, 2, ...] of steps: the level is their sum. theta broadcasts over [2,
    ...]."""
    pixels = drive.shape[1:]
    theta_on, theta_off = theta.expand(pixels).to(drive) if theta.numel() > 1 else (theta.to(drive),) * 2
    step = (drive[:, 0] - drive[:, 1]) / 2
    before = torch.zeros_like(step[0]) if state is None or state.play is None else state.play.level
    level = before + step.cumsum(0)
    if state is None or state.play is None:
        return with_play(spikes, torch.cat((before[None], level)), theta_on, theta_off, None)
    return with_play(spikes, level, theta_on, theta_off, state.play)


def instead(spikes: Tensor, mean: Tensor) -> Tensor:
    """The spikes with the gradient of the mean, of the same shape."""
    return _Instead.apply(spikes.detach(), mean)


class _Instead(Function):
    @staticmethod
    def forward(ctx, spikes, mean):
        return spikes.view_as(spikes)

    @staticmethod
    def backward(ctx, grad):  # pyright: ignore[reportIncompatibleMethodOverride]
        return None, grad
