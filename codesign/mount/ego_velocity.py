"""The velocity of a body from event flow: weighted least squares on points of the flow, with the
covariance that the flow's own estimator gives.

What an estimator with a prior returns is drawn towards zero where it saw little: with precision
S^-1 after it saw the events and S0^-1 before, the flow is (1 - S S0^-1) times what the events alone
say. Taken as a measurement of precision S^-1 - S0^-1, about confidence x S^-1, each point counts by
what the events said of it, and one that saw nothing counts nothing. Points of one window err alike:
an affine field has three numbers per component, so a window counts as three points however many are
read.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from codesign.checks import check_finite, check_positive, check_whole
from codesign.errors import DomainError
from codesign.mount import unknown_depth
from codesign.mount.depth import at_frame, ground_and_scene_depth, ground_depth, scene_depth
from codesign.mount.observability import PLANAR, flow_along, flow_precision, pixel_lines
from codesign.mount.unknown_depth import UnknownDepth
from codesign.render.moving import MovingScene
from codesign.types import ChiefRayCamera, FlowField

INDEPENDENT = 3.0  # points that a window counts as
# standard deviation of flow where a field comes without covariance and nothing was seen
UNSEEN_PX = 1e3
PLAIN_PX = 0.3  # of flow where it comes without covariance
INNER = 4  # steps after each reweighting where depth is not known
DEPTHS = {"ground": ground_depth, "scene": scene_depth}


@dataclass(frozen=True)
class Motion:
    """velocity: [N, K] m/s and rad/s. covariance: [N, K, K] of it, as least squares expects. kept:
    [N, P] in 0..1, by how much each point was believed. depth_m: [N, P] of the points, as estimated
    where it was not known."""

    velocity: Tensor
    covariance: Tensor
    kept: Tensor
    depth_m: Tensor | None = None


@dataclass(frozen=True)
class Readings:
    """Flow at P points of each of N bodies, and what each of K velocities would show there.

    pixels: [N, P, 2] of the points at mid-interval, window after window. flow_px: [N, P, 2] over
      the interval.
    precision: [N, P, 2, 2] px^-2. confidence: [N, P] in 0..1, the share of it that the events said;
    the flow is drawn towards zero by as much. depth_m: [N, P], infinite without a surface. rows:
    [N, P, 2, K] px of flow per m/s and rad/s. share: [N, P] of an independent point that each
    counts as, 0 without a surface.
    windows: in P. parallax: [N, P, 2, K] that each 1 / m of nearness adds to the rows, where depth
      is not known; then depth_m is that of ``rows``.
    """

    pixels: Tensor
    flow_px: Tensor
    precision: Tensor
    confidence: Tensor
    depth_m: Tensor
    rows: Tensor
    share: Tensor
    windows: int
    parallax: Tensor | None = None

    def missed_px(self, velocity: Tensor) -> Tensor:
        """Flow [N, P, 2] that velocities [N, K] leave unexplained."""
        return (
            self.flow_px
            - self.confidence[..., None] * (self.rows @ velocity[:, None, :, None])[..., 0]
        )

    def of_windows(self, values: Tensor) -> Tensor:
        """[N, P, ...]: values [N, windows, ...] of windows at each of their points. Gradient:
        values."""
        return values.repeat_interleave(self.share.shape[1] // self.windows, 1)

    def squared(self, velocity: Tensor) -> Tensor:
        """What velocities leave unexplained, [N, P], as a sum of two squares in units of its
        standard deviation."""
        miss = self.missed_px(velocity)
        return (miss[..., None, :] @ self.precision @ miss[..., :, None])[..., 0, 0]


class _Looked(NamedTuple):
    """Where N bodies are read. places: camera, pixels, poses and scene of a depth. told: flow,
    precision, confidence."""

    places: tuple[Any, ...]
    told: tuple[Tensor, Tensor, Tensor]
    lines: Any
    mounts: Tensor
    interval_s: float
    windows: int


class EgoVelocity:
    """Stage ``estimate`` of a System: the velocity of the body over the interval.

    Args:
      axes: which of the six velocities the body has: ``mount.PLANAR`` or ``mount.FREE``.
      prior: [K] standard deviations expected of them around zero, m/s and rad/s.
      depth: "ground" (the plane z = 0 of the world under a body that knows its height and
        attitude), "scene" (a perfect map), a function (camera, pixels [N, P, 2], T_world_cam
        [N, 4, 4], scene) -> [N, P] m, or ``mount.UnknownDepth``: estimated with the velocity.
      every_px: spacing of the points read.
      floor_px: standard deviation of flow errors that no covariance knows of.
      outlier: errors of that many standard deviations count a quarter (Geman and McClure, 1987);
        None: all count.
      steps: of reweighting, for outliers.
    Gradient: flow, covariance, mount, poses, lens.

    >>> from codesign.mount import FREE, EgoVelocity
    >>> drone = EgoVelocity(FREE, prior=(2.0, 2.0, 1.0, 1.0, 1.0, 1.0), depth="scene")
    """

    def __init__(
        self,
        axes: Sequence[int] = PLANAR,
        prior: Sequence[float] = (1.0, 1.0, 1.0),
        depth: str | Callable[..., Tensor] = "ground",
        *,
        every_px: int = 8,
        floor_px: float = 0.05,
        outlier: float | None = 3.0,
        steps: int = 4,
    ) -> None:
        if isinstance(depth, str) and depth not in DEPTHS:
            raise DomainError(
                f"depth is {depth!r}; choose one of {', '.join(DEPTHS)}, or give a function."
            )
        if len(prior) != len(axes) or not all(value > 0 for value in prior):
            raise DomainError(
                f"prior is {tuple(prior)}; give one standard deviation > 0 for each of the {len(axes)} velocities."
            )
        self.axes = tuple(axes)
        self.prior = tuple(float(value) for value in prior)
        self.depth = DEPTHS[depth] if isinstance(depth, str) else depth
        self.every_px = check_whole(every_px, "every_px")
        self.floor_px = check_positive(floor_px, "floor_px")
        self.outlier = None if outlier is None else check_positive(outlier, "outlier")
        self.steps = check_whole(steps, "steps")

    def __call__(
        self,
        field: FlowField,
        camera: ChiefRayCamera,
        scene: Any,
        T_body_cam: Tensor,
        T_world_cam: Tensor,
        t_s: Tensor | None = None,
    ) -> Motion:
        """Motion of N bodies from fields [N x windows, 2, H, W] behind poses T_world_cam
        [..., T, 4, 4].

        Raises: DomainError for NaN where the field says that it is valid.

        t_s: [T] of the poses; the flow's interval ends with them and may begin later. None: it is
          all of them.
        """
        return self.solve(self.read(field, camera, scene, T_body_cam, T_world_cam, t_s))

    def read(
        self,
        field: FlowField,
        camera: ChiefRayCamera,
        scene: Any,
        T_body_cam: Tensor,
        T_world_cam: Tensor,
        t_s: Tensor | None = None,
        depth: Callable[..., Tensor] | None = None,
    ) -> Readings:
        """What the fields say, and what each velocity would show. Arguments and gradient as of the
        call.

        depth: other than the estimator believes in, such as ``mount.scene_depth`` for what is true.
        """
        looked = self._looked(field, camera, scene, T_body_cam, T_world_cam, t_s)
        known = depth or self.depth
        return self._read(looked, known, known(*looked.places))

    def read_beside_truth(
        self, *given: Any, depths_m: tuple[Tensor, Tensor] | None = None
    ) -> tuple[Readings, Readings]:
        """``read`` by the depth that is believed, and the same points with the depths that they
        have in the scene.

        given: arguments of ``read`` but the last. depths_m: [N, P] m, believed and true, where they
          are known; looked up when None, over flat ground by one cast of rays for both.
        """
        looked = self._looked(*given)
        if depths_m is None and self.depth is scene_depth:
            read = self._read(looked, scene_depth, scene_depth(*looked.places))
            return read, read
        if depths_m is None and self.depth is ground_depth:
            depths_m = ground_and_scene_depth(*looked.places)
        elif depths_m is None:
            depths_m = self.depth(*looked.places), scene_depth(*looked.places)
        believed, true = depths_m
        return self._read(looked, self.depth, believed), self._read(looked, scene_depth, true)

    def _looked(self, field, camera, scene, T_body_cam, T_world_cam, t_s=None):
        """Where is read, whatever the depth there."""
        poses = T_world_cam.reshape(-1, *T_world_cam.shape[-3:])
        pixels, flow, precision, confidence = self._measured(field, camera, len(poses))
        frame, over = _middle(poses.shape[1], t_s, field.interval_s)
        for world in scene if isinstance(scene, tuple | list) else (scene,):
            if isinstance(world, MovingScene):
                world.check_length(poses.shape[1])
        middle = pixels + over * flow  # where the points are at that frame
        mounts = (
            T_body_cam.to(poses.device, torch.float64)
            .expand(*T_world_cam.shape[:-3], 4, 4)
            .reshape(-1, 4, 4)
        )
        return _Looked(
            (camera, middle, poses[:, frame], at_frame(scene, frame)),
            (flow, precision, confidence[..., 0]),
            pixel_lines(camera, middle),
            mounts,
            field.interval_s,
            camera.film.shape[0] if len(camera.film.shape) == 3 else 1,
        )

    def _read(self, looked, known, depth_m):
        flow, precision, confidence = looked.told
        rows, on_surface = self._rows(looked, depth_m)
        parallax = None
        if isinstance(known, UnknownDepth):
            nearest = torch.where(on_surface, known.nearest_m, torch.inf)
            near, _ = self._rows(looked, nearest)
            parallax = (near - rows) / (1 / known.nearest_m - known.mean_per_m)
        independent = min(INDEPENDENT * looked.windows / flow.shape[1], 1.0)  # of the points
        share = independent * on_surface.to(flow)
        return Readings(
            looked.places[1],
            flow,
            precision,
            confidence,
            depth_m,
            rows,
            share,
            looked.windows,
            parallax,
        )

    def solve(self, read: Readings) -> Motion:
        """Least squares, reweighted for outliers. Gradient: all readings."""
        prior = torch.diag(read.flow_px.new_tensor(self.prior) ** -2)
        kept = torch.ones_like(read.share)
        if isinstance(self.depth, UnknownDepth):
            return self._solved_with_depth(read)
        velocity, normal = _solved(read, kept, prior)
        for _ in range(0 if self.outlier is None else self.steps):
            kept = self._believed(read, velocity)
            velocity, normal = _solved(read, kept, prior)
        return Motion(velocity, torch.linalg.inv(normal), kept, read.depth_m)

    def _believed(self, read, velocity):
        """Weight [N, P] of each point beside what velocities leave unexplained
        (Geman and McClure)."""
        return (1 + read.squared(velocity) / self.outlier**2) ** -2

    def points(self, read: Readings, kept: Tensor) -> unknown_depth.Points:
        """Readings [N, P] of unknown depth, each believed by as much as ``kept`` [N, P]. Gradient:
        both.

        Raises: DomainError for readings that know their depth.
        """
        if read.parallax is None or not isinstance(self.depth, UnknownDepth):
            raise DomainError(
                "these readings know their depth; read them with the estimator that solves them."
            )
        far = read.rows - read.parallax * self.depth.mean_per_m
        told = (read.precision @ read.flow_px[..., None])[..., 0]
        precision = read.confidence[..., None, None] * read.precision
        prior = torch.diag(read.flow_px.new_tensor(self.prior) ** -2)
        weight, bounds = kept * read.share, self.depth.bounds_per_m
        return unknown_depth.Points(precision, told, far, read.parallax, weight, prior, bounds)

    def _solved_with_depth(self, read):
        """The same, whatever the depths. Gradient: all readings, by the last steps."""
        kept = torch.ones_like(read.share)
        points = self.points(read, kept)
        velocity = unknown_depth.follow(points, torch.zeros_like(read.rows[:, 0, 0]))
        velocity = unknown_depth.settled(points, velocity)
        for _ in range(0 if self.outlier is None else self.steps):
            nearness = unknown_depth.look(points, velocity).nearness
            known = replace(read, rows=points.far + nearness[..., None, None] * points.near)
            kept = self._believed(known, velocity)
            points = self.points(read, kept)
            with torch.no_grad():
                moved = unknown_depth.descend(points, velocity, INNER)
            velocity = unknown_depth.settled(points, velocity + (moved - velocity).detach())
        nearness = unknown_depth.look(points, velocity).nearness
        depth_m = torch.where(read.share > 0, 1 / nearness, torch.inf)
        return Motion(velocity, unknown_depth.covariance(points, velocity), kept, depth_m)

    def _measured(self, field, camera, count):
        """Points [N, P, 2] px, their flow [N, P, 2] px, its precision [N, P, 2, 2] and confidence
        [N, P, 1]."""
        height, width = camera.film.shape[-2:]
        first = min(self.every_px, height, width) // 2
        at = (..., slice(first, None, self.every_px), slice(first, None, self.every_px))
        pixels = camera.film.pixels().reshape(-1, height, width, 2).movedim(-1, 1)[at]

        def per_body(values):  # [N x windows, C, h, w] -> [N, P, C]
            return values.double().movedim(1, -1).reshape(count, -1, values.shape[1])

        valid = field.valid[:, None][at]
        seen = field.valid
        if field.confidence is not None:
            seen = torch.where(field.valid, field.confidence, 0)
        confidence = per_body(seen[:, None][at])
        # what is not known means nothing, NaN too: it is masked before anything is computed with it
        known = confidence > 0
        flow = torch.where(known, per_body(field.flow_px[at]), 0.0)
        if field.covariance_px2 is None:
            xx = yy = per_body(torch.where(valid, PLAIN_PX, UNSEEN_PX))[..., 0] ** 2
            xy = torch.zeros_like(xx)
        else:
            unknown = flow.new_tensor([UNSEEN_PX**2, 0.0, UNSEEN_PX**2])
            xx, xy, yy = torch.where(known, per_body(field.covariance_px2[at]), unknown).unbind(-1)
        for name, values in (("flow", flow), ("covariance", xx + xy + yy)):
            check_finite(
                values, f"the {name} of valid pixels", "mark what is not known as not valid"
            )
        precision = flow_precision(torch.stack([xx, xy, yy], -1), floor=self.floor_px)
        points = per_body(pixels[None].expand(count, *pixels.shape).flatten(0, 1))
        return points, flow, precision, confidence

    def _rows(self, looked, depth_m):
        rows, seen = flow_along(looked.lines, depth_m, looked.mounts)
        return rows[..., list(self.axes)] * looked.interval_s, seen


def _middle(frames: int, t_s: Tensor | None, interval_s: float) -> tuple[int, float]:
    """Number of the frame nearest to the middle of the flow's interval, and how much of the
    interval is over then."""
    if t_s is None:
        return frames // 2, 0.5
    since_s = t_s - (t_s[-1] - interval_s)
    frame = int((since_s - interval_s / 2).abs().argmin())
    return frame, float(since_s[frame]) / interval_s


def _solved(read, kept, prior):
    """Velocity [N, K] and normal matrix [N, K, K] of J^T (c P) J v = J^T P f, c the confidence."""
    weighed = read.rows.mT @ ((kept * read.share)[..., None, None] * read.precision)  # [N, P, K, 2]
    normal = (read.confidence[..., None, None] * (weighed @ read.rows)).sum(1) + prior
    right = (weighed @ read.flow_px[..., None]).sum(1)
    return torch.linalg.solve(normal, right)[..., 0], normal
