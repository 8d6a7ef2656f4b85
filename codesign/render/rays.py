"""Rays of a camera one by one, each in its own colour, and what of a sample's light they carry."""

import torch
from torch import Tensor

from codesign.render.camera import Camera


def coloured_rays(
    camera: Camera, film_px: Tensor, pupil: Tensor, colour: Tensor, whole: bool = True
) -> tuple[Tensor, Tensor, Tensor]:
    """Origins and directions [n, 3] in camera axes of rays through film positions and pupil points, and the share of
    a sample's light [n] that they carry, each in its own colour; without ``whole`` the share that passes the apertures."""
    if camera.spectrum is None:
        return _of_rays(camera, camera.rays_through(film_px, pupil), 1.0, whole)
    count = len(camera.spectrum.wavelengths_um)
    found = []
    order = []
    for number, (wavelength, weight) in enumerate(
        zip(camera.spectrum.wavelengths_um, camera.spectrum.weights, strict=True)
    ):
        rows = torch.nonzero(colour == number)[:, 0]
        order.append(rows)
        rays = camera.rays_through(film_px[rows], pupil[rows], wavelength)
        found.append(_of_rays(camera, rays, weight * count, whole))
    back = torch.cat(order).argsort()
    origin, direction, light = (torch.cat(column)[back] for column in zip(*found, strict=True))
    return origin, direction, light


def _of_rays(camera, rays, share, whole):
    light = rays.weight * share if whole else rays.weight
    if whole and camera.falloff:
        light = light * rays.irradiance.detach()
    return rays.origin_m.double(), rays.direction.double(), light.double()
