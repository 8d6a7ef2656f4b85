"""Points on the curves of a scene that fall on the film, for every frame: where the boundary term
is sampled.

A curve is cut into short pieces that are nearly straight on the film; each is clipped to the film,
widened by what a lens out of focus spreads, and what is left gets points evenly along its length.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import scipy
import torch
from torch import Tensor
from torch.nn.functional import normalize

from codesign.pose import apply, inverse
from codesign.render.camera import Camera, images, lines
from codesign.render.film import border_px, coarse_pixels, film_pupil_pattern
from codesign.render.rows import Rows

# length of a piece on the film, and its angle, at most: one that reaches behind the camera is left
# out
PIECE_PX = 8.0
PIECE_RAD = 0.1
MARGIN_PX = 1.0  # beyond the film, on top of the blur
# of the film's field, for what chief rays of the border do not say: colour, pupil aberration
WIDER = 1.02
# of a camera nearer to a curve than this the piece would be long on the film without end: at 1e-6 m
# a robot's own body took 15 GB of points
IN_FRONT_M = 1e-3
STEP = 1e-4  # of a piece, for the direction of its curve
PUPILS = 4096
# px, of the film position for the derivative of a ray; the change up to which its root is taken as
# found, since the next would be of its square
STEP_PX = 1e-3
FOUND_PX = 1e-4
ACROSS = 32  # chief rays across the film, from which that search begins
NEARBY = 0.07  # share of the distance from which what is not hidden is read again
# by how much, at least: an edge of a face five times as wide as it is away moved by 1.2e-6
NEAR_RAD = 2e-6
# by how much a float32 ray may miss, per length of its coordinates over the distance
FLOAT32_RAD = 5e-7


@dataclass(frozen=True)
class CurvePoints(Rows):
    """Sampled points of curves, in the axes of the part of the scene that the curve belongs to.

    world_m, ahead_m [n, 3]: the point, and the same curve a little further on. share [n]: how many
    such steps each point stands for. aside_rad, near_rad [n]: how far to the sides radiance is
    safely read from afar and from NEARBY of the way, both as seen from the viewpoint. face_slope
    [n]: tangent of the view's angle to the steeper of the faces on both sides, infinite where what
    is seen may lie far behind. apex_m [n, 2, 3]:
    third corners of the triangles on both sides, NaN where there are none. near_px [n, 2]: about
    where they are seen, film position. pupil [n, 2]; colour,
    window, frame, part [n]: numbers of the wavelength, the window of the film, the frame and the
    part of the scene.
    """

    world_m: Tensor
    ahead_m: Tensor
    share: Tensor
    aside_rad: Tensor
    near_rad: Tensor
    face_slope: Tensor
    apex_m: Tensor
    near_px: Tensor
    pupil: Tensor
    colour: Tensor
    window: Tensor
    frame: Tensor
    part: Tensor


def curve_points(
    camera: Camera,
    view: "FieldOfView",
    curves: Sequence[Sequence[Any]],
    cameras: Tensor,
    frames_each: int,
    per_px: float,
) -> CurvePoints | None:
    """Points on all curves that may fall on the film, about ``per_px`` per pixel length; None for
    none.

    Args: view: of the camera. curves: of every part of the scene, in its own axes. cameras
      [parts, F, 4, 4]: the camera in the axes of every part. frames_each: frames of a trajectory;
      every trajectory draws the same numbers.
    """
    count = cameras.shape[1]
    found = []
    for start in range(0, count, frames_each):
        generator = torch.Generator().manual_seed(view.seed)
        frames = range(start, min(start + frames_each, count))
        for part, of_part in enumerate(curves):
            for curve in of_part:
                pieces = _in_view(view, curve, cameras[part], frames)
                if pieces is not None:
                    found.append(
                        _on_pieces(
                            camera, view, curve, pieces, cameras[part], part, per_px, generator
                        )
                    )
    return CurvePoints.joined(found) if found else None


@dataclass(frozen=True)
class _Pieces(Rows):
    """Pieces of one curve that touch a window in a frame: index [n], bounds [n, 2], what is left of
    their length on the film: start and end share [n], length px [n], depths of their ends [n, 2];
    frame and window [n]."""

    index: Tensor
    bounds: Tensor
    start: Tensor
    end: Tensor
    length_px: Tensor
    depths_m: Tensor
    frame: Tensor
    window: Tensor


def _in_view(view, curve, cameras, frames):
    found = []
    for frame in frames:
        pose = cameras[frame]
        eye = pose[:3, 3]
        index, bounds = curve.pieces(eye, piece_rad(1 / view.px_per_slope), view.aperture_m)
        if not index.numel():
            continue
        back = inverse(pose)
        ends = [apply(back, curve.points(index, bounds[:, i], eye)) for i in (0, 1)]
        for window in range(len(view.low)):
            rows, clip = view.clipped(window, *ends)
            if rows.numel():
                numbers = (torch.full_like(rows, n) for n in (frame, window))
                found.append(_Pieces(index[rows], bounds[rows], *clip, *numbers))
    return _Pieces.joined(found) if found else None


def _on_pieces(camera, view, curve, pieces, cameras, part, per_px, generator):
    """CurvePoints on pieces of one curve."""
    piece, inside, fraction = places(pieces.length_px, per_px, generator)
    pieces = pieces[piece]
    index, frame = pieces.index, pieces.frame
    low, high = pieces.bounds.unbind(1)
    kept = pieces.end - pieces.start
    at = pieces.start + inside * kept  # evenly along the film, so in perspective along the piece
    near, far = pieces.depths_m.unbind(1)
    sight = (1 - at) * far + at * near
    s = low + at * near / sight * (high - low)
    share = fraction * kept * near * far / sight.square() / STEP
    count = len(piece)
    turn = torch.randint(PUPILS, (2,), generator=generator)
    number = torch.arange(count)
    pupil = view.pupils[(number + turn[0]) % PUPILS]
    colour = (number + turn[1]) % view.colours
    pose = cameras[frame]
    # where the paraxial pupil is; the point's own ray then tells where the real one is
    viewpoint = _in_pupil(pose, pupil * view.viewpoint_m)
    y = apply(inverse(pose), curve.points(index, s, viewpoint)[:, None])[:, 0]
    seen = images(camera, y, pupil, colour, view.near_px(y), STEP_PX, FOUND_PX)
    found = seen.step_px < FOUND_PX
    real = _in_pupil(pose, y[:, :2] - seen.slope * y[:, 2:])
    viewpoint = torch.where(found[:, None], real, viewpoint)
    y = curve.points(index, s, viewpoint)
    on = curve.points(index, s + STEP * (high - low), viewpoint)
    share = share * curve.counts(index, y, viewpoint)
    beside = known_beside(curve, index, y, viewpoint)
    of_rays = seen.at_px, pupil, colour, pieces.window, frame, torch.full_like(frame, part)
    return CurvePoints(y, on, share, *beside, *of_rays)[found]


def _in_pupil(pose, place_m):
    """Points [n, 3] of the pupil's plane at [n, 2] in camera axes."""
    return pose[:, :3, 3] + (pose[:, :3, :2] @ place_m[..., None])[..., 0]


