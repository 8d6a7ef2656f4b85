"""Ground truth of ego-motion: the velocity of a camera in six degrees of freedom, from its poses."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError, check_finite
from codesign.pose import Poses, check_poses, inverse, se3_exp

LARGEST_TURN_RAD = 3.0  # towards half a turn the axis of a rotation is lost
SMALL = 1e-4  # squared angle below which series are used; their next term is 1e-17


def camera_velocity(T_world_cam: Poses, t_s: Tensor | Sequence[float]) -> tuple[Tensor, Tensor]:
    """Mean velocity of a camera between its poses: the constant twist that leads from each pose to the next.

    Args: T_world_cam: [..., T >= 2, 4, 4]. t_s: [T] times, increasing, the same for all trajectories.
    Returns: two twists [..., T - 1, 6], translation of the camera's origin (m/s) then rotation (rad/s): in
      the camera's own axes, where it is the same all
      through the interval, and in world axes, as it is at the middle of the interval.
    Gradient: to the poses.
    Raises: DomainError when times do not increase or the camera turns by more than 3 rad from one pose to the
      next; ShapeError.
    """
    T_world_cam = check_poses(T_world_cam)
    t_s = check_finite(torch.as_tensor(t_s, dtype=torch.float64), "times of the poses")
    if t_s.shape != T_world_cam.shape[-3:-2] or t_s.numel() < 2:
        raise ShapeError(
            f"camera velocity: {tuple(t_s.shape)} times for {T_world_cam.shape[-3]} poses; give one time per "
            "pose, and at least two."
        )
    if not bool((t_s.diff() > 0).all()):
        raise DomainError(
            "camera velocity: the times must increase from pose to pose; sort them and drop doubles."
        )
    poses = T_world_cam.double()
    start = poses[..., :-1, :, :]
    twist = se3_log((inverse(start) @ poses[..., 1:, :, :]).reshape(-1, 4, 4)).reshape(*start.shape[:-2], 6)
    half_turn = se3_exp(torch.cat([torch.zeros_like(twist[..., :3]), twist[..., 3:] / 2], -1))[..., :3, :3]
    body = twist / t_s.diff()[:, None]
    turn = (start[..., :3, :3] @ half_turn)[..., None, :, :]
    world = turn @ body.reshape(*body.shape[:-1], 2, 3, 1)
    return body, world.reshape(body.shape)


def se3_log(transform: Tensor) -> Tensor:
    """Twists [N, 6] of rigid transforms [N, 4, 4], the inverse of ``pose.se3_exp`` for turns of at most 3
    rad.

    Gradient: exact, also at the identity. Raises: DomainError for larger turns.
    Source: Sola, Deray and Atchuthan, A micro Lie theory for state estimation in robotics, 2018, eq. 133, 146
      and 173.
    """
    R = transform[:, :3, :3]
    t = transform[:, :3, 3]
    sine_axis = (
        torch.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], 1) / 2
    )
    cosine = (R.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    square = sine_axis.square().sum(1)
    small = (square < SMALL) & (cosine > 0)
    sine = torch.where(small, 0.1, square).sqrt()
    theta = torch.atan2(sine, torch.where(small, 0.9, cosine))
    turned = float(torch.where(small, 0.0, theta).detach().max())
    if turned > LARGEST_TURN_RAD:
        raise DomainError(
            f"camera velocity: the camera turns by {math.degrees(turned):.0f} degrees between two poses; "
            "give poses less than 170 degrees apart."
        )
    series = 1 + square / 6 + 3 * square**2 / 40 + 5 * square**3 / 112  # of arcsin(s) / s
    w = sine_axis * torch.where(small, series, theta / sine)[:, None]
    squared = w.square().sum(1)
    bend = (1 - theta / 2 / torch.tan(theta / 2)) / theta.square()
    bend = torch.where(small, 1 / 12 + squared / 720 + squared**2 / 30240, bend)
    across = torch.linalg.cross(w, t, dim=1)
    return torch.cat([t - across / 2 + bend[:, None] * torch.linalg.cross(w, across, dim=1), w], 1)
