"""One lane per ray and frame: rays in every part's own axes, and the part that is met first."""

from collections.abc import Sequence
from typing import Any


def lanes(arr: Any, line: Sequence[Any], poses: Sequence[Any]) -> tuple[Any, Any, Any, list[Any]]:
    """Every ray in every frame, frame after frame (drjit arrays).

    Args: line: origin (3) and direction (3) before the camera, [N] each. poses: of the camera in every part, rows
      [F x 12] each.
    Returns: number of the ray of every lane, its origin and direction before the camera, and those in each part.
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
    """Radiance of the part met first, its distance and its number; where nothing is met, what the first part says."""
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
