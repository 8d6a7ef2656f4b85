"""What rays meet first, in any number of frames at once: one cast for all of them."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign.render.moving import parts
from codesign.render.rows import Rows


@dataclass(frozen=True)
class Hits(Rows):
    """First surfaces along rays of F frames: local_m, normal [F, P, 3] in the axes of the part
    [F, P] that is met (-1 for none), distance_m [F, P] (infinite for none)."""

    local_m: Tensor
    normal: Tensor
    part: Tensor
    distance_m: Tensor


def first_hits(
    origin_cam_m: Tensor,
    direction_cam: Tensor,
    lit: Tensor,
    scene: Any,
    cameras: Tensor,
) -> Hits:
    """The nearest surface of all parts of a scene along rays given in camera space.

    Args:
      origin_cam_m, direction_cam: [P, 3], the same rays in every frame, or [F, P, 3].
      lit: [P] or [F, P] bool; rays that carry no light meet nothing.
      cameras: [parts, F, 4, 4], poses of the camera in the axes of every part.
    Gradient: to rays and poses, surfaces taken as their tangent planes.
    A frame's values do not depend on the frames beside it: every product is written out by element.
    """
    shape = (cameras.shape[1], *direction_cam.shape[-2:-1])
    origin_cam_m = origin_cam_m.double()
    direction_cam = direction_cam.double()
    nearest = direction_cam.new_full(shape, torch.inf)
    local = normal = direction_cam.new_zeros(*shape, 3)
    part = torch.full_like(nearest, -1, dtype=torch.long)
    for number, (surface, pose) in enumerate(
        zip(parts(scene), cameras.double()[:, :, None], strict=True)
    ):
        origin = (turned(pose, origin_cam_m) + pose[..., :3, 3]).expand(*shape, 3)
        direction = turned(pose, direction_cam).expand(*shape, 3)
        point, across, valid = (
            v.reshape(*shape, *v.shape[1:])
            for v in surface.hit(origin.reshape(-1, 3), direction.reshape(-1, 3))
        )
        across = across.double()
        falling = dot(direction, across)
        usable = valid & (falling.detach().abs() > 1e-9) & lit
        distance = dot(point - origin, across) / torch.where(usable, falling, 1.0)
        distance = torch.where(usable, distance, 1.0)
        closer = usable & (distance.detach() < nearest.detach())
        nearest = torch.where(closer, distance, nearest)
        local = torch.where(closer[..., None], origin + direction * distance[..., None], local)
        normal = torch.where(closer[..., None], across, normal)
        part = torch.where(closer, number, part)
    return Hits(local, normal, part, nearest)


def carried(hits: Hits, transforms: Tensor) -> Tensor:
    """Points [F, P, 3] that were hit, from the axes of their part by transforms
    [parts, F, 4, 4]."""
    own = of_part(hits, transforms)
    return turned(own, hits.local_m) + own[..., :3, 3]


def of_part(hits: Hits, transforms: Tensor) -> Tensor:
    """Of transforms [parts, F, 4, 4] those of the part that each ray meets: [F, P, 4, 4], or
    [F, 1, 4, 4] where there is one part only."""
    if len(transforms) == 1:
        return transforms[0][:, None]
    frame = torch.arange(len(hits.part), device=transforms.device)
    return transforms[hits.part.clamp_min(0), frame[:, None]]


def turned(transform: Tensor, vectors: Tensor) -> Tensor:
    """Vectors [..., 3] turned by the rotations of transforms [..., 4, 4]."""
    x, y, z = (transform[..., :3, k] * vectors[..., k : k + 1] for k in range(3))
    return x + y + z


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Products [...] of vectors [..., 3]."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]
