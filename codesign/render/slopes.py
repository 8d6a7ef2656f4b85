"""Slopes of light to the ray that carries it, worked out where the light is, and gradients of pixel means
from them.

The light of a ray depends on six numbers, its origin and direction in the axes of the part that it meets.
Their slopes are known when the light is, at little more cost; with them, gradients to poses, lens and weights
are sums over rays, for which nothing is traced again.
"""

import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from codesign.backend import memory_bytes

BLOCKS = 512  # sums over the rays of a frame are taken in so many parts at once
KEPT = 1 / 8  # of the machine's memory, for slopes that wait for a backward pass


def with_slopes(shown: Callable[..., Any]) -> Callable[..., Any]:
    """A function (origin, direction, *others) -> (light, normal) of drjit arrays as one that returns light,
    normal, and the slopes of light to origin and direction, all without a graph.

    Differentiating through a call would visit the surface once more; here that ends inside the call.
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
            # a ray that touches a round shape, or meets a pole of its picture, has no slope: one in some
            # millions
            told = dr.all(dr.isfinite(slopes[0])) & dr.all(dr.isfinite(slopes[1])) | ~dr.isfinite(light)
            return dr.detach(light), dr.detach(normal), *(dr.select(told, slope, 0) for slope in slopes)

    return sloped


@dataclass(frozen=True, eq=False)
class Slopes:
    """Of F x N rays, one frame after the other (drjit arrays): slopes [6] to origin and direction in the axes
    of the part that is met, number of that part (None: there is one only), light (None where nobody asks for
    weights)."""

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
    """Gradients of origin (3), direction (3) and weight of N rays before the camera: drjit arrays [N].

    Args: arr: drjit types. kept: slopes of ``frames`` frames. seed: gradient of the pixel means, [F x
      pixels]. weight:
      [N]. poses: [parts x F x 12], rows of the camera's poses in the parts. samples: rays per pixel.
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
            sum(m[4 * row + k] * slope[first + row] for row in range(3)) for first in (0, 3) for k in range(3)
        ]
        return frame + 1, *(total + more for total, more in zip(sums, (*turned, light), strict=True))

    zero = dr.zeros(arr.Float, count)
    begun = (dr.zeros(arr.UInt32, count), *[zero] * 7)
    *found, light = dr.while_loop(begun, lambda frame, *_: frame < end, step, mode="symbolic")[1:]
    return *found, light / samples


def pose_gradients(
    arr: Any, kept: Slopes, seed: Any, rays: Sequence[Any], parts: int, frames: int, samples: int
) -> list[Any]:
    """Gradients of the 12 numbers of the camera's pose in every part, part after part: drjit arrays [F] each.

    Args: as for ``ray_gradients``. rays: origin (3) and direction (3) before the camera and weight, [N] each.
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
