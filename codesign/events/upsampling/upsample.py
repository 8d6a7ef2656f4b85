"""Video to a higher frame rate, so that events see motion and not jumps: frames between frames,
each scene point on its straight way from one to the other, hidden ones taken from the frame that
shows them.
"""

import math
from collections.abc import Iterable, Iterator
from itertools import zip_longest
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from codesign.checks import FLOATS, check, check_number, check_positive, check_whole
from codesign.errors import DomainError, ShapeError
from codesign.events.entry import PICTURE, Times, check_times, warn_of_black
from codesign.events.intensity import lin_log
from codesign.events.upsampling.flow import (
    blurred,
    flow_both_ways,
    flow_levels,
    inside,
    sampled,
    splatted,
)

DOUBTED = 0.5  # visibility below which the flow of a pixel is replaced
SAMPLES = 4  # on each side: a neighbourhood is looked at in 9 x 9 places
REACH = 1.5  # times the largest difference of motion: a hidden strip is at most as wide as that
ALIKE = 0.15  # log units
NEAR = 0.3  # share of the reach: standard deviation of the weight by distance
WORKED_ON = 1 << 14  # pixels at a time
# forward and backward flow agree to about this much, plus this share of the motion
TOLERANCE_PX = 0.5
TOLERANCE_SHARE = 0.05
# weight of what has no counterpart in the other frame: it shows where nothing else does
HIDDEN = 0.05
LEAST = 1e-4  # weight below which a pixel counts as empty
# standard deviation of the blur that fills pixels on which nothing lands; grows until none is left
HOLE_PX = 1.5
# of the pixels keep a bound; the rest is what the flow got wrong, which would otherwise decide
LARGEST_SHARE = 0.999
MAX_STEPS = 256


@torch.no_grad()
def repaired(levels, flows, seen):
    """Flow with the values of doubted pixels replaced.

    Args:
      levels: [2, H, W] log levels of both frames. flows: [2, 2, H, W] both ways. seen: [2, H, W]
        visibility of either frame in the other.
    Returns: [2, 2, H, W]: in doubted pixels the median of the flow over seen pixels around,
      weighted by visibility, likeness and nearness.
    Source: weighted median of Sun, Roth and Black, Secrets of optical flow estimation and their
      principles, CVPR 2010, section 5.
    """
    height, width = levels.shape[-2:]
    spread_px = float((flows.amax((2, 3)) - flows.amin((2, 3))).max())
    spacing = max(1.0, REACH * spread_px / SAMPLES)
    steps = (torch.arange(-SAMPLES, SAMPLES + 1, device=levels.device) * spacing).round().long()
    dy, dx = (step.flatten() for step in torch.meshgrid(steps, steps, indexing="ij"))
    near = torch.exp(-(dx.square() + dy.square()) / (2 * (NEAR * SAMPLES * spacing) ** 2))
    flows = flows.clone()
    for flow, level, weight, mask in zip(flows, levels, seen, seen < DOUBTED, strict=True):
        old = flow.clone()
        for y, x in zip(*(place.split(WORKED_ON) for place in mask.nonzero().T), strict=True):
            row = y[:, None] + dy
            column = x[:, None] + dx
            within = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            at = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
            unlike = (level.flatten()[at] - level[y, x][:, None]).abs()
            trusted = (weight * (weight >= DOUBTED)).flatten()[at]
            vote = within * near * torch.exp(-unlike / ALIKE) * trusted
            found = vote.sum(1) > 0
            for component in range(2):
                flow[component, y, x] = torch.where(
                    found,
                    _weighted_median(old[component].flatten()[at], vote),
                    old[component, y, x],
                )
    return flows


def _weighted_median(values, weights):
    """Weighted median along the last axis, [N, K] each."""
    ordered, index = values.sort(1)
    below = weights.gather(1, index).cumsum(1)
    middle = torch.searchsorted(below, below[:, -1:] / 2).clamp(max=values.shape[1] - 1)
    return ordered.gather(1, middle)[:, 0]


def visibility(flows):
    """How well a pixel of either frame is seen in the other, from the agreement of both flows.

    Args:
      flows: [2, 2, H, W] from the first to the second frame, and back.
    Returns: [2, H, W] in HIDDEN..1.
    """
    gap = (flows + sampled(flows.flip(0), flows, "bilinear")).square().sum(1)
    allowed = (TOLERANCE_PX + TOLERANCE_SHARE * flows.norm(dim=1)).square()
    return HIDDEN + (1 - HIDDEN) * torch.exp(-gap / (2 * allowed)) * inside(flows)[:, 0]


