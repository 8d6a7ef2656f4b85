"""Pixel means of a wavefront in torch's graph, and their gradients.

Forward one launch, a lane per ray and frame. The light of a ray depends on six numbers, its origin
and direction in the axes of the part that it meets. Their slopes are known when the light is, at
little more cost; with them, gradients to poses, lens and weights are sums over rays, for which
nothing is traced again.
"""

import weakref
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign.backend import arrays, first_only, load, memory_bytes
from codesign.errors import GradientError
from codesign.exclusive import exclusive

BLOCKS = 512  # sums over the rays of a frame are taken in so many parts at once
KEPT = 1 / 8  # of the machine's memory, for slopes that wait for a backward pass
NUMBERS = 7  # kept of every ray, at most


def with_slopes(shown: Callable[..., Any]) -> Callable[..., Any]:
    """A function (origin, direction, *others) -> (light, normal) of drjit arrays as one that
    returns light, normal, and the slopes of light to origin and direction, all without a graph.

    Differentiating through a call would visit the surface once more; here that ends inside the
    call.
    """

    def sloped(origin, direction, *others):
        import drjit as dr

        origin = type(origin)(origin)
        direction = type(direction)(direction)
        with dr.resume_grad():
            dr.enable_grad(origin, direction)
            light, normal = shown(origin, direction, *others)
            if dr.grad_enabled(light):
                dr.backward(light)
            slopes = dr.grad(origin), dr.grad(direction)
            # a ray that touches a round shape, or meets a pole of its picture, has no slope: one in
            # some millions
            told = dr.all(dr.isfinite(slopes[0])) & dr.all(dr.isfinite(slopes[1])) | ~dr.isfinite(
                light
            )
            return (
                dr.detach(light),
                dr.detach(normal),
                *(dr.select(told, slope, 0) for slope in slopes),
            )

    return sloped


@dataclass(frozen=True, eq=False)
class Slopes:
    """Of F x N rays, one frame after the other (drjit arrays): slopes [6] to origin and direction
    in the axes of the part that is met, number of that part (None: there is one only), light (None
    where nobody asks for weights)."""

    slopes: Sequence[Any]
    part: Any
    light: Any


class Room:
    """Counts the bytes of what is kept, so that many renders together leave memory to others."""

    def __init__(self) -> None:
        self._sizes: weakref.WeakKeyDictionary[Slopes, int] = weakref.WeakKeyDictionary()

    @property
    def taken(self) -> int:
        """Bytes of all slopes that live; threads add and free them at once."""
        return sum(size for _, size in self._sizes.items())

    def left(self) -> int:
        """Bytes that may be kept beside the others."""
        return int(KEPT * memory_bytes()) - self.taken

    def take(self, slopes: Slopes, size: int) -> None:
        """Count them for as long as the slopes live."""
        self._sizes[slopes] = size


ROOM = Room()


