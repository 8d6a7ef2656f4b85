"""Pixel means of a wavefront in torch's graph: forward one launch, a lane per ray and frame, backward the
sums of ``slopes``."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign.backend import arrays, first_only, load
from codesign.errors import GradientError
from codesign.exclusive import exclusive
from codesign.render.slopes import ROOM, Slopes, pose_gradients, ray_gradients

NUMBERS = 7  # kept of every ray, at most


@dataclass(frozen=True)
class Wavefront:
    """scenes: the parts. samples: rays per pixel. dtype: of the kernel."""

    scenes: Sequence[Any]
    samples: int
    dtype: torch.dtype

    def image(self, arr: Any, rays: Sequence[Any], poses: Sequence[Any]) -> Any:
        """Pixel means [F x pixels] of rays: origin (3), direction (3) and weight [N], from poses [F x 12] in
        each part (drjit arrays)."""
        import drjit as dr

        *line, weight = rays
        ray, _, _, placed = lanes(arr, line, poses)
        light, _ = self._seen(arr, placed)
        return dr.block_sum(light * dr.gather(arr.Float, weight, ray), self.samples) / self.samples

    def sloped(
        self, arr: Any, rays: Sequence[Any], poses: Sequence[Any], keeps_light: bool
    ) -> tuple[Any, Slopes]:
        """The same, and the slopes of every ray's light."""
        import drjit as dr

        *line, weight = rays
        ray, _, _, placed = lanes(arr, line, poses)
        with dr.resume_grad():
            dr.enable_grad(placed)
            light, part = self._seen(arr, placed)
            if dr.grad_enabled(light):
                dr.backward(light)
            slopes = [
                sum((dr.grad(each[half][k]) for each in placed), dr.zeros(arr.Float, dr.width(ray)))
                for half in (0, 1)
                for k in range(3)
            ]
        light = dr.detach(light)
        kept = Slopes(slopes, part, light if keeps_light else None)
        carried = light * dr.gather(arr.Float, weight, ray)
        dr.eval(carried, kept.slopes, kept.part, kept.light)  # at once: each sum would trace for itself
        return dr.block_sum(carried, self.samples) / self.samples, kept

    def _seen(self, arr, placed):
        """Light of every lane, and the number of the part that it comes from (None: there is one only)."""
        if len(placed) == 1:
            return self.scenes[0].radiance(arr, *placed[0]), None
        light, _, part = nearest(arr, self.scenes, placed)
        return light, part


def pixel_means(
    wavefront: Wavefront, origin: Tensor, direction: Tensor, weight: Tensor, poses: Tensor
) -> Tensor:
    """Pixel means [F, pixels] of rays given in camera space, origin and direction [3, N], weight [N], seen
    from poses [parts, F, 3, 4] of the camera; all of the wavefront's dtype.

    Gradient: to all four, silhouettes at rest.
    """
    tensors = (origin, direction, weight, poses)
    wanted = torch.is_grad_enabled() and any(each.requires_grad for each in tensors)
    return _PixelMeans.apply(wavefront, wanted, *tensors)


