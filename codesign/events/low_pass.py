"""The one-pole low-pass of a level that runs linearly between its samples: one formula for the hard
sensor's kernel, the differentiable layers and Spike-ESIM."""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from codesign.backend import run_kernel
from codesign.checks import FLOATS, check, check_positive
from codesign.errors import ShapeError
from codesign.events.entry import check_level
from codesign.events.intensity import light_share

SERIES = 0.05  # below it (1 - e^-a)/a comes from a series: its first term left out is below 5e-10


def coefficients(
    pace: Any, exp: Callable[[Any], Any], select: Callable[[Any, Any, Any], Any]
) -> tuple[Any, Any]:
    """What an interval of a = ``pace`` time constants does: e^-a, and the mean of e^-s over 0 < s <
    a, that is (1 - e^-a)/a, for small a without loss, value and derivative.

    Tensors and drjit arrays alike: ``exp`` and ``select`` are those of their library.
    """
    fade = exp(-pace)
    small = pace < SERIES
    series = 1 - pace * (0.5 - pace * (1 / 6 - pace * (1 / 24 - pace / 120)))
    return fade, select(small, series, (1 - fade) / select(small, 1.0, pace))


def _coefficients(arr, pace):
    """``coefficients`` in one launch: in torch each of its operations passes through memory."""
    import drjit as dr

    return coefficients(pace, dr.exp, dr.select)


def passed(filtered: Any, before: Any, now: Any, fade: Any, mean: Any) -> Any:
    """The filter behind an interval over which its input runs from ``before`` to ``now``: the exact
    answer to y' = (L - y)/tau, stable for every pace.

    Args:
      filtered: y at the start of the interval.
      fade, mean: from ``coefficients``.
    """
    return now + (filtered - before) * fade - (now - before) * mean


def one_pole(level: Tensor, pace: Tensor, start: Tensor | None = None) -> Tensor:
    """A level behind a one-pole filter, exact for input that is linear between its samples.

    Args:
      level: [T, ...]. pace: [T-1, ...] > 0, length of each interval over the time constant,
        broadcasting.
      start: [...] filtered level at the first sample; None: the level itself.
    Returns: [T, ...] filtered levels, the start included. A steady ramp comes out a time constant
      later.
    Gradient: level, pace, start; exact.
    Raises: ShapeError when there are not as many paces as intervals; DomainError for levels of
      another type, and paces that are negative or not finite.
    """
    check(level, "T>=2 ...", "levels", FLOATS, finite=True)
    check(pace, "T-1 ...", "paces", FLOATS, least=0.0, finite=True)
    if start is not None:
        check_level(start, level)
    if not 1 <= pace.ndim <= level.ndim or len(pace) != len(level) - 1:
        raise ShapeError(
            f"pace has shape {list(pace.shape)} for {len(level)} levels; one per interval is needed, "
            f"[{len(level) - 1}, ...] of at most {level.ndim} axes."
        )
    filtered = [level[0] if start is None else start]
    steps = zip(
        level[:-1], level[1:], *run_kernel(_coefficients, (pace,), [pace.shape] * 2), strict=True
    )
    for step in steps:
        filtered.append(passed(filtered[-1], *step))
    return torch.stack(filtered)


def low_pass(
    level: Tensor,
    intensity: Tensor,
    interval_s: Tensor,
    cutoff_hz: Tensor | float,
    start: Tensor | None = None,
) -> Tensor:
    """The photoreceptor's low-pass of log levels: ``one_pole`` with a bandwidth that follows
    intensity.

    Its pace is a = 2 pi f (I + 20)/275 dt, I the mean intensity of the two frames of an interval.

    Args:
      level: [T, ...] log levels. intensity: [T, ...] on the 0-255 scale. interval_s: [T-1] seconds.
        cutoff_hz: > 0, number or 0-dim tensor.
      start: [...] filtered level at the first frame; None: the level itself.
    Returns: [T, ...] filtered levels, the start included.
    Gradient: level, intensity, cutoff_hz, start; exact.
    Raises: ShapeError, DomainError as ``one_pole``; DomainError for a bandwidth that is not one
      number above 0, and for negative intensities and intervals.
    """
    check(level, "T>=2 ...", "levels", FLOATS)
    check_positive(cutoff_hz, "cutoff_hz")
    check(intensity, "T>=2 ...", "intensity", FLOATS, least=0.0, finite=True)
    if (
        not isinstance(interval_s, Tensor)
        or intensity.shape != level.shape
        or interval_s.shape != (len(level) - 1,)
    ):
        raise ShapeError(
            f"levels {list(level.shape)}, intensity {list(intensity.shape)} and interval_s "
            f"{list(getattr(interval_s, 'shape', ()))} do not fit; [T, ...] twice and [T-1] are needed."
        )
    light = light_share(0.5 * (intensity[1:] + intensity[:-1]))
    check(interval_s.to(level), "T-1", "interval_s", least=0.0, finite=True)
    interval_s = interval_s.to(level).reshape(-1, *[1] * (level.ndim - 1))
    return one_pole(level, light * (2 * math.pi * cutoff_hz) * interval_s, start)
