"""Ground truth through the current lens: points, depth, objects, flow and occlusion, in float64 with
gradients."""

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from codesign.errors import ShapeError
from codesign.pose import apply, check_poses, inverse
from codesign.render.camera import project
from codesign.render.moving import cameras_in_parts, in_one_row, parts, poses_of_parts, scenes_and_poses

# of lengths: 32 units in the last place of a float32, for a ray moved into an object's axes and met with its
# surface
ROUNDING = 2e-6
GRAZING = 1e-3  # cosines of incidence below this count as this


@dataclass(frozen=True)
class View:
    """What lies under the pixel centres of one frame; zero (object_id -1) where not valid.

    points_world_m, normal: [*film.shape, 3] in world axes, the normal of unit length and as the surface has
      it. depth_m: [*film.shape] along the
    camera's z axis. object_id: [*film.shape] int64, 0 for the static scene, then the moving objects in order.
    valid: [*film.shape] bool.
    """

    points_world_m: Tensor
    depth_m: Tensor
    normal: Tensor
    object_id: Tensor
    valid: Tensor


@dataclass(frozen=True)
class FlowTruth:
    """flow_px: [..., T - stride, 2, *film.shape], +x right, +y down, 0 where not valid. valid, occluded:
    [..., T - stride, *film.shape] bool; occluded points are hidden later."""

    flow_px: Tensor
    valid: Tensor
    occluded: Tensor


@dataclass(frozen=True)
class Hits:
    """First surfaces along rays: local_m, normal [N, 3] in the axes of the part [N] that is met (-1 for
    none), distance_m [N] (infinite for none)."""

    local_m: Tensor
    normal: Tensor
    part: Tensor
    distance_m: Tensor


def first_hits(rays, scene, cameras):
    """The nearest surface of all parts of a scene along rays given in camera space.

    Args: rays: Rays [N]. cameras: pose [4, 4] of the camera in the axes of every part. Rays that carry no
      light meet nothing.
    Gradient: to rays and poses, surfaces taken as their tangent planes.
    """
    origin_cam = rays.origin_m.double()
    direction_cam = rays.direction.double()
    lit = rays.weight.detach() > 0
    nearest = torch.full(lit.shape, torch.inf, dtype=torch.float64)
    local = normal = torch.zeros_like(origin_cam)
    part = torch.full(lit.shape, -1)
    for number, (scene_of_part, pose) in enumerate(zip(parts(scene), cameras, strict=True)):
        origin = apply(pose.double(), origin_cam)
        direction = direction_cam @ pose[:3, :3].double().mT
        point, across, valid = scene_of_part.hit(origin, direction)
        falling = (direction * across).sum(1)
        usable = valid & (falling.detach().abs() > 1e-9) & lit
        distance = ((point - origin) * across).sum(1) / torch.where(usable, falling, torch.ones_like(falling))
        distance = torch.where(usable, distance, torch.ones_like(distance))
        closer = usable & (distance.detach() < nearest.detach())
        nearest = torch.where(closer, distance, nearest)
        local, normal = (
            torch.where(closer[:, None], new, old)
            for new, old in ((origin + direction * distance[:, None], local), (across.double(), normal))
        )
        part = torch.where(closer, number, part)
    return Hits(local, normal, part, nearest)


def world_points(rays, scene, T_world_cam):
    """World points under rays given in camera space, from one pose.

    Args: rays: Rays [N] (chief rays). scene: anything with ``hit``, or a MovingScene of one frame.
      T_world_cam: [4, 4].
    Returns: points [N, 3] metres, depth [N] along the camera's z axis, valid [N].
    Gradient: to rays and poses, the surface taken as its tangent plane at the hit.
    """
    hits = first_hits(rays, scene, [poses[0] for poses in cameras_in_parts(scene, T_world_cam[None])])
    valid = hits.part >= 0
    return _carried(hits, poses_of_parts(scene, 1)[:, 0]), _depth(rays, hits), valid


def view(camera, scene, T_world_cam, frame):
    """View of one frame of a sequence: T_world_cam [T, 4, 4], frame a number. Gradient: points and depth to
    the lens, camera and object poses."""
    check_poses(T_world_cam)
    count = T_world_cam.shape[0]
    if not -count <= frame < count:
        raise ShapeError(f"view: frame {frame} of a sequence of {count}; give a number below that.")
    rays = camera.chief_rays(camera.film.pixels())
    hits = first_hits(rays, scene, [poses[frame] for poses in cameras_in_parts(scene, T_world_cam)])
    valid = hits.part >= 0
    T_world_part = poses_of_parts(scene, count)[:, frame]
    turn = T_world_part[hits.part.clamp_min(0), :3, :3]

    def shaped(f):
        return torch.where(valid if f.ndim == 1 else valid[:, None], f, 0).reshape(
            *camera.film.shape, *f.shape[1:]
        )

    normal = (turn @ hits.normal[..., None])[..., 0]
    return View(
        shaped(_carried(hits, T_world_part)),
        shaped(_depth(rays, hits)),
        shaped(normal),
        hits.part.reshape(camera.film.shape),
        valid.reshape(camera.film.shape),
    )