class _PixelMeans(torch.autograd.Function):
    @staticmethod
    @exclusive
    def forward(ctx, wavefront, wanted, *tensors):
        import drjit as dr

        ctx.wavefront = wavefront
        ctx.kept = None
        ctx.save_for_backward(*tensors)
        arr, rays, poses = _to_drjit(wavefront, *tensors)
        size = NUMBERS * len(poses[0]) // 12 * len(rays[0]) * wavefront.dtype.itemsize
        with dr.suspend_grad():
            if wanted and size <= ROOM.left():
                with suppress(GradientError):  # of a scene without gradient: it says so when one is asked for
                    image, ctx.kept = wavefront.sloped(arr, rays, poses, ctx.needs_input_grad[4])
                    ROOM.take(ctx.kept, size)
            if ctx.kept is None:
                image = wavefront.image(arr, rays, poses)
            dr.eval(image)
        dr.sync_thread()
        return image.torch().reshape(len(poses[0]) // 12, -1).clone()

    @staticmethod
    def backward(ctx, grad):  # pyright: ignore[reportIncompatibleMethodOverride]
        tensors = ctx.saved_tensors
        with torch.no_grad():
            found = _gradients(ctx, grad, *tensors)
        return None, None, *first_only(found, (*tensors, grad))


def _to_drjit(wavefront, origin, direction, weight, poses):
    arr = arrays(weight.device.type, wavefront.dtype)
    rays = [_flat(arr, row) for row in (*origin, *direction, weight)]
    return arr, rays, [_flat(arr, pose) for pose in poses]


def _flat(arr, tensor):
    return load(arr.Float, tensor)


@exclusive
def _gradients(ctx, grad, origin, direction, weight, poses):
    """Gradients of the four tensors; None for those that ask for none."""
    import drjit as dr

    wavefront = ctx.wavefront
    wants_rays, wants_poses = any(ctx.needs_input_grad[2:5]), ctx.needs_input_grad[5]
    frames = poses.shape[1]
    size = NUMBERS * len(weight) * wavefront.dtype.itemsize
    most = frames if ctx.kept is not None else max(1, ROOM.left() // size)
    of_rays = []
    of_poses = []
    for some in torch.arange(frames).split(most):
        mine = poses[:, some]
        arr, rays, its_poses = _to_drjit(wavefront, origin, direction, weight, mine)
        kept = ctx.kept
        if kept is None:
            kept = wavefront.sloped(arr, rays, its_poses, ctx.needs_input_grad[4])[1]
        seed = _flat(arr, grad[some])
        call = len(some), wavefront.samples
        if wants_rays:
            of_rays.append(ray_gradients(arr, kept, seed, rays[6], _flat(arr, mine), *call))
        if wants_poses:
            of_poses.append(pose_gradients(arr, kept, seed, rays, len(poses), *call))
        dr.eval(of_rays, of_poses)
    dr.sync_thread()
    found: list[Tensor | None] = [None] * 4
    if wants_rays:
        total = torch.stack([torch.stack([v.torch() for v in each]) for each in of_rays]).sum(0)
        found[:3] = total[:3], total[3:6], total[6]
    if wants_poses:
        numbers = torch.cat([torch.stack([v.torch() for v in each]) for each in of_poses], 1)
        found[3] = numbers.reshape(len(poses), 3, 4, frames).movedim(-1, 1)
    return found


def lanes(arr: Any, line: Sequence[Any], poses: Sequence[Any]) -> tuple[Any, Any, Any, list[Any]]:
    """Every ray in every frame, frame after frame (drjit arrays).

    Args: line: origin (3) and direction (3) before the camera, [N] each. poses: of the camera in every part,
      rows [F x 12] each.
    Returns: number of the ray of every lane, its origin and direction before the camera, and those in each
      part.
    """
    import drjit as dr

    count = dr.width(line)
    lane = dr.arange(arr.UInt32, count * (dr.width(poses[0]) // 12))
    frame = lane // count
    ray = lane - frame * count
    o, d = (arr.Array3(*[dr.gather(arr.Float, v, ray) for v in part]) for part in (line[:3], line[3:]))
    return ray, o, d, [placed(arr, o, d, pose, frame) for pose in poses]


def placed(arr: Any, o: Any, d: Any, pose: Any, frame: Any) -> tuple[Any, Any]:
    """Origins and directions in the frame of a part, by the pose of the camera in it at each lane's frame."""
    import drjit as dr

    m = [dr.gather(arr.Float, pose, frame * 12 + k) for k in range(12)]
    origin = arr.Array3(
        *[m[4 * r] * o.x + m[4 * r + 1] * o.y + m[4 * r + 2] * o.z + m[4 * r + 3] for r in range(3)]
    )
    return origin, arr.Array3(*[m[4 * r] * d.x + m[4 * r + 1] * d.y + m[4 * r + 2] * d.z for r in range(3)])


def nearest(arr: Any, scenes: Sequence[Any], placed: Sequence[Any]) -> tuple[Any, Any, Any]:
    """Radiance of the part met first, its distance and its number; where nothing is met, what the first part
    says."""
    import drjit as dr

    light, least = scenes[0].radiance_and_distance(arr, *placed[0])
    part = arr.UInt32(0)
    for number, (scene, rays) in enumerate(zip(scenes[1:], placed[1:], strict=True), 1):
        other, distance = scene.radiance_and_distance(arr, *rays)
        closer = distance < least
        light = dr.select(closer, other, light)
        part = dr.select(closer, number, part)
        least = dr.minimum(distance, least)
    return light, least, part
