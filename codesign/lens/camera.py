"""A traced lens as a camera: rays from its film to the scene, and back."""

import math

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.aiming import aim_at_stop, area_at_stop
from codesign.lens.glass import D_UM
from codesign.lens.trace import Status, trace
from codesign.lens.traced import TracedLens, in_float64
from codesign.types import Rays


def camera_rays(
    lens: TracedLens,
    film_mm: Tensor,
    pupil: Tensor,
    wavelength_um: float,
    aim: bool,
) -> Rays:
    """Rays from image points through a lens towards the scene; see ``GeoLens.camera_rays``."""
    if aim and lens.dtype != torch.float64:
        return camera_rays(in_float64(lens), film_mm, pupil, wavelength_um, aim)
    f = lens.first_order(wavelength_um)
    if not (
        math.isfinite(f.exit_pupil_z_mm.item()) and math.isfinite(f.entrance_pupil_z_mm.item())
    ):
        raise DomainError(
            f"{lens.name}: a pupil lies at infinity (the lens is telecentric), so pupil points have no "
            "place; move the stop off the focal plane."
        )
    back = lens.prescription(wavelength_um).reversed(-_origin_z_mm(lens, f, wavelength_um))
    at_stop = len(lens.surfaces) - 1 - lens.stop_index
    radius = f.exit_pupil_diameter_mm / 2

    def towards(film, q):
        return _towards(film, q, lens.thickness_mm[-1], f.exit_pupil_z_mm)

    if aim:
        film = film_mm.to(lens.dtype)

        def field(q, share):
            return towards(film.repeat(q.shape[0] // film.shape[0], 1) * share, q)

        until = back.until(at_stop)
        # the opening is one for all colours
        stop_mm = lens.first_order().stop_semi_aperture_mm
        at = aim_at_stop(field, until, pupil.to(lens.dtype), stop_mm, radius)
        area = area_at_stop(field, until, at, radius)
        start, direction = (v.to(film_mm.dtype) for v in towards(film, at.point_mm))
        spread = ((stop_mm / radius).square() / area.abs()).to(film_mm.dtype)
    else:
        start, direction = (
            v.to(film_mm.dtype) for v in towards(film_mm, pupil * radius.to(film_mm.dtype))
        )
        spread = torch.ones_like(film_mm[:, 0])
    out = trace(back.to(film_mm.dtype).opened(at_stop), start, direction)
    if bool((out.weight.detach() <= 0).all()):
        raise DomainError(f"{lens.name}: every ray fails{_where(lens, out)}.")
    return Rays(out.position_mm * 1e-3, out.direction, out.weight, spread * direction[:, 2] ** 4)


def film_points(
    lens: TracedLens, points_mm: Tensor, pupil: Tensor, wavelength_um: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Where light from points of space meets the film; see ``GeoLens.film_points``."""
    f = lens.first_order(wavelength_um)
    dtype = points_mm.dtype
    radius = f.entrance_pupil_diameter_mm.to(dtype) / 2
    at = torch.cat([pupil * radius, torch.zeros_like(pupil[:, :1])], 1)
    flip = points_mm.new_tensor([1.0, 1.0, -1.0])
    start = points_mm * flip
    direction = torch.nn.functional.normalize((at - points_mm) * flip, dim=1)
    start = torch.cat(
        [start[:, :2], start[:, 2:] + _origin_z_mm(lens, f, wavelength_um).to(dtype)], 1
    )
    out = trace(
        lens.prescription(wavelength_um).to(dtype).opened(lens.stop_index), start, direction
    )
    to_pupil = (f.exit_pupil_z_mm - lens.thickness_mm[-1]).to(dtype)
    back = to_pupil * out.direction[:, :2] / out.direction[:, 2:]
    return (
        -out.position_mm[:, :2],
        (out.position_mm[:, :2] + back) / (f.exit_pupil_diameter_mm.to(dtype) / 2),
        out.weight.detach() > 0,
    )


def _origin_z_mm(lens, f, wavelength_um):
    """Where the camera's origin lies: at the entrance pupil of the d line, one for all colours. f:
    first-order figures at the wavelength."""
    return (f if wavelength_um == D_UM else lens.first_order()).entrance_pupil_z_mm


def _where(lens, out):
    """What became of most rays of a backward trace, in words; surfaces are counted from the
    object."""
    failed = out.failed_surface[out.status != Status.OK]
    if failed.numel() == 0 and any(s.inner_semi_aperture_mm for s in lens.surfaces):
        return (
            " (all of them are stopped by the edges of the apertures or by the central obstruction, which "
            "chief rays meet; point spread maps need chief rays, so render traced frames)"
        )
    if failed.numel() == 0:
        return " (all of them are stopped by the edges of the apertures); open the apertures"
    at = len(lens.surfaces) - int(failed.mode().values)
    return (
        f" (most at surface {at} of {len(lens.surfaces)}, counted from the object)"
        if at
        else " (most before they leave the first surface forwards)"
    ) + "; weaken the curvatures or open the apertures"


def _towards(film_mm, at_mm, last_mm, exit_z_mm):
    """Rays from upright image points [N, 2] to points [N, 2] of the exit pupil's plane, in the axes
    of the reversed lens: start and direction [N, 3]."""

    def place(points, z):
        return torch.cat([points, -z.to(points.dtype).expand(points.shape[0], 1)], 1)

    start = place(-film_mm, last_mm)  # the image is inverted on the film
    direction = torch.nn.functional.normalize(place(at_mm, exit_z_mm) - start, dim=1)
    # a virtual exit pupil behind the film points the other way
    return start, direction * torch.sign(direction[:, 2:])