def true_flow(camera, scene, T_world_cam, stride=1):
    """Flow of every pixel centre from each pose to the one ``stride`` later, through the camera's current
    lens; points move with their object.

    Args: camera with ``chief_rays`` and ``film``; scene with ``hit``, a MovingScene, or a list of scenes, one
      for each entry of the first axis of the poses; T_world_cam [..., T, 4, 4], several trajectories in one
      batch.
    Returns: flow [..., T - stride, 2, *film.shape] px, +x right, +y down; valid [..., T - stride,
      *film.shape], False where the ray meets nothing or the point leaves the field of the lens (the flow is 0
      there).
    Gradient: to lens, camera and object poses. Occlusion at the later time is left to ``flow_and_occlusion``.
    Raises: ShapeError when there are not more poses than ``stride``.
    """
    if pairs := scenes_and_poses(scene, T_world_cam):
        found = [true_flow(camera, each, poses, stride) for each, poses in pairs]
        return torch.stack([flow for flow, _ in found]), torch.stack([valid for _, valid in found])
    tracks, _, _ = _tracks(camera, scene, T_world_cam, stride)
    batch = _batch(T_world_cam, stride)
    return _flow(camera, tracks, batch), _mask(camera, [t.valid for t in tracks], batch)


def flow_and_occlusion(camera, scene, T_world_cam, stride=1):
    """As ``true_flow``, and which of the points are hidden at the later time by something nearer: FlowTruth.

    A point is hidden when the later chief ray through its image meets a surface before it by more than
    rounding: 32 units in the last place of float32
    geometry, divided by the cosine at which the ray meets the point's own surface, since a ray aside by as
    much meets it earlier or later by that.
    """
    if pairs := scenes_and_poses(scene, T_world_cam):
        found = [flow_and_occlusion(camera, each, poses, stride) for each, poses in pairs]
        return FlowTruth(*(torch.stack([getattr(f, n.name) for f in found]) for n in fields(FlowTruth)))
    tracks, scene, poses = _tracks(camera, scene, T_world_cam, stride)
    batch = _batch(T_world_cam, stride)
    return FlowTruth(
        _flow(camera, tracks, batch),
        _mask(camera, [t.valid for t in tracks], batch),
        _mask(camera, [_hidden(camera, scene, poses, t) for t in tracks], batch),
    )


@dataclass(frozen=True)
class Track:
    """Points under pixels at one frame, and where they are at a later one: hits of the first, points_cam_m
    [N, 3] and to_px [N, 2] of the later.

    in_front: [N] bool, the point lies before the later camera (points_cam_m is (0, 0, 1) elsewhere). valid:
      [N] bool, it is in the field of the lens too.
    """

    later: int
    hits: Hits
    points_cam_m: Tensor
    from_px: Tensor
    to_px: Tensor
    in_front: Tensor
    valid: Tensor


def track(camera, scene, T_world_cam, now, later, pixels, rays):
    """Track of the pixel coordinates [N, 2] and their chief rays from frame ``now`` to frame ``later`` of a
    sequence."""
    cameras = cameras_in_parts(scene, T_world_cam)
    hits = first_hits(rays, scene, [poses[now] for poses in cameras])
    ahead = _carried(hits, torch.stack([inverse(poses[later].double()) for poses in cameras]))
    in_front = (hits.part >= 0) & (ahead.detach()[:, 2] > 1e-6)
    ahead = torch.where(in_front[:, None], ahead, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    to = project(camera, ahead)
    valid = in_front & ~to.detach().isnan().any(1)
    return Track(later, hits, ahead, pixels, torch.where(valid[:, None], to, pixels), in_front, valid)


@torch.no_grad()
def _hidden(camera, scene, T_world_cam, found):
    """Whether something is nearer than the tracked points at the later frame: [N] bool."""
    cameras = [poses[found.later].double() for poses in cameras_in_parts(scene, T_world_cam)]
    rays = camera.chief_rays(torch.where(found.valid[:, None], found.to_px, camera.film.middle_px))
    reach = (found.points_cam_m - rays.origin_m).norm(dim=1)
    turn = torch.stack(cameras)[found.hits.part.clamp_min(0), :3, :3]
    cosine = (
        ((turn @ rays.direction.double()[..., None])[..., 0] * found.hits.normal)
        .sum(1)
        .abs()
        .clamp_min(GRAZING)
    )
    size = reach + found.hits.local_m.norm(dim=1)  # float32 coordinates round by their own size
    return found.valid & (first_hits(rays, scene, cameras).distance_m < reach - ROUNDING * size / cosine)


def _tracks(camera, scene, T_world_cam, stride):
    """Tracks of all pairs of frames of all trajectories, and scene and poses [N, 4, 4] of the frames in one
    row."""
    pixels = camera.film.pixels()
    rays = camera.chief_rays(pixels)
    scene, poses = in_one_row(scene, T_world_cam, rays)
    length = T_world_cam.shape[-3]
    if not 1 <= stride < length:
        raise ShapeError(
            f"true flow over {stride} pose(s) ahead needs a stride of at least 1 and more poses than that, "
            f"got {length}; give more poses."
        )
    starts = [first + now for first in range(0, poses.shape[0], length) for now in range(length - stride)]
    return [track(camera, scene, poses, now, now + stride, pixels, rays) for now in starts], scene, poses


def _batch(T_world_cam, stride):
    return (*T_world_cam.shape[:-3], T_world_cam.shape[-3] - stride)


def _flow(camera, tracks, batch):
    moved = torch.stack([(t.to_px - t.from_px).T for t in tracks])
    return moved.reshape(*batch, 2, *camera.film.shape)


def _mask(camera, rows, batch):
    return torch.stack(rows).reshape(*batch, *camera.film.shape)


def _carried(hits, transforms):
    """Points that were hit, from the axes of their part by the part's transform [parts, 4, 4]."""
    own = transforms[hits.part.clamp_min(0)]
    return (own[:, :3, :3] @ hits.local_m[..., None])[..., 0] + own[:, :3, 3]


def _depth(rays, hits):
    distance = torch.where(hits.part >= 0, hits.distance_m, 0.0)
    return rays.origin_m[:, 2].double() + rays.direction[:, 2].double() * distance
