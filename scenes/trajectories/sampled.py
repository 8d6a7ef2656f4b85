"""Simple camera paths as poses T_world_cam [T, 4, 4] at given times."""

import math

import torch

from codesign.errors import DomainError
from codesign.pose import look_at, se3_exp


def times(count, rate_hz):
    """Frame times [count] in seconds, starting at 0."""
    if count < 2:
        raise DomainError(f"a trajectory needs at least 2 frames, got {count}.")
    if not 0 < rate_hz < math.inf:
        raise DomainError(f"a trajectory's rate_hz = {rate_hz} must be positive and finite.")
    return torch.arange(count, dtype=torch.float64) / rate_hz


def body_twist(start, twist_per_s, t_s):
    """Constant velocity in the camera's own axes: start [4, 4], twist_per_s [..., 6] (m/s, rad/s), t_s [T] ->
    [..., T, 4, 4]."""
    return start @ se3_exp(t_s[:, None] * twist_per_s[..., None, :])


def translation(start, velocity_m_s, t_s):
    """Straight motion along camera axes: velocity_m_s three numbers."""
    return body_twist(start, torch.tensor([*velocity_m_s, 0.0, 0.0, 0.0], dtype=torch.float64), t_s)


def orbit(centre_m, radius_m, height_m, rate_rad_s, t_s, phase_rad=0.0):
    """A circle about a vertical axis, looking at its centre."""
    angle = (phase_rad + rate_rad_s * t_s).tolist()
    cx, cy, cz = centre_m
    return torch.stack(
        [
            look_at((cx + radius_m * math.cos(a), cy + radius_m * math.sin(a), cz + height_m), centre_m)
            for a in angle
        ]
    )


def oscillation(start, axis, amplitude_m, frequency_hz, t_s):
    """Sinusoidal motion along a camera axis: axis three numbers, e.g. (0, 0, 1) radial (towards the scene),
    (0, 1, 0) vertical."""
    shift = amplitude_m * (2 * math.pi * frequency_hz * t_s).sin()
    direction = torch.tensor(axis, dtype=torch.float64)
    if not 0 < float(direction.norm()) < math.inf:
        raise DomainError(f"an oscillation needs an axis of finite length other than 0, got {tuple(axis)}.")
    direction = direction / direction.norm()
    return start @ se3_exp(
        torch.cat([shift[:, None] * direction, torch.zeros(t_s.numel(), 3, dtype=torch.float64)], 1)
    )


def radial(start, amplitude_m, frequency_hz, t_s):
    """Oscillation towards and away from the scene."""
    return oscillation(start, (0.0, 0.0, 1.0), amplitude_m, frequency_hz, t_s)


def vertical(start, amplitude_m, frequency_hz, t_s):
    """Oscillation along the image's vertical axis."""
    return oscillation(start, (0.0, 1.0, 0.0), amplitude_m, frequency_hz, t_s)
