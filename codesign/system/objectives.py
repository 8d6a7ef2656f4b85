"""Objectives of a flow system in task units, and the seed project's edge energy; stages to hand to
``System``."""

import torch
from torch import Tensor

from codesign import render
from codesign.errors import DomainError
from codesign.system.batch import scenes_of
from codesign.types import EventVolume, FlowField


def angular_error_mrad(
    field: FlowField, camera: render.Camera, scene: object, T_world_cam: Tensor, every_px: int = 8
) -> Tensor:
    """Mean angle by which the flow misses the world points that it started on, over the interval.

    A flow error in task units, which neither focal length nor distortion can flatter.
    Args:
      field: flow_px [N, 2, H, W], on the pixels of the first pose.
      camera, scene, T_world_cam [..., T, 4, 4]: as for the System; N trajectories times windows of
      the film.
      every_px: spacing of the pixels looked at.
    Returns: [N] mrad, over the pixels that see a surface.
    Gradient: flow, lens and poses.
    Raises: DomainError when a sample sees no surface at any of the pixels.
    """
    film = camera.film
    height, width = film.shape[-2:]
    pixels = film.pixels().reshape(-1, height, width, 2)[
        :, every_px // 2 :: every_px, every_px // 2 :: every_px
    ]
    windows = pixels.shape[0]
    pixels = pixels.reshape(-1, 2)
    motion = field.flow_px[..., every_px // 2 :: every_px, every_px // 2 :: every_px].double()
    # [trajectories, pixels of all windows, 2]
    motion = motion.movedim(1, -1).reshape(-1, pixels.shape[0], 2)
    rays = camera.chief_rays(pixels)
    found = [render.truth.later_points(rays, *pair) for pair in scenes_of(scene, T_world_cam)]
    points = torch.cat([points for points, _ in found])  # [trajectories, pixels of all windows, 3]
    weight = torch.cat([seen for _, seen in found]).reshape(len(points) * windows, -1).double()
    if bool((weight.sum(1) == 0).any()):
        raise DomainError(
            "some sample sees no surface at any pixel, so its flow has no error; turn the camera."
        )
    miss = render.angular_miss_rad(camera, (pixels + motion).reshape(-1, 2), points.reshape(-1, 3))
    return 1e3 * (miss.reshape(weight.shape) * weight).sum(1) / weight.sum(1)


def edge_energy(volume: EventVolume) -> Tensor:
    """Mean squared Sobel gradient of the signed event frames (one per bin), events^2 per
    pixel^2."""
    from kornia.filters import spatial_gradient

    signed = volume.counts[:, 0] - volume.counts[:, 1]
    return spatial_gradient(signed, mode="sobel", normalized=True).square().sum(2).mean()


def edge_objective(volume: EventVolume, activity_weight: float = 0.01) -> Tensor:
    """The seed project's objective: -(edge energy of event frames - weight * events per pixel and
    bin)."""
    return activity_weight * volume.counts.sum(1).mean() - edge_energy(volume)
