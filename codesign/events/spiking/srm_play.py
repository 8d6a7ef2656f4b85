"""The gradient of a coupled spike response layer with step kernels, which memorises a level: that of the mean
count of ``events.memory``, for a level that runs no faster than one threshold per step.

Such a layer fires at most once a step and polarity; what is left of a larger step fires in the steps after it.
With the memorised level r spread evenly over one threshold C below the edge E of the last engaged step, all
pixels fire once where the level exceeds E + C, and r then fills the C below E + C: as if the level itself had
stopped there. ``limited`` is that level. For C_on = C_off the mean is exact; otherwise E is the edge of a play
of their mean width.
"""

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from codesign.errors import DomainError
from codesign.events.entry import check_per_pixel
from codesign.events.layers.memory import memory
from codesign.events.layers.pixel_loop import Loop
from codesign.events.spiking.instead import instead
from codesign.events.spiking.srm_state import PlayState, SrmState
from codesign.exclusive import exclusive

NEVER = 0xFFFFFFFF


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
    before = None if state is None else state.memory
    if state is None:
        slow, centre = _Limited.apply(level[1:], level[0], theta_on, theta_off)
        slow = torch.cat((level[:1], slow))
    else:
        slow, centre = _Limited.apply(level, state.centre, theta_on, theta_off)
    counts, after = memory(slow, theta_on, theta_off, state=before, log_input=True)
    return instead(spikes, counts), PlayState(after, centre, level[-1])


def check_play(
    drive: Tensor, kernel: str, response: str, reset_scale: float, coupled: bool, state: SrmState | None
) -> None:
    """Raises: DomainError where a layer memorises no level, so that its mean count is not that of a play, or a
    state comes from a layer with another gradient."""
    given = {"kernel": kernel, "response": response, "reset_scale": reset_scale, "coupled": coupled}
    for name, needed in {"kernel": "step", "response": "step", "reset_scale": 1.0, "coupled": True}.items():
        if given[name] != needed:
            raise DomainError(
                f"gradient 'play' goes with {name}={needed!r}, got {given[name]!r}: only a layer that memorises a "
                "level has it; use gradient='surrogate'."
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
    """``with_play`` for a drive [T, 2, ...] of steps: the level is their sum. theta broadcasts over [2, ...]."""
    pixels = drive.shape[1:]
    theta_on, theta_off = theta.expand(pixels).to(drive) if theta.numel() > 1 else (theta.to(drive),) * 2
    step = (drive[:, 0] - drive[:, 1]) / 2
    before = torch.zeros_like(step[0]) if state is None or state.play is None else state.play.level
    level = before + step.cumsum(0)
    if state is None or state.play is None:
        return with_play(spikes, torch.cat((before[None], level)), theta_on, theta_off, None)
    return with_play(spikes, level, theta_on, theta_off, state.play)


class _Limited(Function):
    """The level, held back to one threshold beyond the play, and the centre of the play after it."""

    @staticmethod
    @exclusive
    def forward(ctx, level, centre, theta_on, theta_off):
        ctx.save_for_backward(level, centre, theta_on, theta_off)
        return _Play(level, theta_on, theta_off).forward(centre)

    @staticmethod
    @once_differentiable
    @exclusive
    def backward(ctx, *grads):
        level, centre, theta_on, theta_off = ctx.saved_tensors
        grad_level, grad_centre, *grad_thetas = _Play(level, theta_on, theta_off).adjoint(centre, *grads)
        thetas = (theta_on, theta_off)
        return (
            grad_level,
            grad_centre,
            *(grad.sum_to_size(theta.shape) for grad, theta in zip(grad_thetas, thetas, strict=True)),
        )


class _Play:
    """The play in one drjit loop over time per pixel."""

    def __init__(self, level, theta_on, theta_off):
        self.loop = Loop(level, theta_on, theta_off)
        self.level = level

    def advance(self, level, centre):
        """Whether the play is pushed up, down, and either by more than a threshold; and its centre after."""
        dr = self.loop.dr
        rise, fall = self.loop.beyond(level, centre)
        late = (rise > self.loop.theta_on) | (fall > self.loop.theta_off)
        after = centre + (dr.minimum(rise, self.loop.theta_on) - dr.minimum(fall, self.loop.theta_off))
        return rise > 0, fall > 0, late, after

    def forward(self, centre):
        loop = self.loop
        dr = loop.dr
        target = loop.fresh(self.level.numel())
        half = (loop.theta_on + loop.theta_off) * 0.25

        def step(index, level, centre):
            is_on, _, late, after = self.advance(level, centre)
            edge = after + dr.select(is_on, half, -half)
            place = index * loop.pixels + loop.lane
            dr.scatter(target, dr.select(late, edge, level), place, mode=dr.ReduceMode.NoConflicts)
            return (after,)

        (after,) = loop(step, (loop.load(centre),), target)
        dr.sync_thread()
        shape = self.level.shape
        return loop.tensor(target, shape), loop.tensor(after, shape[1:])

    def adjoint(self, centre, grad_slow, grad_after):
        """Gradients of the level, the centre, theta_on and theta_off. What reaches a level that was held back
        goes to the step at whose level the edge stood, or to the centre of the start."""
        loop = self.loop
        dr = loop.dr
        arr = loop.arr
        seeds = loop.load(grad_slow)
        target = loop.fresh(self.level.numel())

        def step(index, level, centre, held, engaged, mine, by_on, by_off, grad_centre, grad_on, grad_off):
            is_on, is_off, late, after = self.advance(level, centre)
            place = index * loop.pixels + loop.lane
            seed = dr.gather(arr.Float, seeds, place)
            free = (is_on | is_off) & ~late
            dr.scatter(target, dr.select(late, 0, seed), place, mode=dr.ReduceMode.NoConflicts)
            known = engaged != NEVER
            dr.scatter(target, mine + held, engaged, active=free & known, mode=dr.ReduceMode.NoConflicts)
            grad_centre = grad_centre + dr.select(free & ~known, held, 0)
            side = dr.select(is_on, 0.25, -0.25)
            # the centre moves with the thresholds: by a quarter of each below an edge that stands at a level
            by_on = dr.select(free, -side, by_on + dr.select(late & is_on, 1, 0))
            by_off = dr.select(free, -side, by_off - dr.select(late & is_off, 1, 0))
            grad_on = grad_on + dr.select(late, seed * (by_on + side), 0)
            grad_off = grad_off + dr.select(late, seed * (by_off + side), 0)
            held = dr.select(free, 0, held + dr.select(late, seed, 0))
            engaged = dr.select(free, place, engaged)
            mine = dr.select(free, seed, mine)
            return after, held, engaged, mine, by_on, by_off, grad_centre, grad_on, grad_off

        zero = dr.zeros(arr.Float, loop.width)
        begun = (
            loop.load(centre),
            zero,
            dr.full(arr.UInt32, NEVER, loop.width),
            *([zero] * 6),
        )
        _, held, engaged, mine, by_on, by_off, grad_centre, grad_on, grad_off = loop(step, begun, target)
        end = loop.load(grad_after)
        known = engaged != NEVER
        held = held + end
        dr.scatter(target, mine + held, engaged, active=known, mode=dr.ReduceMode.NoConflicts)
        dr.eval(target)
        dr.sync_thread()
        grad_centre = grad_centre + dr.select(known, 0, held)
        grads = (grad_centre, grad_on + end * by_on, grad_off + end * by_off)
        return loop.tensor(target, self.level.shape), *(
            loop.tensor(grad, self.level.shape[1:]) for grad in grads
        )
