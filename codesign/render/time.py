"""Time: exposures, frame times that follow the motion, and sequences too long for memory. Rays are
traced once for a whole sequence.

A trajectory is a function of times [n] in seconds to poses T_world_cam [n, 4, 4], or [..., n, 4, 4]
for several in one batch. Where objects move, the scene is a function too: of times [n] to a
MovingScene with n poses per object.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

import torch
from torch import Tensor

from codesign.checks import check_finite, check_number, check_positive, check_whole
from codesign.errors import DomainError
from codesign.pose import Poses, check_poses
from codesign.render.camera import Camera
from codesign.render.film import coarse_pixels
from codesign.render.moving import MovingScene, Scene, at_frames, views_of
from codesign.render.sequence import PROVEN, Way, frames
from codesign.render.truth import track
from codesign.render.wavefront import shade

# times [n] in seconds to T_world_cam [..., n, 4, 4]
Trajectory: TypeAlias = Callable[[Tensor], Tensor]

FIRST_STEP = 1 / 64  # of the interval, until the motion is known
# from step to step at most; the share of the largest displacement that steps aim at
GROWTH = 2.0
AIM = 0.95
COARSE = 8  # times the spacing of pixels, for the search of a step; the step found is judged by all
SMALLEST_STEP = 1e-9  # of the interval


def exposed_frames(
    camera: Camera,
    scene: Scene | MovingScene | Callable[[Tensor], MovingScene],
    trajectory: Trajectory,
    t_s: Tensor | Sequence[float],
    exposure_s: float,
    samples: int = 8,
    gradient: Way = "interior",
    per_px: float = 2.5,
    *,
    line_s: float = 0.0,
) -> Tensor:
    """Frames averaged over an exposure centred on each time: motion blur; read line by line where
    asked.

    >>> from codesign import lens, pose, render
    >>> from scenes import trajectories, worlds
    >>> camera = render.Camera(lens.Pinhole(8.0), 8, 6, pixel_pitch_mm=0.5)
    >>> start = pose.look_at((0, -2, 1), (0, 0, 1))
    >>> path = lambda t_s: trajectories.translation(start, (1.0, 0.0, 0.0), t_s)  # a metre per second
    >>> render.exposed_frames(camera, worlds.room(), path, [0.0, 0.05], exposure_s=0.02, line_s=1e-4).shape
    torch.Size([2, 6, 8])

    Args:
      camera: Camera.
      scene, trajectory: see the top of this file.
      t_s: [T], middles of the exposures.
      exposure_s: length of the exposure, >= 0.
      samples: time samples per frame, in the middle of equal shares of the exposure: a moving edge
        is wrong by at most its jump / (2 samples).
      gradient, per_px: as ``frames`` takes them, for every time sample; "boundary" has the motion
        of silhouettes in it.
      line_s: rolling shutter: row r of the sensor is exposed r * line_s later than row 0, whose
        middle is t_s; each row is a launch of its own, and wants a larger ``per_px`` for
        silhouettes as quiet.
    Returns: [..., T, *film.shape], the mean of the irradiance over the exposure, in the scene's
      units.
    Gradient: lens, and whatever the trajectory's poses depend on; what it holds says ``gradient``.
    Raises: DomainError on a negative exposure, a line time that is not finite, fewer than one
      sample, poses that are not rigid, or a gradient that ``frames`` refuses.
    """
    t_s = check_finite(torch.as_tensor(t_s, dtype=torch.float64).reshape(-1), "times of the frames")
    check_number(exposure_s, "exposure_s", 0.0)
    check_number(line_s, "line_s", remedy="the seconds from one row of the sensor to the next")
    samples = check_whole(samples, "time samples of an exposure")
    if line_s or (exposure_s and samples > 1):
        _check_function(scene, "during an exposure and from line to line")
    nodes_s = [((k + 0.5) / samples - 0.5) * exposure_s for k in range(samples)]
    if not line_s:
        return _exposed(camera, scene, trajectory, t_s, nodes_s, gradient, per_px)
    film = camera.film
    corners = film.windows_px or ((0, 0),)
    shown = [(left, top + row) for left, top in corners for row in range(film.height_px)]
    found = {}
    for top in sorted({top for _, top in shown}):
        here = [number for number, place in enumerate(shown) if place[1] == top]
        row = camera.with_film(
            replace(film, height_px=1, windows_px=tuple(shown[number] for number in here))
        )
        lines = _exposed(row, scene, trajectory, t_s + top * line_s, nodes_s, gradient, per_px)
        found.update(zip(here, lines.squeeze(-2).unbind(-2), strict=True))
    lines = torch.stack([found[number] for number in range(len(shown))], -2)
    return lines.reshape(*lines.shape[:-2], *film.shape)


def _exposed(camera, scene, trajectory, t_s, nodes_s, gradient, per_px):
    """Mean of the frames at all ``nodes_s`` from t_s; the lens is traced once where ``gradient``
    allows it."""
    rays = camera.rays() if gradient in PROVEN else None
    total = 0.0
    for node_s in nodes_s:
        at = t_s + node_s
        seen = frames(camera, _at(scene, at), trajectory(at), gradient, per_px, rays=rays)
        total = total + seen / len(nodes_s)
    return total


def frame_chunks(
    camera: Camera, scene: Scene | MovingScene, T_world_cam: Poses, frames_per_chunk: int
) -> Iterator[Tensor]:
    """Generator of the frames of a long sequence, some at a time: [..., <= frames_per_chunk,
    *film.shape] each, in bounded memory. T_world_cam: [..., T, 4, 4]; a chunk holds those frames of
    every trajectory.

    Joined, the chunks are what ``frames`` gives, bit for bit: every frame is the same sum in the
    same order.
    Gradient: as ``frames`` has it (interior term). All chunks share one trace of the lens, so going
    backward from one chunk at a time needs ``retain_graph=True`` where the lens is learned.
    """
    T_world_cam = check_poses(T_world_cam)
    each = check_whole(frames_per_chunk, "frames_per_chunk")
    count = T_world_cam.shape[-3]
    if isinstance(scene, MovingScene):
        scene.check_length(count)
    return _chunks(
        camera,
        scene,
        T_world_cam,
        [slice(first, min(first + each, count)) for first in range(0, count, each)],
    )


def _chunks(camera, scene, T_world_cam, pieces):
    rays = camera.rays()
    for piece in pieces:
        poses = T_world_cam[..., piece, :, :]
        yield shade(rays, at_frames(scene, piece), poses, camera.samples_per_pixel).reshape(
            *poses.shape[:-2], *camera.film.shape
        )


def adaptive_times(
    camera: Camera,
    scene: Scene | MovingScene | Callable[[Tensor], MovingScene],
    trajectory: Trajectory,
    start_s: float,
    end_s: float,
    largest_px: float,
    every_px: int = 1,
) -> Tensor:
    """Frame times between which no pixel's point moves by more than a given distance in the image,
    on any of the trajectories.

    Args:
      camera, scene, trajectory: see the top of this file.
      largest_px: largest displacement between frames, > 0.
      every_px: spacing of the pixels that are looked at, the film's border included; 1 looks at
        all, more is faster and may miss what is narrower or moves more between them.
    Returns: [n] float64 times, increasing, the first start_s and the last end_s. No gradient.
    Every step is judged by the displacement itself, through the lens: of the points seen at its
    start, and of the points seen at its end. Steps grow at most twofold and are judged at their
    middle too (on a coarser grid), so that a motion that comes back within a step is met by its
    parts. Linear interpolation between the frames then times a crossing of a pattern of wave number
    k to within k largest_px^2 / (8 s) pixels of motion, s the slope there as a share of the
    largest: a chord misses by h^2 max|L''| / 8 at most.
    Raises: DomainError when the interval is empty, largest_px is not positive, objects move by no
      function of time, or a displacement does not shrink with the step (a jump).
    Source: Rebecq, Gehrig and Scaramuzza, ESIM: an open event camera simulator, CoRL 2018 (adaptive
      sampling by the largest displacement).
    """
    start_s = check_number(start_s, "adaptive times: start_s")
    end_s = check_number(end_s, "adaptive times: end_s", above=start_s)
    check_positive(largest_px, "adaptive times: largest_px")
    every_px = check_whole(every_px, "adaptive times: every_px")
    _check_function(scene, "between its frames")
    shortest = SMALLEST_STEP * (end_s - start_s)
    with torch.no_grad():
        grids = [
            (pixels, camera.chief_rays(pixels))
            for pixels in (
                coarse_pixels(camera.film, spacing) for spacing in (COARSE * every_px, every_px)
            )
        ]
        times = [float(start_s)]
        step = FIRST_STEP * (end_s - start_s)
        while times[-1] < end_s:
            now = times[-1]
            step = min(step, end_s - now)
            while (
                moved := _displacement_px(
                    camera, scene, trajectory, (now, now + step), grids, largest_px
                )
            ) > largest_px:
                step *= max(0.01, 0.9 * AIM * largest_px / moved)
                if step < shortest:
                    raise DomainError(
                        f"adaptive times: the image jumps by {moved:.3g} px at {now:.9g} s however short "
                        "the step; give a path and objects that move continuously."
                    )
            times.append(end_s if now + step >= end_s - shortest else now + step)
            step *= min(GROWTH, AIM * largest_px / max(moved, 1e-300))
    return torch.tensor(times, dtype=torch.float64)


def _displacement_px(camera, scene, trajectory, ends, grids, largest_px):
    """The largest displacement within a step, px; infinite when a point passes the camera. The fine
    grid is asked only when the coarse one finds no more than allowed."""
    at = torch.tensor([ends[0], (ends[0] + ends[1]) / 2, ends[1]], dtype=torch.float64)
    views = views_of(_at(scene, at), trajectory(at))
    firsts = torch.arange(0, views.cameras.shape[1], at.numel())[:, None]
    largest = 0.0
    for (pixels, rays), pairs in zip(
        grids, (((0, 1), (0, 2), (2, 0)), ((0, 2), (2, 0))), strict=True
    ):
        now, later = (
            (firsts + torch.tensor(column)).reshape(-1) for column in zip(*pairs, strict=True)
        )
        found = track(camera, views, now, later, pixels, rays)
        lost = (found.hits.part >= 0) & ~found.valid
        largest = max(
            largest,
            float((found.to_px - pixels).norm(dim=-1).max()),
            _lost_px(camera, found, rays, lost) if bool(lost.any()) else 0.0,
        )
        if largest > largest_px:
            break
    return largest


def _lost_px(camera, found, rays, lost):
    """Displacement of points that left the field of the lens, by the scale at its axis; infinite
    behind the camera."""
    if not bool(found.in_front[lost].all()):
        return math.inf
    before = rays.direction.double().expand(*lost.shape, 3)[lost]
    after = found.points_cam_m[lost]
    moved = after[:, :2] / after[:, 2:] - before[:, :2] / before[:, 2:]
    return float(moved.norm(dim=1).max()) / abs(camera.slope_per_px())


def _check_function(scene, when):
    """Objects that move do so as a function of time."""
    worlds = scene if isinstance(scene, tuple | list) else (scene,)
    if any(isinstance(world, MovingScene) and world.names for world in worlds):
        raise DomainError(
            f"the objects of a MovingScene stand still {when}; give a function of time that returns one, see "
            "codesign.render.time."
        )


def _at(scene, t_s):
    return scene(t_s) if callable(scene) else scene
