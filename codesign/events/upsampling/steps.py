"""Into how many steps an interval between two frames is cut."""

import math

import torch

from codesign.errors import DomainError

LARGEST_SHARE = (
    0.999  # of the pixels keep a bound; the rest is what the flow got wrong, which would otherwise decide
)


def largest(values):
    """The value that 99.9 % of the values do not exceed."""
    flat = values.detach().flatten()
    return float(flat.kthvalue(max(1, math.ceil(LARGEST_SHARE * flat.numel()))).values)


def steps_for(amount, bound, max_steps, what, start_s, end_s):
    """Least number of equal steps that keep ``amount`` within ``bound`` each. Raises: DomainError when that
    takes more than ``max_steps``."""
    count = max(1.0, amount / bound * (1 - 1e-6))
    if count > max_steps:
        raise DomainError(
            f"between the frames at {start_s:.9g} s and {end_s:.9g} s {what} changes by {amount:.3g}; steps "
            f"of {bound:g} take {count:.3g}, more than max_steps = {max_steps}: "
            "record faster, or allow larger or more steps."
        )
    return math.ceil(count)


def largest_change(levels):
    """Largest change of level (99.9 % of the pixels) between consecutive frames [N, H, W] of log levels."""
    return max(largest(change) for change in levels.detach().diff(dim=0).abs_())


def shares(count):
    """The shares of an interval at which ``count`` equal steps meet."""
    return [step / count for step in range(1, count)]


def step_times(start_s, end_s, count):
    """[count] float64 ends of equal steps; the last is end_s exactly."""
    part = torch.arange(1, count + 1, dtype=torch.float64) / count
    times_s = start_s + (end_s - start_s) * part
    times_s[-1] = end_s
    return times_s
