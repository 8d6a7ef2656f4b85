"""Whether a sequence can be seen at all: what to ask before rendering thousands of frames."""

from dataclasses import replace

import torch

from codesign.errors import DomainError
from codesign.render.camera import coarse_pixels
from codesign.render.moving import at_frames, cameras_in_parts, in_one_row
from codesign.render.truth import first_hits
from codesign.render.wavefront import shade

CLOSEST_M = 1e-5  # for lenses without an aperture
BACKS = 0.5  # of the rays of a frame


def check_view(camera, scene, T_world_cam, every_px=8):
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
    scene, T_world_cam = in_one_row(scene, T_world_cam)
    with torch.no_grad():
        pixels = coarse_pixels(camera.film, int(every_px))
        rays = camera.chief_rays(pixels)
        rays = replace(rays, weight=(rays.weight > 0).to(rays.weight))
        light = shade(rays, scene, T_world_cam, 1)
        if not bool((light.isfinite() & (light >= 0)).all()):
            wrong = ~(light.isfinite() & (light >= 0))
            frame, ray = wrong.nonzero()[0].tolist()
            raise DomainError(
                f"frame {frame} has a radiance of {float(light[frame, ray]):.3g} at pixel "
                f"({_place(pixels[ray])}); make every radiance of the scene finite and at least 0."
            )
        nearest = max(CLOSEST_M, getattr(camera.lens, "entrance_pupil_diameter_mm", 0.0) * 1e-3 / 2)
        for frame in range(T_world_cam.shape[0]):
            _check_frame(frame, rays, at_frames(scene, [frame]), T_world_cam[[frame]], light[frame], nearest)


def _check_frame(frame, rays, scene, pose, light, nearest_m):
    cameras = [poses[0].double() for poses in cameras_in_parts(scene, pose)]
    hits = first_hits(rays, scene, cameras)
    met = hits.part >= 0
    if not bool(met.any()):
        raise DomainError(
            f"frame {frame} is empty: no ray of the camera meets anything; turn the camera towards the "
            "scene or move it there."
        )
    closest = float(hits.distance_m.min())
    if closest < nearest_m:
        raise DomainError(
            f"frame {frame}: a surface lies {closest * 1e3:.3g} mm before the camera, which is less than "
            f"the radius of its entrance pupil ({nearest_m * 1e3:.3g} mm); move the camera away from it."
        )
    turn = torch.stack(cameras)[hits.part.clamp_min(0), :3, :3]
    along = ((turn @ rays.direction.double()[..., None])[..., 0] * hits.normal).sum(1)
    backs = float((met & (along > 0) & (light == 0)).double().sum() / met.double().sum())
    if backs > BACKS:
        raise DomainError(
            f"frame {frame}: {backs:.0%} of the rays meet surfaces from behind, where they are dark: the "
            "camera is inside an object or behind a wall; move it out, or flip the normals."
        )


def _place(pixel):
    return ", ".join(f"{v:.0f}" for v in pixel.tolist())
