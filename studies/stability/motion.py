"""Rigid motions and a seen plane in closed form, for what theory expects."""

import torch
from torch import Tensor

MEAN = 100.0
FREQUENCY = ((3.0, 1.0), (-2.0, 4.0))  # periods per plane distance
PHASE = (0.3, 1.1)


def rodrigues(twist: Tensor) -> Tensor:
    """Rigid transform [4, 4] of a twist [6] by Rodrigues' formula, for turns well above 0."""
    shift, turn = twist.double().split(3)
    angle = turn.norm()
    cross = hat(turn / angle)
    one = torch.eye(3, dtype=torch.float64)
    rotation = one + angle.sin() * cross + (1 - angle.cos()) * cross @ cross
    lever = one + (1 - angle.cos()) / angle * cross + (1 - angle.sin() / angle) * cross @ cross
    return rigid(rotation, lever @ shift)


def small(twist: Tensor) -> Tensor:
    """The identity and the generators, for twists whose square rounds away."""
    shift, turn = twist.double().split(3)
    return rigid(torch.eye(3, dtype=torch.float64) + hat(turn), shift)


def rigid(rotation: Tensor, shift: Tensor) -> Tensor:
    """[4, 4] of a rotation [3, 3] and a shift [3]."""
    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
    return torch.cat([torch.cat([rotation, shift[:, None]], 1), last])


def hat(vector: Tensor) -> Tensor:
    """The matrix of a cross product with a vector [3]."""
    x, y, z = vector
    zero = 0 * x
    rows = (zero, -z, y), (z, zero, -x), (-y, x, zero)
    return torch.stack([torch.stack(row) for row in rows])


def plane_light(pose: Tensor, direction: Tensor, distance: Tensor, amplitude: float) -> Tensor:
    """Light [N] of a plane at z = distance whose log radiance is a sum of two cosines, along unit
    vectors [N, 3] from a pose [4, 4]."""
    ahead = direction @ pose[:3, :3].mT
    origin = pose[:3, 3]
    way = (distance - origin[2]) / ahead[:, 2:]
    met = (origin + way * ahead)[:, :2] / distance
    waves = 2 * torch.pi * met @ torch.tensor(FREQUENCY, dtype=torch.float64).mT
    return (
        MEAN
        * (amplitude * torch.cos(waves + torch.tensor(PHASE, dtype=torch.float64)).sum(1)).exp()
    )
