"""All frames of all trajectories in one wavefront: camera-space rays x poses -> pixel means."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from codesign.backend import arrays, memory_bytes, run_kernel
from codesign.errors import DomainError, ShapeError, check_whole
from codesign.pose import Poses, as_poses
from codesign.render.kinds import Scene
from codesign.render.moving import MovingScene, cameras_in_parts, in_one_row, parts, says_distance
from codesign.types import Rays

# an edge is hidden when all beside it is nearer by this share; a face next to it comes nearer by less
HIDDEN = 5e-3


def shade(rays: Rays, scene: Scene | MovingScene, T_world_cam: Poses, samples_per_pixel: int) -> Tensor:
    """Pixel means [..., T, P] of the radiance along rays given in camera space, seen from every pose.

    Args: rays: Rays with N = P x samples_per_pixel. scene: anything with ``radiance`` and ``dtype``, or a
      MovingScene with T poses per object. T_world_cam: [..., T, 4, 4]; all trajectories are one launch.
    Gradient: to the rays (weights included), the poses and the poses of moving objects; the motion of
      silhouettes is not in it.
    """
    T_world_cam = as_poses(T_world_cam)
    batch = T_world_cam.shape[:-2]
    scene, T_world_cam = in_one_row(scene, T_world_cam, rays)
    count = rays.weight.numel()
    poses = T_world_cam.shape[0]
    samples_per_pixel = check_whole(samples_per_pixel, "samples_per_pixel")
    if count % samples_per_pixel:
        raise ShapeError(
            f"{count} rays are not a whole number of pixels at {samples_per_pixel} samples each."
        )
    if count * poses >= 2**32:
        raise DomainError(
            f"{count * poses} rays ({count} for each of {poses} frames) do not fit into one launch; render "
            "fewer frames at a time (frame_chunks)."
        )
    for part in parts(scene):
        if not hasattr(part, "radiance") or not hasattr(part, "dtype"):
            raise DomainError(
                f"a {type(part).__name__} lacks ``radiance`` or ``dtype``, so it cannot be rendered; write them "
                "as TexturedPlane has them."
            )
    dtype = scene.dtype
    if (needed := count * poses * dtype.itemsize) > memory_bytes():
        raise DomainError(
            f"{count * poses:.3g} rays ({count} for each of {poses} frames) bring {needed / 2**30:.3g} GiB of light "
            f"at once, this machine has {memory_bytes() / 2**30:.3g} GiB; render fewer frames at a time "
            "(frame_chunks)."
        )
    columns = [*rays.origin_m.unbind(1), *rays.direction.unbind(1), rays.weight]
    inputs = [c.to(dtype) for c in columns] + [
        pose[:, :3].to(dtype) for pose in cameras_in_parts(scene, T_world_cam)
    ]
    kernel = _Wavefront(parts(scene), count, poses, samples_per_pixel)
    (image,) = run_kernel(kernel, inputs, [(poses, count // samples_per_pixel)])
    return image.reshape(*batch, -1)


def light_and_nearness(rays: Rays, scene: Scene | MovingScene, T_world_cam: Tensor) -> tuple[Tensor, Tensor]:
    """Radiance [T, N] along rays [N] given in camera space, seen from poses [T, 4, 4], and 1 / depth [T, N] per
    metre of what they meet, along the camera's axis; 0 where they meet nothing. The rays' weights do not count.

    Gradient: of both to the rays, the poses and the poses of moving objects, as ``shade``; depth through the
    tangent plane of what is met.
    Raises: DomainError for a scene that does not say how far away its light comes from.
    """
    for part in parts(scene):
        if not says_distance(type(part)):
            raise DomainError(
                f"a {type(part).__name__} does not say how far away its light comes from, which a picture by "
                "depth needs; give a MitsubaScene or a TexturedPlane, or render traced frames."
            )
    poses = T_world_cam.shape[0]
    count = rays.weight.numel()
    columns = [*rays.origin_m.unbind(1), *rays.direction.unbind(1)]
    inputs = [c.to(scene.dtype) for c in columns] + [
        pose[:, :3].to(scene.dtype) for pose in cameras_in_parts(scene, T_world_cam)
    ]
    kernel = _Depths(parts(scene), count, poses, 1)
    light, nearness = run_kernel(kernel, inputs, [(poses, count)] * 2)
    return light, nearness


def look(scene: Any, cameras: Tensor, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Radiance [n] and distance [n] along rays [n, 3] in camera axes, seen from poses [parts, n, 4, 4] of the camera;
    float64 without gradient."""
    import drjit as dr

    arr = arrays(origin.device.type, scene.dtype)

    def columns(vectors):
        return arr.Array3(*[arr.Float(c.to(scene.dtype).contiguous()) for c in vectors.unbind(1)])

    placed = [
        (
            columns((pose[:, :3, :3] @ origin[..., None])[..., 0] + pose[:, :3, 3]),
            columns((pose[:, :3, :3] @ direction[..., None])[..., 0]),
        )
        for pose in cameras
    ]
    light, distance = nearest(arr, parts(scene), placed)
    dr.eval(light, distance)
    light, distance = (torch.as_tensor(arr.Float(v).numpy()).double() for v in (light, distance))
    return light, distance