def known_beside(curve: Any, index: Tensor, y: Tensor, viewpoint: Tensor) -> tuple[Tensor, ...]:
    """Columns aside_rad .. apex_m of CurvePoints at points y [n, 3] of the curves ``index`` [n],
    seen from viewpoints [n, 3]."""
    aside, near = (
        torch.maximum(
            curve.aside_rad(index, eye),
            FLOAT32_RAD * torch.maximum(y.abs().amax(1), eye.abs().amax(1)) / (y - eye).norm(dim=1),
        )
        for eye in (viewpoint, y + NEARBY * (viewpoint - y))
    )
    near = torch.minimum((NEARBY * near).clamp_min(NEAR_RAD), aside)
    return aside, near, curve.face_slope(index, y, viewpoint), curve.apex_m(index)


def piece_rad(slope_per_px: float) -> float:
    """Largest angle of a piece for a camera with so much slope per pixel, which is negative behind an
    intermediate image."""
    return min(PIECE_PX * abs(slope_per_px), PIECE_RAD)


class FieldOfView:
    """What of space falls on the windows of a film, in rough pixels: slopes from the pupil's centre
    over the slope of a pixel at the axis, in which straight lines are straight whatever the
    distortion."""

    def __init__(self, camera: Camera):
        self.seed = camera.seed
        self.px_per_slope = 1 / camera.slope_per_px()
        self.colours = len(camera.colours)
        _, pupils = film_pupil_pattern(PUPILS, camera.seed)
        self.pupils = pupils * (camera.aperture_m > 0)
        film = camera.film
        size = torch.tensor([film.width_px, film.height_px], dtype=torch.float64)
        boxes = [self._box(camera, border_px(corner, size, 9)) for corner in film.corners_px]
        self.low, self.high = (torch.stack(side) for side in zip(*boxes, strict=True))
        self.spread, self.shift, side = self._blur(camera)
        # from the axis, of a unit point of the paraxial pupil; and of the real one, at most
        self.viewpoint_m = side * camera.aperture_m
        self.aperture_m = max(camera.aperture_m, float(self.shift.norm(dim=1).max()))
        pixels = coarse_pixels(film, 1 + film.sensor_width_px // ACROSS)
        rays = camera.chief_rays(pixels)
        lit = rays.weight > 0
        lit |= ~lit.any()  # all meet an obstruction
        self._chief_px = pixels[lit]
        self._chief = scipy.spatial.cKDTree(rays.direction[lit].numpy())

    def near_px(self, y: Tensor) -> Tensor:
        """Film position [n, 2] px of points y [n, 3] in camera axes: of the chief ray, of some
        across the film, that points nearest to them. Light that goes from a point to the paraxial
        pupil may miss the film or the lens: off the axis of a wide one the pupil is elsewhere."""
        return self._chief_px[self._chief.query(normalize(y, dim=1).numpy())[1]]

    @property
    def steepest(self) -> float:
        """Rough pixels per angle, at most."""
        reach = torch.maximum(self.low.abs(), self.high.abs()).amax(0) / self.px_per_slope
        return abs(self.px_per_slope) * (1 + float(reach.square().sum()))

    def differs_px(self, other: "FieldOfView", nearest_m: float) -> float:
        """By how much at most other rays fall on the film through another lens, of what is so far
        away or further."""
        if self.shift.shape != other.shift.shape or not nearest_m > 0:
            return math.inf
        field, spread, shift = (
            float((a - b).norm(dim=-1).max())
            for a, b in (
                (
                    torch.stack([v / view.px_per_slope for v in (view.low, view.high)])
                    for view in (self, other)
                ),
                (self.spread, other.spread),
                (self.shift, other.shift),
            )
        )
        return (field + spread + shift / nearest_m) * abs(other.px_per_slope)

    def _box(self, camera, pixels):
        """Lowest and highest rough pixel of film positions; the axis scale where no chief ray
        reaches the film."""
        rays = camera.rays_through(pixels, torch.zeros_like(pixels))
        at = lines(rays)[1] * self.px_per_slope
        straight = pixels - camera.film.middle_px
        at = torch.where(((rays.weight > 0) & at.isfinite().all(1))[:, None], at, 1.15 * straight)
        middle = (at.amin(0) + at.amax(0)) / 2
        half = WIDER * (at.amax(0) - at.amin(0)) / 2 + MARGIN_PX
        return middle - half, middle + half

    def _blur(self, camera):
        """Differences of slope [k, 2] and of place at the pupil [k, 2] m between rays of a film
        point through the pupil's rim and the straight line from its middle to where its chief ray
        points; and -1 where the pupil is seen turned by half a turn, or else 1."""
        none = torch.zeros(1, 2, dtype=torch.float64)
        if not camera.aperture_m:
            return none, none, 1
        angle = torch.arange(8, dtype=torch.float64) * (math.pi / 4)
        rim = torch.stack([angle.cos(), angle.sin()], 1)
        fields = camera.film.middle_px + camera.film.sensor_px * torch.tensor(
            [[0, 0], [0.25, 0.25], [-0.5, 0.5], [0.5, 0], [0, -0.5]], dtype=torch.float64
        )
        chief = camera.rays_through(fields, torch.zeros_like(fields))
        rays = camera.rays_through(fields.repeat_interleave(8, 0), rim.repeat(5, 1))
        passes = (rays.weight > 0) & (chief.weight > 0).repeat_interleave(8)
        straight = lines(chief)[1].repeat_interleave(8, 0)
        base, slope = lines(rays)
        if not bool(passes.any()):
            return none, none, 1
        side = -1 if float((base * rim.repeat(5, 1))[passes].sum()) < 0 else 1
        return (slope - straight)[passes], base[passes], side

    def _blur_px(self, depth_m):
        """Radius [n] px of the blur of points at depths [n]; the larger of two ends bounds all
        between them."""
        near = 1 / depth_m
        return (self.spread[:, None] + self.shift[:, None] * near[:, None]).norm(dim=2).amax(
            0
        ) * abs(self.px_per_slope)

    def clipped(self, window, start_cam_m, end_cam_m):
        """Of pieces from [n, 3] to [n, 3] in camera axes, the rows that touch a window, and for
        these (start, end [m] shares of its length on the film, length [m] px that is left, depths
        of its ends [m, 2])."""
        front = torch.nonzero((start_cam_m[:, 2] > IN_FRONT_M) & (end_cam_m[:, 2] > IN_FRONT_M))[
            :, 0
        ]
        a, b = (p[front] for p in (start_cam_m, end_cam_m))
        depths = torch.stack([a[:, 2], b[:, 2]], 1)
        margin = torch.maximum(self._blur_px(a[:, 2]), self._blur_px(b[:, 2]))[:, None]
        a, b = (p[:, :2] / p[:, 2:] * self.px_per_slope for p in (a, b))
        along = b - a
        still = along.abs() < 1e-12
        slower = torch.where(still, 1.0, along)
        first, last = (
            (edge - a) / slower for edge in (self.low[window] - margin, self.high[window] + margin)
        )
        within = (a >= self.low[window] - margin) & (a <= self.high[window] + margin)
        enter = (
            torch.where(still, torch.where(within, 0.0, 2.0), torch.minimum(first, last))
            .amax(1)
            .clamp_min(0)
        )
        leave = torch.where(still, 1.0, torch.maximum(first, last)).amin(1).clamp_max(1)
        rows = torch.nonzero(leave > enter)[:, 0]
        enter, leave = enter[rows], leave[rows]
        return front[rows], (enter, leave, along[rows].norm(dim=1) * (leave - enter), depths[rows])


def places(
    length_px: Tensor,
    per_px: float,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor, Tensor]:
    """Where points lie on pieces of the given lengths [m] px: piece [n], position within it [n]
    0..1, and share of the piece each stands for [n].

    A piece longer than the spacing of points is cut into equal parts with a point in each, so that
    what is constant along it is summed exactly; shorter ones are thinned together, evenly along
    their total length.
    """
    long = torch.nonzero(length_px * per_px >= 1)[:, 0]
    count = (length_px[long] * per_px).ceil().long()
    which = torch.repeat_interleave(torch.arange(long.numel()), count)
    k = torch.arange(which.numel()) - (count.cumsum(0) - count)[which]
    inside = (k + torch.rand(k.numel(), generator=generator, dtype=torch.float64)) / count[which]
    short = torch.nonzero(length_px * per_px < 1)[:, 0]
    total = length_px[short].cumsum(0)
    few = int(torch.ceil(total[-1] * per_px)) if short.numel() else 0
    if few == 0:
        return long[which], inside, 1 / count[which].double()
    at = (
        (torch.arange(few) + torch.rand(1, generator=generator, dtype=torch.float64))
        / few
        * total[-1]
    )
    piece = torch.searchsorted(total, at).clamp_max(short.numel() - 1)
    size = length_px[short[piece]].clamp_min(1e-12)
    within = (1 - (total[piece] - at) / size).clamp(0, 1)
    return (
        torch.cat([long[which], short[piece]]),
        torch.cat([inside, within]),
        torch.cat([1 / count[which].double(), total[-1] / few / size]),
    )
