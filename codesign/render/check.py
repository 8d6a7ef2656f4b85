"""Whether a sequence can be seen at all: what to ask before rendering thousands of frames."""

from dataclasses import replace

import torch

from codesign.errors import DomainError, check_whole
from codesign.pose import Poses
from codesign.render.camera import Camera
from codesign.render.film import coarse_pixels
from codesign.render.hits import dot, of_part, turned
from codesign.render.moving import MovingScene, Scene, views_of
from codesign.render.truth import hits_of
from codesign.render.wavefront import shaded

CLOSEST_M = 1e-5  # for lenses without an aperture
BACKS = 0.5  # of the rays of a frame


def check_view(camera: Camera, scene: Scene | MovingScene, T_world_cam: Poses, every_px: int = 8) -> None:
    """Raise DomainError, with the number of the first frame, when a sequence of views is not one a camera
    could have.

    Args: camera, scene, T_world_cam [..., T, 4, 4] as for ``frames``; the frames of a batch count through,
      trajectory after trajectory. every_px: spacing of the pixels that are
      looked at, by one chief ray each.
    Raises: DomainError when poses are not rigid; no ray of a frame meets anything; something lies nearer than
      the radius of the entrance pupil, so that the
      camera stands in it; more than half of the rays meet surfaces from behind and see no light there, as
      from inside an object or behind a wall (surfaces
      that are lit from behind, as planes without sides are, pass); or a radiance is NaN, infinite or
      negative.
    """
    views = views_of(scene, T_world_cam)
    with torch.no_grad():
        pixels = coarse_pixels(camera.film, check_whole(every_px, "every_px"))
        rays = camera.chief_rays(pixels)
        rays = replace(rays, weight=(rays.weight > 0).to(rays.weight))
        light = shaded(rays, views, 1).flatten(0, -2)
        if not bool((light.isfinite() & (light >= 0)).all()):
            wrong = ~(light.isfinite() & (light >= 0))
            frame, ray = wrong.nonzero()[0].tolist()
            raise DomainError(
                f"frame {frame} has a radiance of {float(light[frame, ray]):.3g} at pixel "
                f"({_place(pixels[ray])}); make every radiance of the scene finite and at least 0."
            )
        nearest_m = max(CLOSEST_M, getattr(camera.lens, "entrance_pupil_diameter_mm", 0.0) * 1e-3 / 2)
        hits = hits_of(rays, views.scene, views.cameras)
        along = dot(turned(of_part(hits, views.cameras), rays.direction.double()), hits.normal)
        for frame in range(len(light)):
            _check_frame(
                frame, hits.part[frame] >= 0, hits.distance_m[frame], along[frame], light[frame], nearest_m
            )


def _check_frame(frame, met, distance_m, along, light, nearest_m):
    if not bool(met.any()):
        raise DomainError(
            f"frame {frame} is empty: no ray of the camera meets anything; turn the camera towards the "
            "scene or move it there."
        )
    closest = float(distance_m.min())
    if closest < nearest_m:
        raise DomainError(
            f"frame {frame}: a surface lies {closest * 1e3:.3g} mm before the camera, which is less than "
            f"the radius of its entrance pupil ({nearest_m * 1e3:.3g} mm); move the camera away from it."
        )
    backs = float((met & (along > 0) & (light == 0)).double().sum() / met.double().sum())
    if backs > BACKS:
        raise DomainError(
            f"frame {frame}: {backs:.0%} of the rays meet surfaces from behind, where they are dark: the "
            "camera is inside an object or behind a wall; move it out, or flip the normals."
        )


def _place(pixel):
    return ", ".join(f"{v:.0f}" for v in pixel.tolist())
