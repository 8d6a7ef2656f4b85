"""How far the surfaces under pixels are: over flat ground, or as a map of the world tells it."""

from typing import Any

import torch
from torch import Tensor

from codesign.render.truth import cameras_of, hits_of
from codesign.types import ChiefRayCamera, Rays

LEVEL = 1e-6  # metres that a ray must fall per metre of depth to meet the ground


def ground_depth(camera: ChiefRayCamera, pixels: Tensor, T_world_cam: Tensor, scene: Any = None) -> Tensor:
    """Depth of the plane z = 0 of the world.

    Args: camera: with ``chief_rays``. pixels: [N, P, 2] px. T_world_cam: [N, 4, 4]. scene: not looked at.
    Returns: [N, P] m along the camera's z axis, float64; infinite where a ray goes up or along the ground.
    Gradient: pose, and the lens behind the chief rays.
    """
    rays = camera.chief_rays(pixels.reshape(-1, 2))
    slope = (rays.direction / rays.direction[:, 2:]).double()
    base = rays.origin_m.double() - slope * rays.origin_m[:, 2:].double()  # where a ray has depth 0
    up = T_world_cam[:, 2, :3].double()[:, None, :, None]
    falling = -(slope.reshape(*pixels.shape[:2], 1, 3) @ up)[..., 0, 0]
    height = T_world_cam[:, 2, 3].double()[:, None] + (base.reshape(*pixels.shape[:2], 1, 3) @ up)[..., 0, 0]
    meets = falling.detach() > LEVEL
    return torch.where(meets, height / torch.where(meets, falling, 1.0), torch.inf)


def scene_depth(camera: ChiefRayCamera, pixels: Tensor, T_world_cam: Tensor, scene: Any) -> Tensor:
    """Depth of what a scene has under the pixels, as a perfect map would know it.

    Args and Returns: as for ``ground_depth``; scene: one, or a tuple of as many for equal shares of the N poses.
    Gradient: pose and lens, the surface taken as its tangent plane.
    """
    scenes = scene if isinstance(scene, tuple | list) else (scene,)
    rays = camera.chief_rays(pixels.reshape(-1, 2))
    found = []
    for number, pose in enumerate(T_world_cam):
        mine = slice(number * pixels.shape[1], (number + 1) * pixels.shape[1])
        here = Rays(rays.origin_m[mine], rays.direction[mine], rays.weight[mine])
        world = scenes[number * len(scenes) // len(T_world_cam)]
        hits = hits_of(here, world, cameras_of(world, pose[None]))
        depth = here.origin_m[:, 2].double() + here.direction[:, 2].double() * hits.distance_m[0]
        found.append(torch.where(hits.part[0] >= 0, depth, torch.inf))
    return torch.stack(found)
