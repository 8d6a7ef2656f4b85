"""Ground truth through the current lens: world points under chief rays, depth and flow, in float64 with gradients."""

import torch

from codesign.errors import ShapeError
from codesign.pose import apply, check_poses, inverse


def world_points(project_rays, scene, T_world_cam):
    """World points under rays given in camera space, from one pose.

    Args: project_rays: Rays [N] (chief rays). scene: anything with ``hit``. T_world_cam: [4, 4].
    Returns: points [N, 3] metres, depth [N] along the camera's z axis, valid [N].
    Gradient: to rays and pose, the surface taken as its tangent plane at the hit.
    """
    pose = T_world_cam.double()
    origin, direction = apply(pose, project_rays.origin_m.double()), project_rays.direction.double() @ pose[:3, :3].mT
    point, normal, valid = scene.hit(origin, direction)
    falling = (direction * normal).sum(1)
    usable = valid & (falling.detach().abs() > 1e-9) & (project_rays.weight.detach() > 0)
    distance = ((point - origin) * normal).sum(1) / torch.where(usable, falling, torch.ones_like(falling))
    distance = torch.where(usable, distance, torch.ones_like(distance))
    points = origin + direction * distance[:, None]
    return points, apply(inverse(pose), points)[:, 2], usable


def true_flow(camera, scene, T_world_cam, project, stride=1):
    """Flow of every pixel centre from each pose to the one ``stride`` later, through the camera's current lens.

    Args: camera with ``chief_rays`` and ``film``; scene with ``hit``; T_world_cam [T, 4, 4];
      project: function (camera, points_cam_m [N, 3]) -> [N, 2] px.
    Returns: flow [T - stride, 2, *film.shape] px, +x right, +y down; valid [T - stride, *film.shape], False where the ray meets nothing
      or the point leaves the field of the lens (the flow is 0 there).
    Gradient: to lens and poses. A static world is assumed; occlusion at the later time is not tested.
    Raises: ShapeError when there are not more poses than ``stride``.
    """
    check_poses(T_world_cam)
    if not 1 <= stride < T_world_cam.shape[0]:
        raise ShapeError(f"true flow over {stride} pose(s) ahead needs a stride of at least 1 and more poses than that, got {T_world_cam.shape[0]}; give more poses.")
    pixels = camera.film.pixels()
    rays = camera.chief_rays(pixels)
    flows, masks = [], []
    for now in range(T_world_cam.shape[0] - stride):
        points, _, valid = world_points(rays, scene, T_world_cam[now])
        ahead = apply(inverse(T_world_cam[now + stride].double()), points)
        seen = valid & (ahead.detach()[:, 2] > 1e-6)
        ahead = torch.where(seen[:, None], ahead, torch.tensor([0.0, 0.0, 1.0], dtype=ahead.dtype))
        moved = project(camera, ahead) - pixels
        seen = seen & ~moved.detach().isnan().any(1)
        flows.append(torch.where(seen[:, None], moved, torch.zeros_like(pixels)).T.reshape(2, *camera.film.shape))
        masks.append(seen.reshape(camera.film.shape))
    return torch.stack(flows), torch.stack(masks)
