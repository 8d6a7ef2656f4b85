"""One low-discrepancy pattern over film and pupil, shared by all pixels, all frames, and both sides of a
difference."""

import math

import torch


def film_pupil_pattern(samples, seed):
    """Scrambled Sobol points over pixel x pupil.

    Args: samples per pixel, seed. Returns: offset [samples, 2] in pixels, within [-1/2, 1/2); pupil [samples,
      2] on the unit disc; float64. The same pattern in every pixel makes the sampled point spread the same
      everywhere: a static scene gives equal frames and a moving one no sampling flicker. A single sample is
      the pixel centre through the pupil centre.
    """
    if samples == 1:
        return torch.zeros(1, 2, dtype=torch.float64), torch.zeros(1, 2, dtype=torch.float64)
    points = torch.quasirandom.SobolEngine(4, scramble=True, seed=seed).draw(samples, dtype=torch.float64)
    return points[:, :2] - 0.5, concentric_disc(points[:, 2:])


def concentric_disc(unit):
    """Unit square to unit disc, area-preserving (Shirley and Chiu, 1997)."""
    a, b = (2 * unit - 1).unbind(1)
    wide = a.abs() > b.abs()
    radius = torch.where(wide, a, b)
    safe = torch.where(radius == 0, torch.ones_like(radius), radius)
    angle = torch.where(wide, math.pi / 4 * b / safe, math.pi / 2 - math.pi / 4 * a / safe)
    return torch.stack([radius * angle.cos(), radius * angle.sin()], 1)
