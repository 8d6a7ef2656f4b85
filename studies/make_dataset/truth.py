"""Depth, objects, flow and occlusion of many frames at once, without gradients.

The same truth as codesign.render's view and flow_and_occlusion, which trace rays through the lens for every
frame; here chief rays are traced once and points are projected by a table (make_dataset.chart), and all rays
of a chunk of frames meet the scene together.

A frame's truth is the same to the last bit whatever chunk it is in, on one machine with one number of
threads: poses turn rays by products and sums in an order of ours, and the table, a matrix product, sees one
frame per call.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.pose import inverse
from codesign.render.moving import cameras_in_parts, parts
from codesign.render.truth import GRAZING, ROUNDING

NEAREST_M = 1e-6  # points closer to the plane of the pupil have no image


@dataclass(frozen=True)
class Truth:
    """Of F frames: depth_m [F, H, W], 0 where nothing is seen; object_id [F, H, W] int64 (0 static, then
    moving objects, -1 nothing);
    segment_id [F, H, W] int64, index into Segments.names, -1 nothing.

    From each of the first F - 1 (or F) frames to the one behind it: flow_px [n, 2, H, W], 0 where not valid;
    valid, occluded [n, H, W] bool.
    """

    depth_m: Tensor
    object_id: Tensor
    segment_id: Tensor
    flow_px: Tensor
    valid: Tensor
    occluded: Tensor


@torch.no_grad()
def truth_of_frames(chart, chief_rays, scene, T_world_cam, count, segments):
    """Truth of the first ``count`` frames of T_world_cam [T >= count, 4, 4]; flow where there is a frame
    behind (T > count, or to the last of T = count).

    Args: chart: Chart of the camera. chief_rays: its chief rays through all pixel centres. scene: anything
      with ``hit``, or a MovingScene with T poses.
      segments: Segments of the scene.
    """
    shape = chart.camera.film.shape
    cameras = torch.stack(
        [poses.double() for poses in cameras_in_parts(scene, T_world_cam)]
    )  # [parts, T, 4, 4]
    pairs = min(count, T_world_cam.shape[0] - 1)
    origin, direction = (v.double().expand(count, -1, 3) for v in (chief_rays.origin_m, chief_rays.direction))
    local, normal, part, distance = _first(
        scene, cameras[:, :count], origin, direction, chief_rays.weight > 0
    )
    hit = part >= 0
    segment = segments.at(cameras[:, :count], origin, direction, part)
    depth = torch.where(
        hit, chief_rays.origin_m[:, 2] + chief_rays.direction[:, 2] * torch.where(hit, distance, 0.0), 0.0
    )

    def fit(v):
        return v.reshape(v.shape[0], *shape)

    if not pairs:
        none = torch.zeros(0, *shape, dtype=torch.bool)
        return Truth(
            fit(depth), fit(part), fit(segment), torch.zeros(0, 2, *shape, dtype=torch.float64), none, none
        )
    local = local[:pairs]
    normal = normal[:pairs]
    owner = part[:pairs].clamp_min(0)
    hit = hit[:pairs]
    back = inverse(cameras[:, 1 : pairs + 1])  # from every part's axes to the later camera
    own = back[owner, torch.arange(pairs)[:, None]] if len(back) > 1 else back[0][:, None]
    ahead = _turned(own, local) + own[..., :3, 3]
    seen = hit & (ahead[..., 2] > NEAREST_M)
    points = torch.where(seen[..., None], ahead, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    to, base, slope = (torch.stack(v) for v in zip(*map(chart, points), strict=True))
    seen &= to.isfinite().all(-1)
    flow = torch.where(seen[..., None], to - chart.camera.film.pixels(), 0.0).mT
    towards = torch.nn.functional.normalize(torch.cat([slope, torch.ones_like(slope[..., :1])], -1), dim=-1)
    start = torch.cat([base, torch.zeros_like(base[..., :1])], -1)
    nearer = _first(scene, cameras[:, 1 : pairs + 1], start, towards, seen)[3]
    reach = (ahead - start).norm(dim=-1)
    cosine = (towards * _turned(own, normal)).sum(-1).abs().clamp_min(GRAZING)
    hidden = seen & (nearer < reach - ROUNDING * (reach + local.norm(dim=-1)) / cosine)
    return Truth(fit(depth), fit(part), fit(segment), flow.reshape(pairs, 2, *shape), fit(seen), fit(hidden))


def _turned(pose, vectors):
    """Vectors [..., 3] turned by the rotations of poses [..., 4, 4], each sum from left to right."""
    x, y, z = vectors[..., None].unbind(-2)
    return x * pose[..., :3, 0] + y * pose[..., :3, 1] + z * pose[..., :3, 2]


def _first(scene, cameras, origin_cam, direction_cam, usable):
    """Nearest surface along rays [F, P, 3] of every frame: point and normal in the axes of its part, number
    of the part (-1 none), distance (infinite)."""
    nearest = torch.full(origin_cam.shape[:2], torch.inf, dtype=torch.float64)
    local = torch.zeros_like(origin_cam)
    normal = torch.zeros_like(origin_cam)
    owner = torch.full(nearest.shape, -1)
    for number, (surface, pose) in enumerate(zip(parts(scene), cameras, strict=True)):
        origin = _turned(pose[:, None], origin_cam) + pose[:, None, :3, 3]
        direction = _turned(pose[:, None], direction_cam)
        point, across, valid = (
            v.reshape(*nearest.shape, *v.shape[1:])
            for v in surface.hit(origin.reshape(-1, 3), direction.reshape(-1, 3))
        )
        distance = ((point - origin) * direction).sum(-1)
        falling = (direction * across).sum(-1).abs()
        closer = valid & usable & (falling > 1e-9) & (distance < nearest)
        nearest = torch.where(closer, distance, nearest)
        owner = torch.where(closer, number, owner)
        local = torch.where(closer[..., None], point, local)
        normal = torch.where(closer[..., None], across.double(), normal)
    return local, normal, owner, nearest


class Segments:
    """Which shape of a scene lies under a pixel. names: "part/shape" in order of their numbers; a part that
    is one surface has one segment."""

    def __init__(self, scene):
        self.names = []
        self._parts = []
        for label, part in zip(("static", *getattr(scene, "names", ())), parts(scene), strict=True):
            shapes = (
                sorted(part.scene.shapes(), key=lambda shape: shape.id())
                if hasattr(part, "scene") and hasattr(part, "mi")
                else []
            )
            self._parts.append((part, shapes, len(self.names)))
            self.names += [f"{label}/{shape.id()}" for shape in shapes] or [label]

    def at(self, cameras, origin_cam, direction_cam, owner):
        """Numbers [F, P] of the segments that rays meet; ``owner`` is the number of the part that is met
        first."""
        found = torch.full(owner.shape, -1)
        for number, ((part, shapes, first), pose) in enumerate(zip(self._parts, cameras, strict=True)):
            met = owner == number
            if not shapes or not bool(met.any()):
                found = torch.where(met, first, found)
                continue
            origin = _turned(pose[:, None], origin_cam) + pose[:, None, :3, 3]
            direction = _turned(pose[:, None], direction_cam)
            found = torch.where(
                met,
                first
                + _shape_of(part, shapes, origin.reshape(-1, 3), direction.reshape(-1, 3)).reshape(
                    owner.shape
                ),
                found,
            )
        return found


def _shape_of(part, shapes, origin_m, direction):
    """Index into ``shapes`` of what rays [N, 3] meet first, [N]."""
    import drjit as dr

    mi = part.mi
    o, d = ([mi.Float(v.float().contiguous()) for v in values.unbind(1)] for values in (origin_m, direction))
    met = part.scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(*o), mi.Vector3f(*d)), coherent=True).shape
    index = mi.Int32(0)
    for number, shape in enumerate(shapes):
        index = dr.select(met == mi.ShapePtr(shape), number, index)
    return torch.as_tensor(index.numpy()).long()
