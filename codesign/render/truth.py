"""Ground truth through the current lens: points, depth, objects, flow, occlusion and the velocity
of the camera, in float64 with gradients; the rays of many frames meet the scene together.

A frame's truth is the same to the last bit whatever frames are beside it, on one machine with one
number of threads, where images are read from a table; where they are traced, to 1e-10 px.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from codesign.checks import check_finite, check_whole
from codesign.errors import DomainError, ShapeError
from codesign.pose import Poses, check_poses, inverse, se3_exp
from codesign.render.camera import Camera, project
from codesign.render.hits import Hits, carried, dot, first_hits, of_part, turned
from codesign.render.moving import MovingScene, Scene, Views, scenes_and_poses, views_of
from codesign.render.projection import ProjectionTable
from codesign.types import Rays

# of lengths: 32 units in the last place of a float32, for a ray moved into an object's axes and met
# with its surface
ROUNDING = 2e-6
GRAZING = 1e-3  # cosines of incidence below this count as this
NEAREST_M = 1e-6  # points closer to the plane of the pupil have no image
TOGETHER = 2**17  # points that are followed at once


@dataclass(frozen=True)
class View:
    """What lies under the pixel centres of one frame; zero (object_id -1) where not valid.

    points_world_m, normal: [..., *film.shape, 3] in world axes, the normal of unit length and as
      the surface has it. depth_m: [..., *film.shape] along the camera's z axis. object_id:
      [..., *film.shape] int64, 0 for the static scene, then the moving objects in order. valid:
      [..., *film.shape] bool.
    """

    points_world_m: Tensor
    depth_m: Tensor
    normal: Tensor
    object_id: Tensor
    valid: Tensor


@dataclass(frozen=True)
class FlowTruth:
    """flow_px: [..., T - stride, 2, *film.shape], +x right, +y down, 0 where not valid. valid,
    occluded:
    [..., T - stride, *film.shape] bool; occluded points are hidden later."""

    flow_px: Tensor
    valid: Tensor
    occluded: Tensor


@dataclass(frozen=True)
class FramesTruth(FlowTruth):
    """Of F frames of one trajectory, the flow to the frame behind each; and depth_m
    [F, *film.shape], 0 where nothing is seen, object_id [F, *film.shape] int64 (0 static, then
    moving objects, -1 nothing)."""

    depth_m: Tensor
    object_id: Tensor


def view(camera: Camera, scene: Scene | MovingScene, T_world_cam: Poses, frame: int) -> View:
    """View of one frame of a sequence, or of several: T_world_cam [..., T, 4, 4], frame a number.

    Gradient: points and depth to the lens, camera and object poses.
    """
    rays = camera.chief_rays(camera.film.pixels())
    views = views_of(scene, T_world_cam, rays)
    *batch, count = views.batch
    check_whole(frame, "view: frame", -count, count - 1)
    rows = torch.arange(frame % count, views.cameras.shape[1], count, device=views.cameras.device)
    hits = hits_of(rays, views.scene, views.cameras[:, rows])
    valid = hits.part >= 0
    T_world_part = views.T_world_part[:, rows]

    def shaped(f):
        kept = torch.where(valid if f.ndim == 2 else valid[..., None], f, 0)
        return kept.reshape(*batch, *camera.film.shape, *f.shape[2:])

    return View(
        shaped(carried(hits, T_world_part)),
        shaped(_depth(rays, hits)),
        shaped(turned(of_part(hits, T_world_part), hits.normal)),
        hits.part.reshape(*batch, *camera.film.shape),
        valid.reshape(*batch, *camera.film.shape),
    )


def true_flow(
    camera: Camera,
    scene: Scene | MovingScene | Sequence[Scene | MovingScene],
    T_world_cam: Poses,
    stride: int = 1,
) -> tuple[Tensor, Tensor]:
    """Flow of every pixel centre from each pose to the one ``stride`` later, through the camera's
    current lens; points move with their object.

    >>> from codesign import lens, pose, render
    >>> from scenes import worlds
    >>> camera = render.Camera(lens.Pinhole(8.0), 8, 8, pixel_pitch_mm=0.5)
    >>> poses = pose.look_at((0, -2, 0), (0, 0, 0)).repeat(2, 1, 1)
    >>> poses[1, 0, 3] -= 0.25  # to the left by two pixels: the world moves to the right
    >>> flow_px, valid = render.true_flow(camera, worlds.wall(torch.ones(8, 8).numpy()), poses)
    >>> [round(float(component), 3) for component in flow_px[0, :, 4, 4]]
    [2.0, 0.0]

    Args: camera with ``chief_rays`` and ``film``; scene with ``hit``, a MovingScene, or a list of
      scenes, one for each entry of the first axis of the poses; T_world_cam [..., T, 4, 4], several
      trajectories in one batch.
    Returns: flow [..., T - stride, 2, *film.shape] px, +x right, +y down; valid
      [..., T - stride, *film.shape], False where the ray meets nothing or the point leaves the
      field of the lens (the flow is 0 there).
    Gradient: to lens, camera and object poses. Occlusion at the later time is left to
      ``flow_and_occlusion``.
    Raises: ShapeError when there are not more poses than ``stride``.
    """
    found = _flow_truth(camera, scene, T_world_cam, stride, occlusion=False)
    return found.flow_px, found.valid


def flow_and_occlusion(
    camera: Camera,
    scene: Scene | MovingScene | Sequence[Scene | MovingScene],
    T_world_cam: Poses,
    stride: int = 1,
) -> FlowTruth:
    """As ``true_flow``, and which of the points are hidden at the later time by something nearer:
    FlowTruth.

    >>> from codesign import lens, pose, render
    >>> from scenes import worlds
    >>> camera = render.Camera(lens.Pinhole(4.0), 8, 8, pixel_pitch_mm=0.5)
    >>> poses = pose.look_at((0.1, -1, 1.1), (0, 0.8, 0.5)).repeat(2, 1, 1)
    >>> poses[1, 0, 3] += 0.4  # to the right, past crates and a ball
    >>> truth = render.flow_and_occlusion(camera, worlds.room(), poses)
    >>> bool(truth.occluded.any()), bool(truth.valid[truth.occluded].all())
    (True, True)

    A point is hidden when the later chief ray through its image meets a surface before it by more
    than
    rounding: 32 units in the last place of float32 geometry, divided by the cosine at which the ray
    meets the point's own surface, since a ray aside by as much meets it earlier or later by that.
    """
    return _flow_truth(camera, scene, T_world_cam, stride, occlusion=True)


@torch.no_grad()
def truth_of_frames(
    table: ProjectionTable,
    scene: Scene | MovingScene,
    T_world_cam: Poses,
    count: int,
    rays: Rays | None = None,
) -> FramesTruth:
    """Truth of the first ``count`` frames of a long sequence, without gradients: images are read
    from a table of the camera's lens (to 1e-6 px) instead of traced.

    Args:
      table: ProjectionTable of the camera.
      scene: as for ``true_flow``.
      T_world_cam: [T >= count, 4, 4]; flow where there is a frame behind (of ``count`` - 1 frames
        where T = count).
      rays: the camera's chief rays through all pixel centres, where they are traced already.
    """
    camera = table.camera
    shape = camera.film.shape
    rays = camera.chief_rays(camera.film.pixels()) if rays is None else rays
    cameras = views_of(scene, T_world_cam, rays).cameras
    hits = hits_of(rays, scene, cameras[:, :count])
    pairs = min(count, cameras.shape[1] - 1)
    later = cameras[:, 1 : pairs + 1]
    if pairs:
        found = follow(table, hits[:pairs], later, camera.film.pixels())
        flow = (found.to_px - found.from_px).mT
        valid = found.valid
        hidden = _hidden(camera, scene, later, found)
    else:
        flow = cameras.new_zeros(0)
        valid = hidden = torch.zeros_like(flow, dtype=torch.bool)
    return FramesTruth(
        flow.reshape(pairs, 2, *shape),
        valid.reshape(pairs, *shape),
        hidden.reshape(pairs, *shape),
        torch.where(hits.part >= 0, _depth(rays, hits), 0.0).reshape(count, *shape),
        hits.part.reshape(count, *shape),
    )


@dataclass(frozen=True)
class Track:
    """Points under pixels [P] of F frames, and where they are at a later frame each: hits of the
    first, points_cam_m [F, P, 3] and to_px [F, P, 2] of the later (the pixel itself where not
    valid).

    in_front: [F, P] bool, the point lies before the later camera (points_cam_m is (0, 0, 1)
      elsewhere).
      valid: [F, P] bool, it is in the field of the lens too. chief: the later chief rays to the
      points, base and slope [F, P, 2], where a table gave them.
    """

    hits: Hits
    points_cam_m: Tensor
    from_px: Tensor
    to_px: Tensor
    in_front: Tensor
    valid: Tensor
    chief: tuple[Tensor, Tensor] | None = None


def track(
    camera: Camera,
    views: Views,
    now: Tensor,
    later: Tensor,
    pixels: Tensor,
    rays: Rays,
) -> Track:
    """Track of the pixel coordinates [P, 2] and their chief rays from frames ``now`` to frames
    ``later`` (numbers [F]) of a sequence."""
    hits = hits_of(rays, views.scene, views.cameras[:, now])
    return follow(camera, hits, views.cameras[:, later], pixels)


def follow(optics: Camera | ProjectionTable, hits: Hits, later: Tensor, pixels: Tensor) -> Track:
    """Track of points that were hit to cameras ``later`` [parts, F, 4, 4]; optics: a Camera, or its
    ProjectionTable."""
    points, in_front = _before(hits, later)
    chief = None
    if isinstance(optics, ProjectionTable):
        to, *lines = (v.unflatten(0, points.shape[:2]) for v in optics(points.flatten(0, 1)))
        chief = tuple(lines)
    else:
        to = project(optics, points)
    valid = in_front & ~to.detach().isnan().any(-1)
    return Track(
        hits, points, pixels, torch.where(valid[..., None], to, pixels), in_front, valid, chief
    )


def later_points(rays: Rays, scene: Any, T_world_cam: Poses) -> tuple[Tensor, Tensor]:
    """Points under rays at the first pose of each trajectory, as they lie before the camera at its
    last.

    Args:
      rays: Rays [P] (chief rays).
      scene: as for ``true_flow``; points move with their object.
      T_world_cam: [..., T, 4, 4].
    Returns: points [B, P, 3] metres in the axes of the last camera, B trajectories; seen [B, P]
      bool: it met a surface, and lies before the last camera (the point is (0, 0, 1) elsewhere).
    Gradient: to rays, camera and object poses, the surface taken as its tangent plane at the hit.
    """
    views = views_of(scene, T_world_cam, rays)
    cameras, length = views.cameras, views.batch[-1]
    first = torch.arange(0, cameras.shape[1], length, device=cameras.device)
    return _before(hits_of(rays, views.scene, cameras[:, first]), cameras[:, first + length - 1])


def _before(hits, later):
    """Points that were hit in the axes of cameras ``later`` [parts, F, 4, 4], and whether they lie
    before them."""
    points = carried(hits, inverse(later))
    in_front = (hits.part >= 0) & (points.detach()[..., 2] > NEAREST_M)
    return torch.where(in_front[..., None], points, points.new_tensor([0.0, 0.0, 1.0])), in_front


@torch.no_grad()
def _hidden(camera, scene, later, found):
    """Whether something is nearer than the tracked points at the later frames [parts, F, 4, 4]:
    [F, P] bool."""
    if found.chief is None:
        at = torch.where(found.valid[..., None], found.to_px, camera.film.middle_px)
        rays = camera.chief_rays(at.reshape(-1, 2))
        origin, direction = (
            v.double().reshape(*at.shape[:-1], 3) for v in (rays.origin_m, rays.direction)
        )
    else:
        base, slope = found.chief
        origin = torch.cat([base, torch.zeros_like(base[..., :1])], -1)
        direction = torch.cat([slope, torch.ones_like(slope[..., :1])], -1)
        direction = direction / dot(direction, direction).sqrt()[..., None]
    between = found.points_cam_m - origin
    reach = dot(between, between).sqrt()
    cosine = (
        dot(turned(of_part(found.hits, later), direction), found.hits.normal)
        .abs()
        .clamp_min(GRAZING)
    )
    # float32 coordinates round by their own size
    size = reach + dot(found.hits.local_m, found.hits.local_m).sqrt()
    nearer = first_hits(origin, direction, found.valid, scene, later).distance_m
    return found.valid & (nearer < reach - ROUNDING * size / cosine)


def _flow_truth(camera, scene, T_world_cam, stride, occlusion):
    if pairs := scenes_and_poses(scene, T_world_cam):
        found = [_flow_truth(camera, each, poses, stride, occlusion) for each, poses in pairs]
        return FlowTruth(
            *(torch.stack([getattr(f, n.name) for f in found]) for n in fields(FlowTruth))
        )
    pixels = camera.film.pixels()
    rays = camera.chief_rays(pixels)
    views = views_of(scene, T_world_cam, rays)
    scene, cameras = views.scene, views.cameras
    *batch, length = views.batch
    check_whole(stride, "stride", 1, length - 1, "true flow over a stride needs more poses than it")
    starts = torch.arange(cameras.shape[1], device=cameras.device).reshape(-1, length)
    starts = starts[:, : length - stride].reshape(-1)
    flows = []
    for some in starts.split(max(1, TOGETHER // len(pixels))):
        later = cameras[:, some + stride]
        found = follow(camera, hits_of(rays, scene, cameras[:, some]), later, pixels)
        hidden = (
            _hidden(camera, scene, later, found) if occlusion else torch.zeros_like(found.valid)
        )
        flows.append(((found.to_px - pixels).mT, found.valid, hidden))
    flow, valid, hidden = (torch.cat(column) for column in zip(*flows, strict=True))
    batch = (*batch, length - stride)
    shape = camera.film.shape
    return FlowTruth(
        flow.reshape(*batch, 2, *shape),
        valid.reshape(*batch, *shape),
        hidden.reshape(*batch, *shape),
    )


def hits_of(rays: Rays, scene: Any, cameras: Tensor) -> Hits:
    """Hits of the same rays in every frame of cameras [parts, F, 4, 4]."""
    return first_hits(rays.origin_m, rays.direction, rays.weight.detach() > 0, scene, cameras)


def _depth(rays, hits):
    distance = torch.where(hits.part >= 0, hits.distance_m, 0.0)
    return rays.origin_m[:, 2].double() + rays.direction[:, 2].double() * distance


LARGEST_TURN_RAD = 3.0  # towards half a turn the axis of a rotation is lost
SMALL = 1e-4  # squared angle below which series are used; their next term is 1e-17


def camera_velocity(T_world_cam: Poses, t_s: Tensor | Sequence[float]) -> tuple[Tensor, Tensor]:
    """Mean velocity of a camera between its poses: the constant twist that leads from each pose to
    the next.

    Args:
      T_world_cam: [..., T >= 2, 4, 4].
      t_s: [T] times, increasing, the same for all trajectories.
    Returns: two twists [..., T - 1, 6], translation of the camera's origin (m/s) then rotation
      (rad/s): in the camera's own axes, where it is the same all through the interval, and in world
      axes, as it is at the middle of the interval.
    Gradient: to the poses.
    Raises: DomainError when times do not increase or the camera turns by more than 3 rad from one
      pose to the next; ShapeError.
    """
    T_world_cam = check_poses(T_world_cam)
    t_s = torch.as_tensor(t_s, dtype=torch.float64, device=T_world_cam.device)
    check_finite(t_s, "times of the poses")
    if t_s.shape != T_world_cam.shape[-3:-2] or t_s.numel() < 2:
        raise ShapeError(
            f"camera velocity: {tuple(t_s.shape)} times for {T_world_cam.shape[-3]} poses; give one time per "
            "pose, and at least two."
        )
    if not bool((t_s.diff() > 0).all()):
        raise DomainError(
            "camera velocity: the times must increase from pose to pose; sort them and drop doubles."
        )
    poses = T_world_cam.double()
    start = poses[..., :-1, :, :]
    moves = inverse(start) @ poses[..., 1:, :, :]
    twist = se3_log(moves.reshape(-1, 4, 4)).reshape(*start.shape[:-2], 6)
    half_turn = se3_exp(torch.cat([torch.zeros_like(twist[..., :3]), twist[..., 3:] / 2], -1))[
        ..., :3, :3
    ]
    body = twist / t_s.diff()[:, None]
    turn = (start[..., :3, :3] @ half_turn)[..., None, :, :]
    world = turn @ body.reshape(*body.shape[:-1], 2, 3, 1)
    return body, world.reshape(body.shape)


def se3_log(transform: Tensor) -> Tensor:
    """Twists [N, 6] of rigid transforms [N, 4, 4], the inverse of ``pose.se3_exp`` for turns of at
    most 3 rad.

    Gradient: exact, also at the identity. Raises: DomainError for larger turns.
    Source: Sola, Deray and Atchuthan, A micro Lie theory for state estimation in robotics, 2018,
      eq. 133, 146 and 173.
    """
    R = transform[:, :3, :3]
    t = transform[:, :3, 3]
    sine_axis = (
        torch.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], 1)
        / 2
    )
    cosine = (R.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    square = sine_axis.square().sum(1)
    small = (square < SMALL) & (cosine > 0)
    sine = torch.where(small, 0.1, square).sqrt()
    theta = torch.atan2(sine, torch.where(small, 0.9, cosine))
    turned = float(torch.where(small, 0.0, theta).detach().max())
    if turned > LARGEST_TURN_RAD:
        raise DomainError(
            f"camera velocity: the camera turns by {math.degrees(turned):.0f} degrees between two poses; "
            "give poses less than 170 degrees apart."
        )
    series = 1 + square / 6 + 3 * square**2 / 40 + 5 * square**3 / 112  # of arcsin(s) / s
    w = sine_axis * torch.where(small, series, theta / sine)[:, None]
    squared = w.square().sum(1)
    bend = (1 - theta / 2 / torch.tan(theta / 2)) / theta.square()
    bend = torch.where(small, 1 / 12 + squared / 720 + squared**2 / 30240, bend)
    across = torch.linalg.cross(w, t, dim=1)
    return torch.cat([t - across / 2 + bend[:, None] * torch.linalg.cross(w, across, dim=1), w], 1)
