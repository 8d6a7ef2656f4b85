"""Where a camera may sit and how it may be turned: bounds of six numbers, and mounts by their shares of
them."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError, check_finite
from codesign.mount.pose import attitude, yaw_pitch_roll_rad
from codesign.pose import check_poses

NAMES = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad", "roll_rad")
TURNS = [3, 5]  # yaw and roll, which come round again after a turn
PITCH = 4
ROUNDING = 1e-9  # m and rad by which a mount may be outside


class MountRanges:
    """Bounds of position, yaw to the left, pitch downwards and roll in body axes (x forward, y left, z up).

    A mount is six shares from 0 (low) to 1 (high): a cube in which any search can look.

    >>> ranges = MountRanges((0.1, -0.1, 0.3, -0.5, 0.2, 0.0), (0.3, 0.1, 0.5, 0.5, 1.2, 0.0))
    >>> middle = ranges.pose(torch.full((6,), 0.5, dtype=torch.float64))
    >>> middle[:3, 3].round(decimals=12).tolist()
    [0.2, 0.0, 0.4]
    >>> ranges.share_at(middle).round(decimals=12).tolist()
    [0.5, 0.5, 0.5, 0.5, 0.5, 0.5]

    Args: low, high: six finite numbers each, in the order of NAMES, metres and radians. Equal bounds hold a
      number; its share means nothing and is given as 0.5. Pitch is strictly between straight up and down,
      where yaw and roll would be one; yaw and roll have a turn at most.
    low, high: [6] float64. held: [6] bool.
    Raises: DomainError for bounds that are not finite, in the wrong order, or too wide; ShapeError.
    """

    low: Tensor
    high: Tensor
    held: Tensor

    def __init__(self, low: Sequence[float] | Tensor, high: Sequence[float] | Tensor) -> None:
        self.low = _six(low, "low")
        self.high = _six(high, "high")
        self.held = self.low == self.high
        for name, least, most in zip(NAMES, self.low.tolist(), self.high.tolist(), strict=True):
            said = f"mount ranges: {name} goes from {least:g} to {most:g}"
            if least > most:
                raise DomainError(f"{said}; give the lower bound first.")
            if name == NAMES[PITCH] and not -math.pi / 2 < least <= most < math.pi / 2:
                raise DomainError(
                    f"{said}; straight up and down (pi / 2) yaw and roll are one, so stay strictly between them."
                )
            if name in (NAMES[k] for k in TURNS) and most - least > 2 * math.pi:
                raise DomainError(f"{said}, more than a turn; give 2 pi at most, as from -pi to pi.")

    def numbers(self, share: Tensor) -> Tensor:
        """Position in metres and angles in radians [..., 6] of shares [..., 6]; exactly the bounds at 0 and
        1.

        Shares beyond these go on beyond the bounds, as differences at a wall need; see ``clamped``.
        Gradient: exact, to the shares, none to what is held. Raises: ShapeError; DomainError for shares that
          are not finite.
        """
        share = _shares(share)
        return torch.where(self.held, self.low, torch.lerp(self.low, self.high, share))

    def pose(self, share: Tensor) -> Tensor:
        """T_body_cam [..., 4, 4] float64 of shares [..., 6], as ``numbers``; gradient and errors too."""
        numbers = self.numbers(share)
        top = torch.cat([attitude(*numbers[..., 3:].unbind(-1)), numbers[..., :3, None]], -1)
        last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=top.dtype).expand(*top.shape[:-2], 1, 4)
        return torch.cat([top, last], -2)

    def share_at(self, T_body_cam: Tensor) -> Tensor:
        """Shares [..., 6] of mounts [..., 4, 4], the inverse of ``pose``; no gradient.

        Raises: DomainError for a mount outside the bounds, or one that is not rigid; ShapeError.
        """
        poses = check_poses(T_body_cam.detach()[None])[0].double()
        angles = yaw_pitch_roll_rad(poses)
        numbers = torch.cat([poses[..., :3, 3], angles], -1)
        middle = (self.low + self.high)[TURNS] / 2
        numbers[..., TURNS] = (
            middle + torch.remainder(numbers[..., TURNS] - middle + math.pi, 2 * math.pi) - math.pi
        )
        outside = (numbers < self.low - ROUNDING) | (numbers > self.high + ROUNDING)
        if bool(outside.any()):
            first = tuple(outside.nonzero()[0].tolist())
            k = first[-1]
            raise DomainError(
                f"mount ranges: a mount has {NAMES[k]} = {float(numbers[first]):g}, outside {float(self.low[k]):g} "
                f"to {float(self.high[k]):g}; move it inside, or widen the bounds."
            )
        width = torch.where(self.held, 1.0, self.high - self.low)
        return self.clamped((numbers - self.low) / width)

    def clamped(self, share: Tensor) -> Tensor:
        """The nearest shares [..., 6] within 0..1, those of held numbers 0.5. Gradient: as of torch.clamp.

        Raises: ShapeError; DomainError for shares that are not finite.
        """
        return torch.where(self.held, 0.5, _shares(share).clamp(0, 1))


def _six(values, name):
    values = check_finite(
        torch.as_tensor(values, dtype=torch.float64).detach().clone(),
        f"mount ranges: {name}",
        "give finite metres and radians",
    )
    if values.shape != (6,):
        raise ShapeError(
            f"mount ranges: {name} needs six numbers ({', '.join(NAMES)}), got shape {tuple(values.shape)}."
        )
    return values


def _shares(share):
    if share.shape[-1:] != (6,):
        raise ShapeError(f"mount ranges: shares are [..., 6] ({', '.join(NAMES)}), got {tuple(share.shape)}.")
    return check_finite(share.double(), "mount ranges: shares", "go back to the last finite ones")
