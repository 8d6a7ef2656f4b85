"""Rigid motions: SE(3) exponential, composition, inverse. T_world_cam maps camera points to the
world and reads right to left."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from codesign.checks import check_finite
from codesign.doors import explain
from codesign.errors import DomainError, ShapeError

# [..., T, 4, 4], or [4, 4] where one pose is asked for; numbers other than tensors are taken in
# float64
Poses: TypeAlias = Tensor | np.ndarray | Sequence[Any]


def se3_exp(twist: Tensor) -> Tensor:
    """Rigid transform of a twist.

    Args:
      twist [..., 6]: translation part (m) then rotation vector (rad), in the frame on the right of
        the product.
    Returns: [..., 4, 4]. Gradient: exact, also at zero. Source: kornia.geometry.liegroup.Se3.

    >>> se3_exp(torch.tensor([1.0, 2.0, 3.0, 0.0, 0.0, 0.0]))[:3, 3].tolist()
    [1.0, 2.0, 3.0]
    """
    from kornia.geometry.liegroup import Se3

    if twist.shape[-1] != 6:
        raise ShapeError(
            f"a twist has 6 components (3 of translation, 3 of rotation), got {tuple(twist.shape)}."
        )
    transform = Se3.exp(twist.reshape(-1, 6)).matrix().reshape(*twist.shape[:-1], 4, 4)
    # kornia wraps constants in parameters that would ask for gradients
    return transform if twist.requires_grad else transform.detach()


def inverse(transform: Tensor) -> Tensor:
    """Inverse of rigid transforms [..., 4, 4].

    >>> pose = look_at((0.0, 0.0, 1.0), (2.0, 0.0, 0.0))
    >>> torch.allclose(inverse(pose) @ pose, torch.eye(4, dtype=pose.dtype))
    True
    """
    rotation = transform[..., :3, :3]
    translation = transform[..., :3, 3:]
    # written out by element: a matrix product may round differently in another batch
    x, y, z = (rotation[..., k, :, None] * translation[..., k : k + 1, :] for k in range(3))
    top = torch.cat([rotation.mT, -(x + y + z)], -1)
    return torch.cat([top, transform[..., 3:, :]], -2)


def rigid(rotation: Tensor, position: Tensor) -> Tensor:
    """Transforms [..., 4, 4] of rotations [..., 3, 3] and positions [..., 3]."""
    top = torch.cat([rotation, position[..., None]], -1)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=top.dtype, device=top.device)
    return torch.cat([top, last.expand(*top.shape[:-2], 1, 4)], -2)


def apply(transform: Tensor, points: Tensor) -> Tensor:
    """Transform points [..., N, 3] by [..., 4, 4]."""
    return points @ transform[..., :3, :3].mT + transform[..., None, :3, 3]


def look_at(
    origin_m: Sequence[float] | Tensor,
    target_m: Sequence[float] | Tensor,
    down: Sequence[float] | Tensor = (0.0, 0.0, -1.0),
) -> Tensor:
    """T_world_cam of a camera (x right, y down, z forward) at ``origin_m`` facing ``target_m``;
    ``down`` is the image's down direction in the world.

    Args: sequences of three numbers.
    Returns: [4, 4] float64, without gradient.
    Raises: DomainError when the two points are one, the view is along ``down``, or a number is not
      finite.

    >>> look_at((0.0, 0.0, 1.0), (2.0, 0.0, 1.0))[:3, 2].tolist()  # the camera's z axis, in the world
    [1.0, 0.0, 0.0]
    """
    origin, target, down = (
        check_finite(torch.as_tensor(v, dtype=torch.float64), "look_at", "give finite points")
        for v in (origin_m, target_m, down)
    )
    if float((target - origin).norm()) == 0:
        raise DomainError(
            f"look_at: origin and target are the same point {origin.tolist()}; move one of them."
        )
    forward = torch.nn.functional.normalize(target - origin, dim=0)
    right = torch.linalg.cross(down, forward)
    if float(right.norm()) < 1e-9:
        raise DomainError(
            f"look_at: the view direction {forward.tolist()} is parallel to 'down' {down.tolist()}; give "
            "another 'down'."
        )
    right = right / right.norm()
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], 1)
    pose[:3, 3] = origin
    return pose


def as_poses(poses: Poses) -> Tensor:
    """Poses as a tensor: tensors as they are, numbers of numpy arrays and lists in float64, a list
    of tensors stacked.

    >>> as_poses([look_at((0.0, 0.0, 1.0), (2.0, 0.0, 0.0))] * 3).shape
    torch.Size([3, 4, 4])

    Gradient: to tensors, in a list too. Raises: DomainError for what are no numbers or complex
      ones; ShapeError for a list of tensors that differ in shape.
    """
    if isinstance(poses, Tensor):
        return poses
    if (
        isinstance(poses, list | tuple)
        and poses
        and all(isinstance(pose, Tensor) for pose in poses)
    ):
        if len(shapes := {tuple(pose.shape) for pose in poses}) > 1:
            raise ShapeError(
                f"poses are a list of tensors {sorted(shapes)}; give each the shape [4, 4]."
            )
        return torch.stack(list(poses))
    try:
        values = np.asarray(poses)
        if values.dtype.kind not in "iuf":
            raise TypeError
    except (TypeError, ValueError, RuntimeError):
        raise DomainError(
            f"poses are a {type(poses).__name__} that holds no real numbers [T, 4, 4]; give a tensor, a numpy "
            "array or nested lists."
        ) from None
    return torch.from_numpy(values.astype(np.float64))


def check_pose(transform: Poses) -> Tensor:
    """Raise unless the tensor (or array, or nested list) is one rigid transform [4, 4]; returns it
    as a tensor."""
    transform = as_poses(transform)
    if transform.shape != (4, 4):
        raise ShapeError(f"a pose must be [4, 4], got {tuple(transform.shape)}.")
    return check_poses(transform[None])[0]


def check_poses(transform: Poses) -> Tensor:
    """Raise unless the tensor (or array, or nested list) holds rigid transforms
    [..., T >= 1, 4, 4], a trajectory or a batch of them; returns it as a tensor."""
    transform = as_poses(transform)
    if transform.ndim < 3 or transform.shape[-2:] != (4, 4) or transform.numel() == 0:
        raise ShapeError(
            f"poses must be [T >= 1, 4, 4], or [..., T >= 1, 4, 4] for several trajectories, got "
            f"{tuple(transform.shape)}{'; for one pose give pose[None]' if transform.shape == (4, 4) else ''}."
        )
    if transform.dtype not in (torch.float32, torch.float64):
        raise DomainError(f"poses are {transform.dtype}; give float32 or float64, as by .double().")
    check_finite(transform, "poses")
    fixed = transform.detach().double()
    rotation = fixed[..., :3, :3]
    error = float(
        (rotation @ rotation.mT - torch.eye(3, dtype=torch.float64, device=rotation.device))
        .abs()
        .max()
    )
    if error > 1e-4:
        raise DomainError(
            f"poses are not rigid: R R^T differs from the identity by {error:.3g}; normalise the rotations."
        )
    if bool((torch.linalg.det(rotation) < 0).any()):
        raise DomainError(
            "poses are not rigid: a rotation has determinant -1, so it mirrors; flip the sign of one axis."
        )
    last = (
        (
            fixed[..., 3, :]
            - torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64, device=fixed.device)
        )
        .abs()
        .max()
    )
    if float(last) > 1e-6:
        raise DomainError(
            f"poses are not rigid: the last row differs from (0, 0, 0, 1) by {float(last):.3g}; give "
            "matrices that act on column vectors."
        )
    return transform


explain(globals())
