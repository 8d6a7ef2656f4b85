"""The photoreceptor's low-pass as a differentiable layer: the same answer as inside the hard sensor, with
gradients to frames and bandwidth."""

import math

import torch

from codesign.events.intensity import light_share


def low_pass(level, intensity, interval_s, cutoff_hz, start=None):
    """Log levels behind a one-pole filter whose bandwidth follows intensity, for input that is linear between
    frames.

    Per interval, with a = 2 pi f (I + 20)/275 dt, I the mean intensity of its two frames, and step d of the
    level:
    out' = L' + (out - L) e^-a - d (1 - e^-a)/a, the exact answer, stable for every a.

    Args:
      level: [T, ...] log levels. intensity: [T, ...] on the 0-255 scale. interval_s: [T-1] seconds.
        cutoff_hz: > 0, number or 0-dim tensor.
      start: [...] filtered level at the first frame; None: the level itself.
    Returns: [T, ...] filtered levels, the start included.
    Gradient: level, intensity, cutoff_hz, start; exact.
    """
    light = light_share(0.5 * (intensity[1:] + intensity[:-1]))
    pace = light * (2 * math.pi * cutoff_hz) * interval_s.to(level).reshape(-1, *[1] * (level.ndim - 1))
    fade = torch.exp(-pace)
    mean = fading_mean(pace)
    filtered = [level[0] if start is None else start]
    for now, before, keep, share in zip(level[1:], level[:-1], fade, mean, strict=True):
        filtered.append(now + (filtered[-1] - before) * keep - (now - before) * share)
    return torch.stack(filtered)


def fading_mean(pace):
    """(1 - e^-a)/a without loss for small a >= 0, value and derivative."""
    small = pace < 0.05
    safe = torch.where(small, 1.0, pace)
    return torch.where(
        small, 1 - pace * (0.5 - pace * (1 / 6 - pace * (1 / 24 - pace / 120))), -torch.expm1(-safe) / safe
    )