class _Wavefront:
    """The kernel: rays into every part's own frame, and the light of the part that is met first."""

    def __init__(self, scenes, count, poses, samples):
        self.scenes = scenes
        self.count = count
        self.poses = poses
        self.samples = samples

    def __call__(self, arr, ox, oy, oz, dx, dy, dz, weight, *poses):
        import drjit as dr

        ray, o, d, placed = self._lanes(arr, (ox, oy, oz), (dx, dy, dz), poses)
        seen = (
            self.scenes[0].radiance(arr, *placed[0])
            if len(placed) == 1
            else nearest(arr, self.scenes, placed)[0]
        )
        light = seen * dr.gather(arr.Float, weight, ray)
        if dr.grad_enabled(
            light
        ):  # the adjoint of the sum needs no values of light: without this it would be rendered twice
            light = dr.replace_grad(dr.zeros(arr.Float, dr.width(light)), light)
        return (dr.block_sum(light, self.samples) / self.samples,)

    def _lanes(self, arr, origin, direction, poses):
        """Number of the ray of every lane, its origin and direction before the camera, and those in each part."""
        import drjit as dr

        lane = dr.arange(arr.UInt32, self.count * self.poses)
        frame = lane // self.count
        ray = lane - frame * self.count
        o, d = (arr.Array3(*[dr.gather(arr.Float, v, ray) for v in part]) for part in (origin, direction))
        return ray, o, d, [_placed(arr, o, d, pose, frame) for pose in poses]


class _Depths(_Wavefront):
    """The kernel of light and 1 / depth, ray by ray."""

    def __call__(self, arr, ox, oy, oz, dx, dy, dz, *poses):
        import drjit as dr

        _, o, d, placed = self._lanes(arr, (ox, oy, oz), (dx, dy, dz), poses)
        light, distance = nearest(arr, self.scenes, placed)
        met = dr.isfinite(distance)
        depth = o.z + d.z * dr.select(met, distance, 1)
        return light, dr.select(met & (depth > 0), 1 / dr.select(depth > 0, depth, 1), 0)


def _placed(arr, o, d, pose, frame):
    """Origins and directions in the frame of a part, by the pose of the camera in it at each lane's frame."""
    import drjit as dr

    m = [dr.gather(arr.Float, pose, frame * 12 + k) for k in range(12)]
    origin = arr.Array3(
        *[m[4 * r] * o.x + m[4 * r + 1] * o.y + m[4 * r + 2] * o.z + m[4 * r + 3] for r in range(3)]
    )
    return origin, arr.Array3(*[m[4 * r] * d.x + m[4 * r + 1] * d.y + m[4 * r + 2] * d.z for r in range(3)])


def nearest(arr: Any, scenes: Sequence[Any], placed: Sequence[Any]) -> tuple[Any, Any]:
    """Radiance of the part met first and its distance; where nothing is met, what the first part says."""
    import drjit as dr

    light, least = scenes[0].radiance_and_distance(arr, *placed[0])
    for scene, rays in zip(scenes[1:], placed[1:], strict=True):
        other, distance = scene.radiance_and_distance(arr, *rays)
        light = dr.select(distance < least, other, light)
        least = dr.minimum(distance, least)
    return light, least
