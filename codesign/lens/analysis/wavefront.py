"""Wavefront error of a lens: optical path differences from the reference sphere, their RMS, and the
Strehl ratio.

Paths count from the object point, that is from its spherical wavefront through the centre of the
entrance pupil (a plane for parallel light). The reference sphere is centred on the chief ray's
image point (or another given point) and passes through the centre of the paraxial exit pupil. An
optical path difference is positive where the wavefront is ahead of the sphere, so that
undercorrected spherical aberration is positive (W040 = S_I / 8).
Source: Welford, Aberrations of Optical Systems, ch. 7; Born and Wolf, ch. 9.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.analysis.rays import ImageRays, pupil_grid, trace_with_chief
from codesign.lens.distance import PARALLEL
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import D_UM
from codesign.lens.traced import in_float64


@dataclass(frozen=True)
class Wavefront:
    """Optical path differences over the pupil.

    pupil: [M, 2] points of the unit disc (entrance pupil). opd_mm: [M], positive where the
      wavefront is ahead. weight: [M], 0 where no light passes. slope: [M, 2] direction cosines
      times index from the ray's point on the reference sphere to its centre, minus those of the
      chief ray. reference_mm: [2] that centre, on the image plane.
    """

    pupil: Tensor
    opd_mm: Tensor
    weight: Tensor
    slope: Tensor
    wavelength_um: float
    reference_mm: Tensor

    @property
    def waves(self) -> Tensor:
        """[M] optical path differences in wavelengths (in vacuum)."""
        return self.opd_mm / (self.wavelength_um * 1e-3)


def path_difference_mm(
    lens: GeoLens,
    rays: ImageRays,
    chief: ImageRays,
    wavelength_um: float,
    reference_mm: Tensor | None = None,
) -> Tensor:
    """Optical path of the chief ray minus that of each ray, both up to the reference sphere, [M]
    mm.

    Args:
      rays, chief: ImageRays of the lens.
      reference_mm: [2] centre of the sphere.
    Raises: DomainError when the exit pupil lies in the image, or a sphere is too small for the
      rays.
    """
    return _on_sphere(lens, rays, chief, wavelength_um, reference_mm)[0]


def wavefront(
    lens: GeoLens,
    field_rad: float,
    wavelength_um: float = D_UM,
    grid: int = 64,
    vignetting: bool = False,
    reference_mm: Tensor | None = None,
    pupil: Tensor | None = None,
    at_m: float | Tensor = PARALLEL,
) -> Wavefront:
    """Wavefront of one object point.

    Args:
      grid: pupil cells across (the points are those of ``pupil_grid``), unless ``pupil`` [M, 2]
        gives the points themselves.
      vignetting, at_m (one distance): see ``trace_field``. reference_mm: [2] centre of the
        reference sphere; None is the chief ray's point.
    Returns: Wavefront, in the lens's precision; paths of many wavelengths are computed in float64.
    Gradient: opd_mm to every lens tensor and to at_m. Raises: DomainError when no ray, or not the
      chief ray, arrives.
    """
    like = lens.curvature_per_mm
    lens = in_float64(lens)
    pupil = pupil_grid(grid, torch.float64, like.device) if pupil is None else pupil.double()
    rays, chief = trace_with_chief(lens, field_rad, pupil, wavelength_um, vignetting, at_m)
    reference_mm = chief.position_mm[0] if reference_mm is None else torch.as_tensor(reference_mm)
    opd, slope = _on_sphere(lens, rays, chief, wavelength_um, reference_mm)
    opd = torch.where(rays.weight > 0, opd, 0)
    pupil, opd, weight, slope, reference_mm = (
        v.to(like.dtype) for v in (pupil, opd, rays.weight, slope, reference_mm)
    )
    return Wavefront(pupil, opd, weight, slope, wavelength_um, reference_mm)


def remove_fit(front: Wavefront, tilt: bool = True, focus: bool = False) -> Wavefront:
    """The wavefront without piston, and as asked without tilt and focus (x^2 + y^2), by a weighted
    least-squares fit. Differentiable."""
    x, y = front.pupil.unbind(1)
    columns = [torch.ones_like(x), *([x, y] if tilt else []), *([x * x + y * y] if focus else [])]
    basis = torch.stack(columns, 1)
    w = front.weight[:, None]
    normal = basis.T @ (basis * w)
    # a fan has no extent across, so its normal matrix is singular: the pseudo-inverse fits what
    # there is
    fit = torch.linalg.pinv(normal, hermitian=True) @ (basis.T @ (front.opd_mm[:, None] * w))
    return replace(front, opd_mm=front.opd_mm - (basis @ fit)[:, 0])


def rms_waves(front: Wavefront) -> Tensor:
    """RMS of the optical path difference about its mean, in waves; scalar. Gradient: to opd and
    weights; 0 for a perfect wavefront."""
    w = front.weight / front.weight.sum()
    away = front.waves - (front.waves * w).sum()
    return torch.linalg.vector_norm(away * torch.where(w > 0, w, 1).sqrt() * (w > 0))


def peak_to_valley_waves(front: Wavefront) -> Tensor:
    """Largest minus smallest optical path difference where light passes, waves; scalar."""
    seen = front.waves[front.weight > 0]
    return seen.max() - seen.min()


def strehl_direct(front: Wavefront) -> Tensor:
    """Strehl ratio |mean of exp(-i k W)|^2 at the centre of the reference sphere; scalar in [0, 1].
    Remove the tilt first to follow the peak."""
    w = front.weight / front.weight.sum()
    phase = 2 * math.pi * front.waves
    return (w * phase.cos()).sum().square() + (w * phase.sin()).sum().square()


def strehl_marechal(front: Wavefront) -> Tensor:
    """Strehl ratio exp(-(2 pi sigma)^2) from the RMS in waves; good above about 0.3. Source:
    Mahajan, JOSA 73 (1983)."""
    return torch.exp(-(2 * math.pi * rms_waves(front)).square())


def _on_sphere(lens, rays, chief, wavelength_um, reference_mm):
    """Path differences [M] mm and slopes [M, 2] of a Wavefront."""
    centre = chief.position_mm[0] if reference_mm is None else reference_mm
    bend = _sphere_curvature(lens, centre, wavelength_um)
    lengths = [_to_sphere(bundle, centre, bend) for bundle in (rays, chief)]
    towards = [
        bundle.direction[:, :2] * (1 - bend * length)[:, None]
        - bend * (bundle.position_mm - centre)
        for bundle, length in zip((rays, chief), lengths, strict=True)
    ]
    return chief.index * (lengths[1] - lengths[0]) + (chief.path_mm - rays.path_mm), rays.index * (
        towards[0] - towards[1]
    )


def _sphere_curvature(lens, centre, wavelength_um):
    """1 / radius of the reference sphere, positive when the exit pupil lies before the image; 0 for
    a telecentric lens."""
    f = lens.first_order(wavelength_um)
    before = lens.thickness_mm[-1] - f.exit_pupil_z_mm  # mm from the exit pupil to the plane
    if abs(float(before.detach())) < 1e-9:
        raise DomainError(
            f"{lens.name}: the exit pupil lies in the image plane, so there is no reference sphere; move "
            "the image plane or the stop."
        )
    if not math.isfinite(float(before.detach())):
        return torch.zeros_like(centre[0])
    return torch.sign(before) / (before.square() + centre.square().sum()).sqrt()


def _to_sphere(rays, centre, bend):
    """Signed distance along each ray to the reference sphere, plus its radius: free of
    cancellation, and regular when the sphere is a plane."""
    x, y = (rays.position_mm - centre).unbind(1)  # on the plane, so that z is 0
    axial = x * rays.direction[:, 0] + y * rays.direction[:, 1]
    across = x * x + y * y - axial.square()
    radicand = 1 - across * bend.square()
    if bool((radicand.detach()[rays.weight.detach() > 0] <= 0).any()):
        raise DomainError(
            "rays pass further from the image point than the reference sphere's radius; the aberration is "
            "too large for a wavefront, use spots instead."
        )
    return across * bend / (1 + radicand.clamp_min(1e-12).sqrt()) - axial