def between(first, second, flows, seen, share):
    """The frame at a share of the interval between two frames.

    Args:
      first, second: [H, W] linear intensity. flows: [2, 2, H, W] from ``flow_both_ways``. seen:
        [2, H, W] from ``visibility``. share: 0..1.
    Returns: [H, W]. What the bicubic kernel makes darker or brighter than all nine pixels around is
      set to the darkest or brightest of them: next to a sharp edge its overshoot would be many
      thresholds of a dark pixel.
    Gradient: first and second (piecewise linear in them), for fixed flows.
    Source: flow carried forward to the time asked for, Baker et al., A database and evaluation
      methodology for optical flow, 2011, section 3.3.
    """
    motion, weight = _motion_at(flows, seen, share)
    pictures = torch.stack((first, second))[:, None]
    moved = torch.stack((-share * motion, (1 - share) * motion))
    darkest, brightest = (
        sampled(bound, moved, "nearest")
        for bound in (-max_pool2d(-pictures, 3, 1, 1), max_pool2d(pictures, 3, 1, 1))
    )
    early, late = sampled(pictures, moved).maximum(darkest).minimum(brightest)[:, 0]
    weight = share * weight[1] / ((1 - share) * weight[0] + share * weight[1])
    return early + weight * (late - early)


@torch.no_grad()
def _motion_at(flows, seen, share):
    """Motion per interval [2, H, W] of what is seen at a time in between, and how much either frame
    knows of it, [2, H, W]."""
    carried = []
    for flow, weight, part in ((flows[0], seen[0], share), (-flows[1], seen[1], share - 1)):
        carried.append(
            splatted(torch.cat((flow * weight, weight[None])).permute(1, 2, 0), part * flow)
        )
    total = carried[0] + carried[1]
    motion = total[..., :2].permute(2, 0, 1)
    mass = total[..., 2]
    empty = mass < LEAST
    width = HOLE_PX
    if bool(empty.all()):  # everything left the picture: blend where it stands
        return torch.zeros_like(motion), torch.ones_like(seen)
    motion = motion / mass.clamp(min=LEAST)
    while bool(empty.any()):
        known = (~empty).to(motion.dtype)
        spread = blurred(torch.cat((motion * known, known[None]))[:, None], width)[:, 0]
        reached = spread[2] > LEAST
        motion = torch.where(empty & reached, spread[:2] / spread[2].clamp(min=LEAST), motion)
        empty = empty & (spread[2] <= LEAST)
        width = 2 * width
    weight = torch.stack([each[..., 2] for each in carried]).clamp(max=1)
    return motion, torch.where(
        weight.sum(0) < LEAST, torch.ones_like(weight), weight.clamp(min=LEAST**2)
    )


def largest(values):
    """The value that 99.9 % of the values do not exceed."""
    flat = values.detach().flatten()
    return float(flat.kthvalue(max(1, math.ceil(LARGEST_SHARE * flat.numel()))).values)


def steps_for(amount, bound, what, max_steps, start_s, end_s):
    """Least number of equal steps that keep ``amount`` within ``bound`` each. Raises: DomainError
    when that takes more than ``max_steps``."""
    count = max(1.0, amount / bound * (1 - 1e-6))
    if count > max_steps:
        raise DomainError(
            f"between the frames at {start_s:.9g} s and {end_s:.9g} s {what} changes by {amount:.3g}; steps "
            f"of {bound:g} take {count:.3g}, more than max_steps = {max_steps}: "
            "record faster, or allow larger or more steps."
        )
    return math.ceil(count)


