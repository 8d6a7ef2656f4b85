"""What a trajectory is: a smooth function from time to the pose of a body, with its velocity; a
camera mounted on one; and the simplest, as poses T_world_cam [T, 4, 4] at given times.

Body axes: x forward, y left, z up. A velocity is a twist in body axes: [n, 6], metres per second,
then radians per second, so that T(t + dt) is T(t) exp(dt velocity(t)) to first order.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from codesign.checks import check_finite, check_whole
from codesign.errors import DomainError, ShapeError
from codesign.mount.pose import AXES_BODY_CAM
from codesign.pose import check_pose, look_at, se3_exp


class Trajectory(ABC):
    """Poses T_world_body of a body at any time.

    span_s: first and last time for which there is a pose, seconds; None where all times have one.
    """

    span_s: tuple[float, float] | None = None

    def __call__(self, t_s) -> Tensor:
        """Poses at times.

        Args:
          t_s: [n] seconds, in any order.
        Returns: [n, 4, 4] float64, without gradient to the time.
        Raises: ShapeError for anything but a list of times; DomainError for times that are not
          finite or lie outside ``span_s``.
        """
        return self._pose(self._times(t_s))

    def velocity(self, t_s):
        """Twist in body axes at times [n]: [n, 6] float64 (m/s, rad/s), the exact derivative of the
        poses."""
        with torch.enable_grad():
            t = self._times(t_s).clone().requires_grad_()
            pose = self._pose(t)[:, :3]
            entries = pose.flatten(1).unbind(1)
            change = [
                torch.autograd.grad(entry.sum(), t, retain_graph=True)[0] for entry in entries
            ]
        local = pose[:, :, :3].detach().mT @ torch.stack(change, 1).reshape(-1, 3, 4)
        turn = local[:, (2, 0, 1), (1, 2, 0)] - local[:, (1, 2, 0), (2, 0, 1)]
        return torch.cat([local[:, :, 3], turn / 2], 1)

    @abstractmethod
    def _pose(self, t_s) -> Tensor:
        """Poses [n, 4, 4] at checked times [n], differentiable in time."""

    def _times(self, t_s):
        t = torch.as_tensor(t_s, dtype=torch.float64).detach()
        if t.ndim != 1 or t.numel() == 0:
            raise ShapeError(
                f"a trajectory takes a list of times [n >= 1], got shape {tuple(t.shape)}."
            )
        check_finite(t, "trajectory times", "give finite seconds")
        if self.span_s is not None and not (
            self.span_s[0] <= t.min() and t.max() <= self.span_s[1]
        ):
            raise DomainError(
                f"the trajectory runs from {self.span_s[0]:g} to {self.span_s[1]:g} s, but times from "
                f"{t.min():g} to {t.max():g} s were asked for; stay inside."
            )
        return t


class _Mounted:
    def __init__(self, trajectory, T_body_cam):
        self.trajectory = trajectory
        self.T_body_cam = T_body_cam
        self.span_s = trajectory.span_s

    def __call__(self, t_s):
        return self.trajectory(t_s) @ self.T_body_cam

    def velocity(self, t_s):
        turn = self.T_body_cam[:3, :3]
        place = self.T_body_cam[:3, 3]
        straight, rate = self.trajectory.velocity(t_s).split(3, 1)
        return torch.cat(
            [(straight + torch.linalg.cross(rate, place.expand_as(rate))) @ turn, rate @ turn], 1
        )


def mounted(trajectory: Any, T_body_cam: Tensor) -> Any:
    """The path of a camera on a body: T_world_cam = T_world_body T_body_cam, with the camera's
    velocity in its own axes.

    Args:
      trajectory: anything with a call, ``velocity`` and ``span_s``.
      T_body_cam: [4, 4], for example of codesign.mount.Mount.
    Returns: a trajectory of the camera (x right, y down, z forward). Gradient: to T_body_cam.
    Raises: ShapeError, DomainError when T_body_cam is not one rigid transform.
    """
    if T_body_cam.shape != (4, 4):
        raise ShapeError(f"T_body_cam must be one pose [4, 4], got {tuple(T_body_cam.shape)}.")
    return _Mounted(trajectory, check_pose(T_body_cam.double()))


def body_at(origin_m, target_m, up=(0.0, 0.0, 1.0)):
    """Pose T_world_body [4, 4] of a body at ``origin_m`` whose forward axis points at ``target_m``.
    Raises:
    as codesign.pose.look_at."""
    pose = look_at(origin_m, target_m, tuple(-v for v in up))
    pose[:3, :3] = pose[:3, :3] @ AXES_BODY_CAM.mT
    return pose


def positive(name, value, least=0.0, most=float("inf"), inclusive=False):
    """Raise DomainError unless ``least`` < value < ``most`` (or ``least`` <= value); returns it as
    a float."""
    if not ((least <= value if inclusive else least < value) and value < most):
        raise DomainError(
            f"trajectory: {name} = {value} must be {'at least' if inclusive else 'above'} {least:g} and "
            f"below {most:g}."
        )
    return float(value)


def times(count: int, rate_hz: float) -> Tensor:
    """Frame times [count] in seconds, starting at 0."""
    count = check_whole(count, "the number of frames of a trajectory", 2)
    if not 0 < rate_hz < math.inf:
        raise DomainError(f"a trajectory's rate_hz = {rate_hz} must be positive and finite.")
    return torch.arange(count, dtype=torch.float64) / rate_hz


def body_twist(start: Tensor, twist_per_s: Tensor, t_s: Tensor) -> Tensor:
    """Constant velocity in the camera's own axes: start [4, 4], twist_per_s [..., 6] (m/s, rad/s),
    t_s [T] -> [..., T, 4, 4]."""
    check_finite(twist_per_s, "the twist")
    return start @ se3_exp(t_s[:, None] * twist_per_s[..., None, :])


def translation(start: Tensor, velocity_m_s: Sequence[float] | Tensor, t_s: Tensor) -> Tensor:
    """Straight motion along camera axes: velocity_m_s three numbers. Gradient: start, velocity."""
    velocity = [torch.as_tensor(each, dtype=torch.float64) for each in velocity_m_s]
    return body_twist(start, torch.stack([*velocity, *torch.zeros(3, dtype=torch.float64)]), t_s)
