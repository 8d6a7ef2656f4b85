"""All frames of all trajectories in one wavefront: camera-space rays x poses -> pixel means."""

from typing import Any

import torch
from torch import Tensor

from codesign.backend import arrays, load, memory_bytes, run_kernel
from codesign.checks import check_whole
from codesign.errors import DomainError, ShapeError
from codesign.exclusive import exclusive
from codesign.pose import Poses
from codesign.render.moving import MovingScene, Scene, Views, parts, says_distance, views_of
from codesign.render.pixel_means import Wavefront, lanes, nearest, pixel_means, placed
from codesign.types import Rays


def shade(
    rays: Rays,
    scene: Scene | MovingScene,
    T_world_cam: Poses,
    samples_per_pixel: int,
) -> Tensor:
    """Pixel means [..., T, P] of the radiance along rays given in camera space, seen from every
    pose.

    Args:
      rays: Rays with N = P x samples_per_pixel.
      scene: anything with ``radiance`` and ``dtype``, or a MovingScene with T poses per object.
      T_world_cam: [..., T, 4, 4]; all trajectories are one launch.
    Gradient: to the rays (weights included), the poses and the poses of moving objects; the motion
      of silhouettes is not in it.
    """
    return shaded(rays, views_of(scene, T_world_cam, rays), samples_per_pixel)


def shaded(rays: Rays, views: Views, samples_per_pixel: int) -> Tensor:
    """As ``shade``, of views that are known already."""
    scene = views.scene
    count = rays.weight.numel()
    poses = views.cameras.shape[1]
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
                f"a {type(part).__name__} lacks ``radiance`` or ``dtype``, so it cannot be rendered; write "
                "them as TexturedPlane has them."
            )
    dtype = scene.dtype
    if (needed := count * poses * dtype.itemsize) > memory_bytes():
        raise DomainError(
            f"{count * poses:.3g} rays ({count} for each of {poses} frames) bring {needed / 2**30:.3g} GiB "
            f"of light at once, this machine has {memory_bytes() / 2**30:.3g} GiB; render fewer frames at a "
            "time (frame_chunks)."
        )
    lines = [rays.origin_m.mT.to(dtype), rays.direction.mT.to(dtype), rays.weight.to(dtype)]
    cameras = views.cameras[:, :, :3].to(dtype)
    image = pixel_means(Wavefront(parts(scene), samples_per_pixel, dtype), *lines, cameras)
    return image.reshape(*views.batch, -1)


def light_and_nearness(rays: Rays, views: Views) -> tuple[Tensor, Tensor]:
    """Radiance [T, N] along rays [N] given in camera space, seen in views of T frames, and 1 /
    depth [T, N] per metre of what they meet, along the camera's axis; 0 where they meet nothing.
    The rays' weights do not count.

    Gradient: of both to the rays, the poses and the poses of moving objects, as ``shade``; depth
    through the tangent plane of what is met.
    Raises: DomainError for a scene that does not say how far away its light comes from.
    """
    scene = views.scene
    for part in parts(scene):
        if not says_distance(type(part)):
            raise DomainError(
                f"a {type(part).__name__} does not say how far away its light comes from, which a picture by "
                "depth needs; give a MitsubaScene or a TexturedPlane, or render traced frames."
            )
    columns = [*rays.origin_m.unbind(1), *rays.direction.unbind(1)]
    inputs = [c.to(scene.dtype) for c in columns] + [
        pose[:, :3].to(scene.dtype) for pose in views.cameras
    ]
    shape = views.cameras.shape[1], rays.weight.numel()
    light, nearness = run_kernel(_Depths(parts(scene)), inputs, [shape] * 2)
    return light, nearness


@exclusive
def look(
    scene: Any, cameras: Tensor, frame: Tensor, origin: Tensor, direction: Tensor
) -> tuple[Tensor, Tensor]:
    """Radiance [n] and distance [n] along rays [n, 3] in camera axes, each seen in its frame [n] of
    cameras [parts, F, 4, 4]; float64 without gradient."""
    import drjit as dr

    if not len(frame):
        return origin.new_zeros(2, 0, dtype=torch.float64).unbind()
    arr, fine = (arrays(origin.device.type, dtype) for dtype in (scene.dtype, torch.float64))
    at = fine.UInt32(load(fine.Int32, frame.int()))
    o, d = (fine.Array3(*[load(fine.Float, c) for c in v.unbind(1)]) for v in (origin, direction))
    rays = [placed(fine, o, d, load(fine.Float, pose[:, :3]), at) for pose in cameras]
    light, distance, _ = nearest(
        arr, parts(scene), [[arr.Array3(v) for v in pair] for pair in rays]
    )
    dr.eval(light, distance)
    found = (torch.as_tensor(arr.Float(v).numpy()) for v in (light, distance))
    light, distance = (v.to(origin.device, torch.float64) for v in found)
    return light, distance


class _Depths:
    """The kernel of light and 1 / depth, ray by ray."""

    def __init__(self, scenes):
        self.scenes = scenes

    def __call__(self, arr, *columns):
        import drjit as dr

        _, o, d, rays = lanes(arr, columns[:6], columns[6:])
        light, distance, _ = nearest(arr, self.scenes, rays)
        met = dr.isfinite(distance)
        depth = o.z + d.z * dr.select(met, distance, 1)
        return light, dr.select(met & (depth > 0), 1 / dr.select(depth > 0, depth, 1), 0)
