"""Saccades: pictures moved along a triangle, and the frames a sensor sees of them, exactly, at any time."""

import math

import torch

from codesign.errors import DomainError

SIDE_PX = 4.0  # of the triangle
LEG_S = 0.06  # duration of one saccade
DURATION_S = 3 * LEG_S
WINDOW_PX = 32


def position_px(t_s):
    """Where the picture has moved to.

    Three legs of an equilateral triangle, back to the start, each with the smooth course of a real saccade:
    10 u^3 - 15 u^4 + 6 u^5 of the way after a share u of the time (fastest in the middle, 15/8 of the mean
    speed).
    Args: t_s: [T] seconds, 0 to DURATION_S.
    Returns: [T, 2] float64 pixels (x right, y down), (0, 0) at the start.
    Source: triangle: Orchard et al., N-MNIST, 2015. Course: minimum jerk, Flash and Hogan 1985.
    """
    t_s = torch.as_tensor(t_s, dtype=torch.float64)
    if not bool(((t_s >= 0) & (t_s <= DURATION_S + 1e-12)).all()):
        raise DomainError(
            f"times span {float(t_s.min()):g} to {float(t_s.max()):g} s; the saccades last from 0 to "
            f"{DURATION_S:g} s."
        )
    corners = (
        torch.tensor([[0.0, 0.0], [0.5, math.sqrt(0.75)], [1.0, 0.0], [0.0, 0.0]], dtype=torch.float64)
        * SIDE_PX
    )
    leg = (t_s / LEG_S).floor().clamp(max=2).long()
    u = t_s / LEG_S - leg
    share = u**3 * (10 - 15 * u + 6 * u**2)
    return corners[leg] + share[:, None] * (corners[leg + 1] - corners[leg])


def frame_times(rate_hz):
    """[T] times, seconds, from 0 to DURATION_S at the given rate. Raises: DomainError when the duration is no
    whole number of intervals, or fewer than 2."""
    intervals = round(DURATION_S * rate_hz)
    if intervals < 2 or abs(DURATION_S * rate_hz - intervals) > 1e-6:
        raise DomainError(
            f"{rate_hz:g} frames per second make {DURATION_S * rate_hz:.4g} intervals in {DURATION_S:g} s; "
            "choose a rate that makes a whole number >= 2."
        )
    return torch.linspace(0, DURATION_S, intervals + 1, dtype=torch.float64)


def frames(tiles, t_s):
    """What a window of WINDOW_PX in the middle of moving tiles sees.

    The value at pixel i is that of the tile's own trigonometric polynomial at i - position: a shift without
    loss, at any fraction of a pixel.
    Args: tiles: [N, K, K] intensity, taken as periodic, K even. t_s: [T] seconds.
    Returns: [T, N, WINDOW_PX, WINDOW_PX] of the tiles' dtype.
    """
    side = tiles.shape[-1]
    across, down = (interpolation(side, position).to(tiles) for position in position_px(t_s).T)
    moved = (
        (tiles.flatten(0, 1) @ across.flatten(0, 1).T)
        .unflatten(0, tiles.shape[:2])
        .unflatten(-1, across.shape[:2])
    )  # [N, K, T, W]
    return torch.einsum("tik,nktj->tnij", down, moved)


def interpolation(side, shift_px):
    """Matrices [T, WINDOW_PX, side] that read a periodic row of ``side`` samples at the window's pixels, less
    a shift [T]."""
    first = (side - WINDOW_PX) // 2
    place = first + torch.arange(WINDOW_PX, dtype=torch.float64) - shift_px[:, None]
    x = place[..., None] - torch.arange(side, dtype=torch.float64)
    x = x - side * (x / side).round()
    on_sample = x.abs() < 1e-12
    safe = torch.where(on_sample, 0.5, x)
    return torch.where(
        on_sample, 1.0, torch.sin(math.pi * safe) / (side * torch.tan(math.pi * safe / side))
    )  # Dirichlet kernel of an even number of samples
