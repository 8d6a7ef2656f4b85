"""How far the surfaces under pixels are: over flat ground, or as a map of the world tells it. What
moves through the world by itself, such as the robot's own body, has no depth: its image says
nothing of the way the body goes."""

from typing import Any

import torch
from torch import Tensor

from codesign.render.hits import Hits, first_hits
from codesign.render.moving import MovingScene, at_frames, views_of
from codesign.types import ChiefRayCamera

LEVEL = 1e-6  # metres that a ray must fall per metre of depth to meet the ground


def ground_depth(
    camera: ChiefRayCamera,
    pixels: Tensor,
    T_world_cam: Tensor,
    scene: Any = None,
) -> Tensor:
    """Depth of the plane z = 0 of the world.

    Args:
      camera: with ``chief_rays``.
      pixels: [N, P, 2] px.
      T_world_cam: [N, 4, 4].
      scene: as for ``scene_depth``; only the objects of a MovingScene are looked at, which hide the
        ground.
    Returns: [N, P] m along the camera's z axis, float64; infinite where a ray goes up or along the
      ground, begins below it, or meets an object that moves.
    Gradient: pose, and the lens behind the chief rays.
    """
    rays = camera.chief_rays(pixels.reshape(-1, 2))
    return _over_ground(rays, pixels, T_world_cam, _hidden(rays, pixels, T_world_cam, scene))


def ground_and_scene_depth(
    camera: ChiefRayCamera, pixels: Tensor, T_world_cam: Tensor, scene: Any
) -> tuple[Tensor, Tensor]:
    """``ground_depth`` and ``scene_depth`` by one cast of rays: what is believed, and what is."""
    rays = camera.chief_rays(pixels.reshape(-1, 2))
    hits, depth_m = _on_surfaces(rays, pixels, T_world_cam, scene)
    return _over_ground(rays, pixels, T_world_cam, hits.part > 0), depth_m


def _over_ground(rays, pixels, T_world_cam, hidden):
    """Depth [N, P] of the ground, infinite where it is hidden [N, P]."""
    slope = (rays.direction / rays.direction[:, 2:]).double()
    base = rays.origin_m.double() - slope * rays.origin_m[:, 2:].double()  # where a ray has depth 0
    up = T_world_cam[:, 2, :3].double()[:, None, :, None]
    rising, above = ((v.reshape(*pixels.shape[:2], 1, 3) @ up)[..., 0, 0] for v in (slope, base))
    falling = -rising
    height = T_world_cam[:, 2, 3].double()[:, None] + above
    meets = (falling.detach() > LEVEL) & (height.detach() > 0) & ~hidden
    return torch.where(meets, height / torch.where(meets, falling, 1.0), torch.inf)


def scene_depth(camera: ChiefRayCamera, pixels: Tensor, T_world_cam: Tensor, scene: Any) -> Tensor:
    """Depth of what a scene has under the pixels, as a perfect map would know it.

    Args and Returns: as for ``ground_depth``; scene: one, or a tuple of as many for equal shares of
      the N poses. Of a MovingScene the objects stand where they are in the middle of its frames,
      and have no depth.
    Gradient: pose and lens, the surface taken as its tangent plane.
    """
    return _on_surfaces(camera.chief_rays(pixels.reshape(-1, 2)), pixels, T_world_cam, scene)[1]


def hidden_by_objects(
    camera: ChiefRayCamera,
    pixels: Tensor,
    T_world_cam: Tensor,
    scene: Any,
) -> Tensor:
    """[N, P] bool: where an object of a MovingScene is seen. Arguments as for ``ground_depth``. No
    gradient."""
    return _hidden(camera.chief_rays(pixels.reshape(-1, 2)), pixels, T_world_cam, scene)


def _hidden(rays, pixels, T_world_cam, scene):
    if not any(isinstance(world, MovingScene) for world in _scenes(scene)):
        return torch.zeros(pixels.shape[:-1], dtype=torch.bool, device=pixels.device)
    return _on_surfaces(rays, pixels, T_world_cam, scene)[0].part > 0


def _on_surfaces(rays, pixels, T_world_cam, scene):
    """First surfaces along rays through pixels [N, P, 2], and their depth [N, P], infinite for
    objects and for none."""
    shape = pixels.shape[:2]
    origin = rays.origin_m.double().reshape(*shape, 3)
    direction = rays.direction.double().reshape(*shape, 3)
    lit = (rays.weight.detach() > 0).reshape(shape)
    scenes = _scenes(scene)
    share = len(T_world_cam) // len(scenes)
    found = []
    for number, world in enumerate(scenes):
        mine = slice(number * share, (number + 1) * share)
        poses = T_world_cam[mine].double()
        if isinstance(world, MovingScene) and world.names:
            middle = world.T_world_object[0].shape[-3] // 2
            world, poses = world.during([middle]), poses[:, None]
        views = views_of(world, poses)
        found.append(
            first_hits(origin[mine], direction[mine], lit[mine], views.scene, views.cameras)
        )
    hits = Hits(
        *(torch.cat([getattr(each, name) for each in found]) for name in Hits.__dataclass_fields__)
    )
    ahead = origin[..., 2] + direction[..., 2] * hits.distance_m
    return hits, torch.where(hits.part == 0, ahead, torch.inf)


def at_frame(scene: Any, frame: int) -> Any:
    """A scene, or each of a tuple of them, with its objects where they are at a frame."""
    if isinstance(scene, tuple | list):
        return tuple(at_frame(world, frame) for world in scene)
    return at_frames(scene, [frame])


def _scenes(scene):
    return scene if isinstance(scene, tuple | list) else (scene,)
