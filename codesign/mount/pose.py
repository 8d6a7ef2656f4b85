"""A camera mount on a robot body: six unconstrained numbers to a pose with a limited position and a
free rotation; and bounds of all six (``MountRanges``), mounts by their shares of them.

Body axes: x forward, y left, z up. Camera axes: x right, y down, z forward. Yaw turns the view to
the left, pitch tilts it down (90 degrees looks straight down), roll turns the image about the view;
at zero the camera looks along the body's x axis with level rows.
"""

import math
from collections.abc import Sequence

import scipy
import torch
from torch import Tensor, nn

from codesign.checks import check_finite, check_number, check_positive
from codesign.errors import DomainError, ShapeError
from codesign.mount.observability import chief_lines, flow_of_points
from codesign.pose import check_poses, rigid, se3_exp
from codesign.render.film import some_pixels
from codesign.types import ChiefRayCamera

# sine of the angle to the vertical below which the view has no direction over ground
UPRIGHT = 1e-12
NEAREST_M = 1e-6  # of what moves in the image
MOST_PIXELS = 255  # of a film, spread over it, at which the motion of the image is measured
# of a mount, by its bounds
NAMES = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad", "roll_rad")
# yaw and roll come round again after a turn
TURNS = [3, 5]
TURN = 2 * math.pi
PITCH = 4
# m and rad by which a mount may be outside
ROUNDING = 1e-9
AXES = ("x forward", "y left", "z up")
# of a level camera that looks forward
AXES_BODY_CAM = torch.tensor(
    [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64
)


class Mount(nn.Module):
    """Pose T_body_cam of a camera on a body.

    >>> mount = Mount(nominal_m=(0.2, 0.0, 0.4), half_range_m=(0.1, 0.1, 0.2), pitch_rad=1.0)
    >>> mount()[:3, 3].tolist()
    [0.2, 0.0, 0.4]
    >>> optimiser = torch.optim.Adam(mount.parameters(), lr=0.05)

    Args:
      nominal_m: three numbers, body axes: middle of the box of allowed positions.
      half_range_m: half its size per axis, >= 0 (0 holds that axis).
      yaw_rad, pitch_rad, roll_rad: attitude where the rotation part of ``numbers`` is zero.
      position_m: where to start, strictly inside the box; None starts in the middle.
    numbers: [6] float64, learnable, unconstrained; with x = unit numbers, position = nominal +
      half_range tanh(x[:3]) and rotation = start attitude times exp(x[3:]), a rotation vector in
      camera axes (so looking straight down, where yaw and roll turn about one axis, is a pose like
      any other).
    unit: [6], 1 until ``variables`` makes a unit of every number move the image by a natural step.
    Raises: DomainError when a number is not finite, a range is negative, or the start lies outside
      the box; ShapeError for other than three numbers.
    """

    start_attitude: Tensor
    nominal_m: Tensor
    half_range_m: Tensor
    unit: Tensor

    def __init__(
        self,
        nominal_m: Sequence[float] | Tensor,
        half_range_m: Sequence[float] | Tensor,
        *,
        yaw_rad: float = 0.0,
        pitch_rad: float = 0.0,
        roll_rad: float = 0.0,
        position_m: Sequence[float] | Tensor | None = None,
    ) -> None:
        super().__init__()
        nominal = _numbers(nominal_m, "mount: nominal_m", AXES, "metres")
        half = _numbers(half_range_m, "mount: half_range_m", AXES, "metres")
        if bool((half < 0).any()):
            raise DomainError(
                f"mount: half_range_m is {half.tolist()}; the box of allowed positions needs sizes of at "
                "least 0 (0 holds an axis)."
            )
        self.register_buffer("nominal_m", nominal)
        self.register_buffer("half_range_m", half)
        self.register_buffer("unit", torch.ones(6, dtype=torch.float64))
        angles = {"yaw_rad": yaw_rad, "pitch_rad": pitch_rad, "roll_rad": roll_rad}
        for name, angle in angles.items():
            check_number(angle, f"mount: {name}", -TURN, TURN, remedy="give radians")
        self.register_buffer("start_attitude", attitude(**angles))
        start = torch.zeros(6, dtype=torch.float64)
        start[:3] = self._unbounded(
            nominal
            if position_m is None
            else _numbers(position_m, "mount: position_m", AXES, "metres")
        )
        self.numbers = nn.Parameter(start)

    def _unbounded(self, position):
        offset = position - self.nominal_m
        half = self.half_range_m
        free = half > 0
        if bool((torch.where(free, offset.abs() >= half, offset != 0)).any()):
            low = (self.nominal_m - half).tolist()
            high = (self.nominal_m + half).tolist()
            raise DomainError(
                f"mount: position_m {position.tolist()} is not strictly inside the allowed box from {low} "
                f"to {high} m; move it inside, or widen half_range_m."
            )
        return torch.atanh(torch.where(free, offset / torch.where(free, half, 1.0), 0.0))

    def forward(self, numbers: Tensor | None = None) -> Tensor:
        """T_body_cam [..., 4, 4] of ``numbers`` [..., 6]; the mount's own when None. Gradient:
        exact, to the numbers.

        Raises: ShapeError when the last axis is not 6; DomainError when one is not finite.
        """
        numbers = self.numbers if numbers is None else numbers
        if numbers.shape[-1] != 6:
            raise ShapeError(
                f"mount: its numbers are [..., 6] (position, rotation), got {tuple(numbers.shape)}."
            )
        check_finite(numbers, "mount numbers", "go back to the last finite ones")
        numbers = self.unit * numbers
        position = self.nominal_m + self.half_range_m * torch.tanh(numbers[..., :3])
        turn = se3_exp(torch.cat([torch.zeros_like(numbers[..., 3:]), numbers[..., 3:]], -1))[
            ..., :3, :3
        ]
        return rigid(self.start_attitude @ turn, position)

    def extra_repr(self) -> str:
        if not self.numbers.isfinite().all():
            return "numbers that are not finite"
        pose = self().detach()
        place = ", ".join(f"{each:.4g}" for each in pose[:3, 3].tolist())
        turns = yaw_pitch_roll_rad(pose).rad2deg().tolist()
        return f"at {place} m, yaw, pitch, roll {', '.join(f'{each + 0.0:.3g}' for each in turns)} degrees"

    def numbers_at(self, T_body_cam: Tensor) -> Tensor:
        """Numbers [..., 6] that give poses [..., 4, 4], the inverse of ``forward``; no gradient.

        Raises: DomainError for a position that is not strictly inside the box; ShapeError.
        """
        if T_body_cam.shape[-2:] != (4, 4):
            raise ShapeError(f"mount: poses are [..., 4, 4], got {tuple(T_body_cam.shape)}.")
        pose = check_finite(T_body_cam.detach().double(), "mount: T_body_cam")
        turn = self.start_attitude.mT @ pose[..., :3, :3]
        turned = scipy.spatial.transform.Rotation.from_matrix(turn.reshape(-1, 3, 3).cpu().numpy())
        vector = torch.from_numpy(turned.as_rotvec()).to(pose.device)
        return (
            torch.cat([self._unbounded(pose[..., :3, 3]), vector.reshape(*pose.shape[:-2], 3)], -1)
            / self.unit
        )

    def variables(
        self, camera: ChiefRayCamera, depth_m: float | Tensor, step_px: float = 1.0
    ) -> list[nn.Parameter]:
        """Rescale ``numbers`` so that a unit of each moves the image of what the camera sees by
        ``step_px`` RMS; the pose stays. Then one learning rate suits the mount, the lens's
        variables and a network.

        Args:
          camera: has ``chief_rays`` and ``film`` (see render.Camera).
          depth_m: depth of the scene along the view, one number or one per pixel [P]; pixels
            without a surface carry one that is not finite or not positive.
          step_px: the natural step.
        A number that hardly moves the image (a narrow box far from the scene) keeps 1 of its map's
        argument as unit, as does one that is held.
        Returns: [numbers], the mount's one Parameter, for torch.optim.
        Raises: DomainError when no pixel sees a surface, or the step is not positive and finite;
          ShapeError.
        """
        check_positive(step_px, "mount: step_px")
        numbers = self.numbers.detach()
        with torch.no_grad():
            per_unit = self._image_motion(camera, depth_m)
            unit = (self.unit * step_px / per_unit.clamp_min(1e-300)).clamp_max(1.0)
            self.numbers.copy_(numbers * (self.unit / unit))
            self.unit = unit
        return [self.numbers]

    def _image_motion(self, camera, depth_m):
        """RMS motion of the image, px per unit of each number, [6]."""
        pixels = camera.film.pixels()
        depth = torch.as_tensor(depth_m, dtype=torch.float64)
        if depth.shape not in ((), (1,), pixels.shape[:1]):
            raise ShapeError(
                f"mount: depth_m is one number or [{pixels.shape[0]}] (one per pixel), got {tuple(depth.shape)}."
            )
        at = some_pixels(camera.film, MOST_PIXELS)
        depth = depth.expand(pixels.shape[0])[at]
        seen = depth.isfinite() & (depth > NEAREST_M) & (camera.chief_rays(pixels[at]).weight > 0)
        if not bool(seen.any()):
            raise DomainError(
                "mount: no pixel sees a surface in front of the camera, so no step moves the image; give depths "
                f"> {NEAREST_M:g} m."
            )
        pixels = pixels[at][seen]
        depth = depth[seen][:, None]
        base, slope, base_step, slope_step = chief_lines(camera, pixels)
        point = torch.cat([base + slope * depth, depth, torch.ones_like(depth)], 1)
        pose = self()
        # [4, 4, 6]
        change = torch.autograd.functional.jacobian(self.forward, self.numbers.detach())
        # X_cam = T^-1 X_body, so dX_cam = -T^-1 dT X_cam
        velocity = -torch.einsum("ij,jkn,pk->pin", torch.linalg.inv(pose), change, point)[:, :3]
        motion = flow_of_points(velocity, slope, base_step + slope_step * depth[..., None])
        return motion.square().sum(1).mean(0).sqrt()


def attitude(
    yaw_rad: float | Tensor,
    pitch_rad: float | Tensor,
    roll_rad: float | Tensor,
) -> Tensor:
    """Rotations [..., 3, 3] float64 from camera to body axes: Rz(yaw) Ry(pitch) Rx(roll) after the
    axes of a level camera.

    Args: numbers or tensors [...] that broadcast.
    Gradient: exact, to the angles.
    Raises: DomainError when not finite.
    """
    turn = torch.eye(3, dtype=torch.float64)
    for axis, angle, name in (
        (2, yaw_rad, "yaw_rad"),
        (1, pitch_rad, "pitch_rad"),
        (0, roll_rad, "roll_rad"),
    ):
        angle = check_finite(
            torch.as_tensor(angle, dtype=torch.float64), f"mount: {name}", "give a finite angle"
        )
        zero = torch.zeros_like(angle)
        vector = torch.stack([angle if k == 3 + axis else zero for k in range(6)], -1)
        turn = turn @ se3_exp(vector)[..., :3, :3]
    return turn @ AXES_BODY_CAM


def yaw_pitch_roll_rad(T_body_cam: Tensor) -> Tensor:
    """Angles [..., 3] of a mount, the inverse of ``attitude``: yaw and roll in (-pi, pi], pitch in
    [-pi/2, pi/2].

    Yaw and pitch are where the camera's axis points. Looking straight up or down only yaw and roll
    together mean something: yaw is then both, and roll 0.
    Gradient: the matrix; straight up or down, where pitch has its largest or smallest value, 0 for
      pitch and roll.
    """
    turn = T_body_cam[..., :3, :3] @ AXES_BODY_CAM.to(T_body_cam).mT
    upright = turn[..., :2, 0].detach().square().sum(-1) < UPRIGHT**2
    # where there is no direction, a safe one to differentiate
    safe = torch.where(upright, 1.0, turn[..., 0, 0])
    aside = torch.where(upright, 0.0, turn[..., 1, 0])
    level = torch.where(upright, 0.0, torch.hypot(safe, aside))
    yaw = torch.where(
        upright, torch.atan2(-turn[..., 0, 1], turn[..., 1, 1]), torch.atan2(aside, safe)
    )
    pitch = torch.atan2(-turn[..., 2, 0], level)
    below = torch.where(upright, 1.0, turn[..., 2, 2])
    roll = torch.where(upright, 0.0, torch.atan2(torch.where(upright, 0.0, turn[..., 2, 1]), below))
    return torch.stack([yaw, pitch, roll], -1)


class MountRanges:
    """Bounds of position, yaw to the left, pitch downwards and roll in body axes
    (x forward, y left, z up).

    A mount is six shares from 0 (low) to 1 (high): a cube in which any search can look.

    >>> ranges = MountRanges((0.1, -0.1, 0.3, -0.5, 0.2, 0.0), (0.3, 0.1, 0.5, 0.5, 1.2, 0.0))
    >>> middle = ranges.pose(torch.full((6,), 0.5, dtype=torch.float64))
    >>> middle[:3, 3].round(decimals=12).tolist()
    [0.2, 0.0, 0.4]
    >>> ranges.share_at(middle).round(decimals=12).tolist()
    [0.5, 0.5, 0.5, 0.5, 0.5, 0.5]

    Args:
      low, high: six finite numbers each, in the order of NAMES, metres and radians. Equal bounds
        hold a number; its share means nothing and is given as 0.5. Pitch is strictly between
        straight up and down, where yaw and roll would be one; yaw and roll have a turn at most.
    low, high: [6] float64. held: [6] bool.
    Raises: DomainError for bounds that are not finite, in the wrong order, or too wide; ShapeError.
    """

    low: Tensor
    high: Tensor
    held: Tensor

    def __init__(self, low: Sequence[float] | Tensor, high: Sequence[float] | Tensor) -> None:
        self.low = _numbers(low, "mount ranges: low", NAMES, "metres and radians").detach().clone()
        self.high = (
            _numbers(high, "mount ranges: high", NAMES, "metres and radians").detach().clone()
        )
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
                raise DomainError(
                    f"{said}, more than a turn; give 2 pi at most, as from -pi to pi."
                )

    def numbers(self, share: Tensor) -> Tensor:
        """Position in metres and angles in radians [..., 6] of shares [..., 6]; exactly the bounds
        at 0 and 1.

        Shares beyond these go on beyond the bounds, as differences at a wall need; see ``clamped``.
        Gradient: exact, to the shares, none to what is held. Raises: ShapeError; DomainError for
          shares that are not finite.
        """
        share = _shares(share)
        return torch.where(self.held, self.low, torch.lerp(self.low, self.high, share))

    def pose(self, share: Tensor) -> Tensor:
        """T_body_cam [..., 4, 4] float64 of shares [..., 6], as ``numbers``; gradient and errors
        too."""
        numbers = self.numbers(share)
        return rigid(attitude(*numbers[..., 3:].unbind(-1)), numbers[..., :3])

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
        """The nearest shares [..., 6] within 0..1, those of held numbers 0.5. Gradient: as of
        torch.clamp.

        Raises: ShapeError; DomainError for shares that are not finite.
        """
        return torch.where(self.held, 0.5, _shares(share).clamp(0, 1))


def _numbers(values, name, names, unit):
    """Finite float64 numbers, as many as there are names."""
    values = check_finite(torch.as_tensor(values, dtype=torch.float64), name, f"give finite {unit}")
    if values.shape != (len(names),):
        count = "three" if len(names) == 3 else "six"
        raise ShapeError(
            f"{name} needs {count} numbers ({', '.join(names)}), got shape {tuple(values.shape)}."
        )
    return values


def _shares(share):
    if share.shape[-1:] != (6,):
        raise ShapeError(
            f"mount ranges: shares are [..., 6] ({', '.join(NAMES)}), got {tuple(share.shape)}."
        )
    return check_finite(share.double(), "mount ranges: shares", "go back to the last finite ones")