def upsample(
    frames: Tensor,
    t_s: Times,
    *,
    max_displacement_px: float = 1.0,
    max_log_change: float | None = None,
    max_steps: int = MAX_STEPS,
) -> tuple[Tensor, Tensor]:
    """Put frames between the frames of a video until nothing moves further than a bound from one to
    the next.

    Frames are taken as instantaneous: blur of an exposure is moved along and not undone. Motion is
    straight and even between two frames, and light changes evenly along it. Each interval gets as
    many steps as its own motion asks for.

    Args:
      frames: [T, H, W] linear intensity on the 0-255 scale, finite, >= 0.
      t_s: [T] frame times, seconds, strictly increasing.
      max_displacement_px: how far 99.9 % of the pixels move at most per step, by the flow found, >
        0.
      max_log_change: how far the lin-log level of 99.9 % of the pixels moves at most per step,
        natural log units, > 0; None: not asked.
      max_steps: most steps per interval that may be needed.
    Returns: frames [T', H, W] and times [T'] float64, the given ones among them exactly. Where two
      frames are equal, nothing is put between.
    Gradient: frames, for the flow, visibility and number of steps found, which are held fixed; none
      to times.
    Raises: ShapeError for fewer than two frames or other shapes; DomainError for NaN, infinite or
      negative frames, times that do not increase, bounds that are not positive, or an interval that
      needs more than max_steps.
    Source: Gehrig et al., Video to Events, CVPR 2020 (upsampling before event generation); Rebecq
      et al., ESIM, CoRL 2018 (both bounds).
    """
    check(frames, "T>=2 H W", "frames", FLOATS)
    pieces = list(
        upsample_stream(
            frames,
            check_times(t_s, len(frames)),
            max_displacement_px=max_displacement_px,
            max_log_change=max_log_change,
            max_steps=max_steps,
        )
    )
    return torch.cat([piece for piece, _ in pieces]), torch.cat([times_s for _, times_s in pieces])


def upsample_stream(
    frames: Iterable[Tensor],
    t_s: Iterable[Any],
    *,
    max_displacement_px: float = 1.0,
    max_log_change: float | None = None,
    max_steps: int = MAX_STEPS,
) -> Iterator[tuple[Tensor, Tensor]]:
    """``upsample`` of frames that come one after the other, in the memory of one interval.

    Args:
      frames: anything that yields frames [H, W].
      t_s: anything that yields as many times. The rest as for ``upsample``.
    Returns: iterator over (frames [n, H, W], times [n] float64): first the first frame alone, then
      for each later frame those that lead to it, and itself. Joined they are what ``upsample``
      gives, bit for bit.
    Raises: as ``upsample``; bounds at once, frames and times when they come.
    """
    max_displacement_px = check_positive(max_displacement_px, "max_displacement_px")
    if max_log_change is not None:
        max_log_change = check_positive(max_log_change, "max_log_change")
    max_steps = check_whole(max_steps, "max_steps")
    return _pieces(frames, t_s, max_displacement_px, max_log_change, max_steps)


def _pieces(frames, t_s, max_displacement_px, max_log_change, max_steps):
    before = None
    before_s = -math.inf
    brightest = 0.0
    values = 0
    sizes = {}
    for index, (frame, time_s) in enumerate(zip_longest(frames, t_s)):
        if frame is None or time_s is None:
            raise ShapeError(
                f"there is no {'frame' if frame is None else 'time'} {index}; give one of each."
            )
        dtypes = FLOATS if before is None else (before.dtype,)
        check(frame, "H W", f"frame {index}", dtypes, sizes=sizes, least=0.0, finite=True)
        time_s = check_number(time_s, f"the time of frame {index}", above=before_s)
        if before is None:
            yield frame[None], torch.tensor([time_s], dtype=torch.float64)
        else:
            made = _interval(
                before, frame, before_s, time_s, max_displacement_px, max_log_change, max_steps
            )
            times_s = before_s + (time_s - before_s) * _shares(len(made))
            times_s[-1] = time_s
            yield made, times_s
        before = frame.clone()  # the next may be read into the same memory
        before_s = time_s
        brightest = max(brightest, float(frame.detach().max()))
        values += frame.numel()
    if values >= PICTURE and 0 < brightest <= 1:
        warn_of_black()


def _interval(first, second, start_s, end_s, max_displacement_px, max_log_change, max_steps):
    """Frames that lead from the first to the second, the second among them."""
    flows = flow_both_ways(first.detach().float(), second.detach().float()).to(first)
    flows = repaired(flow_levels(first, second), flows, visibility(flows))
    seen = visibility(flows)
    interval = max_steps, start_s, end_s
    moved_px = largest(flows.norm(dim=1))
    count = steps_for(moved_px, max_displacement_px, "the place of things, in pixels,", *interval)
    while True:
        shares = _shares(count).tolist()[:-1]
        made = torch.stack(
            [*(between(first, second, flows, seen, share) for share in shares), second]
        )
        if max_log_change is None:
            return made
        levels = lin_log(torch.cat((first[None], made)).detach())
        change = max(largest(one) for one in levels.diff(dim=0).abs_())
        if change <= max_log_change:
            return made
        # at least one step more each time, for the change of a step need not shrink with its length
        count = max(
            count + 1, steps_for(change * count, max_log_change, "the log level", *interval)
        )


def _shares(count):
    """[count] float64 ends of equal steps of an interval, the last 1."""
    return torch.arange(1, count + 1, dtype=torch.float64) / count