def ray_gradients(
    arr: Any, kept: Slopes, seed: Any, weight: Any, poses: Any, frames: int, samples: int
) -> tuple[Any, ...]:
    """Gradients of origin (3), direction (3) and weight of N rays before the camera: drjit arrays
    [N].

    Args:
      arr: drjit types.
      kept: slopes of ``frames`` frames.
      seed: gradient of the pixel means, [F x pixels].
      weight: [N].
      poses: [parts x F x 12], rows of the camera's poses in the parts.
      samples: rays per pixel.
    """
    import drjit as dr

    count = dr.width(weight)
    ray = dr.arange(arr.UInt32, count)
    pixel = ray // samples
    rays, pixels = (dr.opaque(arr.UInt32, n) for n in (count, count // samples))
    end = dr.opaque(arr.UInt32, frames)
    scale = weight / samples

    def step(frame, *sums):
        at = frame * rays + ray
        mean = dr.gather(arr.Float, seed, frame * pixels + pixel)
        place = frame if kept.part is None else frame + end * dr.gather(arr.UInt32, kept.part, at)
        m = [dr.gather(arr.Float, poses, place * 12 + k) for k in range(12)]
        slope = [dr.gather(arr.Float, each, at) * (mean * scale) for each in kept.slopes]
        light = 0 if kept.light is None else mean * dr.gather(arr.Float, kept.light, at)
        turned = [
            sum(m[4 * row + k] * slope[first + row] for row in range(3))
            for first in (0, 3)
            for k in range(3)
        ]
        return frame + 1, *(
            total + more for total, more in zip(sums, (*turned, light), strict=True)
        )

    zero = dr.zeros(arr.Float, count)
    begun = (dr.zeros(arr.UInt32, count), *[zero] * 7)
    *found, light = dr.while_loop(begun, lambda frame, *_: frame < end, step, mode="symbolic")[1:]
    return *found, light / samples


def pose_gradients(
    arr: Any, kept: Slopes, seed: Any, rays: Sequence[Any], parts: int, frames: int, samples: int
) -> list[Any]:
    """Gradients of the 12 numbers of the camera's pose in every part, part after part: drjit arrays
    [F] each.

    Args:
      as for ``ray_gradients``.
      rays: origin (3) and direction (3) before the camera and weight, [N] each.
    """
    import drjit as dr

    *line, weight = rays
    count = dr.width(weight)
    lane = dr.arange(arr.UInt32, frames * BLOCKS)
    frame = lane // BLOCKS
    number, pixels = (dr.opaque(arr.UInt32, n) for n in (count, count // samples))
    blocks = dr.opaque(arr.UInt32, BLOCKS)

    def step(ray, *sums):
        inside = ray < number
        at = frame * number + ray
        met = None if kept.part is None else dr.gather(arr.UInt32, kept.part, at, inside)
        mean = dr.gather(arr.Float, seed, frame * pixels + ray // samples, inside)
        mean = mean * dr.gather(arr.Float, weight, ray, inside)
        slope = [dr.gather(arr.Float, each, at, inside) * mean for each in kept.slopes]
        value = [dr.gather(arr.Float, each, ray, inside) for each in line]
        more = []
        for row in range(3):
            turn = [slope[row] * value[k] + slope[3 + row] * value[3 + k] for k in range(3)]
            more += [*turn, slope[row]]
        if met is not None:
            more = [dr.select(met == part, each, 0) for part in range(parts) for each in more]
        return ray + blocks, *(total + each for total, each in zip(sums, more, strict=True))

    zero = dr.zeros(arr.Float, frames * BLOCKS)
    begun = (lane - frame * BLOCKS, *[zero] * 12 * parts)
    sums = dr.while_loop(begun, lambda ray, *_: ray < number, step, mode="symbolic")[1:]
    dr.eval(sums)  # at once: each block sum would run the loop for itself
    return [dr.block_sum(total, BLOCKS) / samples for total in sums]


@dataclass(frozen=True)
class Wavefront:
    """scenes: the parts. samples: rays per pixel. dtype: of the kernel."""

    scenes: Sequence[Any]
    samples: int
    dtype: torch.dtype

    def image(self, arr: Any, rays: Sequence[Any], poses: Sequence[Any]) -> Any:
        """Pixel means [F x pixels] of rays: origin (3), direction (3) and weight [N], from poses
        [F x 12] in each part (drjit arrays)."""
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
        # at once: each sum would trace for itself
        dr.eval(carried, kept.slopes, kept.part, kept.light)
        return dr.block_sum(carried, self.samples) / self.samples, kept

    def _seen(self, arr, placed):
        """Light of every lane, and the number of the part that it comes from
        (None: there is one only)."""
        if len(placed) == 1:
            return self.scenes[0].radiance(arr, *placed[0]), None
        light, _, part = nearest(arr, self.scenes, placed)
        return light, part


def pixel_means(
    wavefront: Wavefront, origin: Tensor, direction: Tensor, weight: Tensor, poses: Tensor
) -> Tensor:
    """Pixel means [F, pixels] of rays given in camera space, origin and direction [3, N], weight
    [N], seen from poses [parts, F, 3, 4] of the camera; all of the wavefront's dtype.

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
                # of a scene without gradient: it says so when one is asked for
                with suppress(GradientError):
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

    Args:
      line: origin (3) and direction (3) before the camera, [N] each.
      poses: of the camera in every part, rows [F x 12] each.
    Returns: number of the ray of every lane, its origin and direction before the camera, and those
      in each part.
    """
    import drjit as dr

    count = dr.width(line)
    lane = dr.arange(arr.UInt32, count * (dr.width(poses[0]) // 12))
    frame = lane // count
    ray = lane - frame * count
    o, d = (
        arr.Array3(*[dr.gather(arr.Float, v, ray) for v in part]) for part in (line[:3], line[3:])
    )
    return ray, o, d, [placed(arr, o, d, pose, frame) for pose in poses]


def placed(arr: Any, o: Any, d: Any, pose: Any, frame: Any) -> tuple[Any, Any]:
    """Origins and directions in the frame of a part, by the pose of the camera in it at each lane's
    frame."""
    import drjit as dr

    m = [dr.gather(arr.Float, pose, frame * 12 + k) for k in range(12)]
    origin = arr.Array3(
        *[m[4 * r] * o.x + m[4 * r + 1] * o.y + m[4 * r + 2] * o.z + m[4 * r + 3] for r in range(3)]
    )
    return origin, arr.Array3(
        *[m[4 * r] * d.x + m[4 * r + 1] * d.y + m[4 * r + 2] * d.z for r in range(3)]
    )


def nearest(arr: Any, scenes: Sequence[Any], placed: Sequence[Any]) -> tuple[Any, Any, Any]:
    """Radiance of the part met first, its distance and its number; where nothing is met, what the
    first part says."""
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
