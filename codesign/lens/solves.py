"""Solves in closed form, differentiable: the focal length held by a curvature, focus by the last
thickness."""

from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor

from codesign.checks import check_number
from codesign.errors import DomainError
from codesign.lens import paraxial
from codesign.lens.analysis.rays import pupil_grid, source_rays, trace_source
from codesign.lens.distance import PARALLEL, Distances, one_distance, vergence_per_mm
from codesign.lens.glass import D_UM
from codesign.lens.paraxial import bending, focused_image, yu_trace
from codesign.lens.traced import TracedLens

L = TypeVar("L", bound=TracedLens)

FLAT = 1e-12  # per mm; a curvature below this is a plane
NO_POWER = 1e-9  # index step, or ray height in mm, below which a curvature cannot bend the ray


def holding_surface(lens: TracedLens) -> int:
    """Index of the surface whose curvature holds the focal length: the last that bends light and is
    not the face of a plane-parallel plate.

    A stop in air and a cover glass behind the lens are passed over; the plane side of a
    plano-convex lens is not. When all are plane (a design from scratch) it is the last that bends
    light. It goes by today's
    curvatures: where those of a cover glass vary, name the surface instead. Raises: DomainError
    when none does.
    """
    step = bending(lens.index(), lens.mirrors).detach().abs().tolist()
    curved = [abs(c) > FLAT for c in lens.curvature_per_mm.tolist()]
    refracts = [s > NO_POWER for s in step]
    index = lens.index().tolist()
    bends = [i for i, yes in enumerate(refracts) if yes]
    if not bends:
        raise DomainError(
            f"{lens.name}: no surface changes the index (all index steps are 0), so none can hold the focal "
            "length; give a surface a glass."
        )

    def has_shape(i):
        neighbours = [
            j
            for j, n in ((i - 1, index[i]), (i + 1, index[i + 1]))
            if 0 <= j < len(curved) and n > 1 + 1e-3
        ]
        return curved[i] or any(curved[j] for j in neighbours)

    return next((i for i in reversed(bends) if has_shape(i)), bends[-1])


def hold_efl(lens: L, efl_mm: float | Tensor, surface: int | None = None) -> L:
    """The lens with one curvature solved so that the focal length is ``efl_mm`` exactly.

    Args:
      efl_mm: not 0, at the d line.
      surface: index of the curvature to solve; ``holding_surface(lens)`` when left out.
    Gradient: the solved curvature carries that of all others, of thicknesses and of indices; efl_mm
      too when it is a tensor.
    Raises: DomainError for a focal length of 0, or when that curvature cannot do it.
    Source: the y-u trace, whose last angle is linear in the power of each surface (Smith, Modern
      Optical Engineering, ch. 2).
    """
    if check_number(efl_mm, f"{lens.name}: the focal length to hold, mm,") == 0:
        raise DomainError(f"{lens.name}: no lens has a focal length of 0; give one in mm.")
    c, t, n, power = lens.curvature_per_mm, lens.thickness_mm, lens.index(), lens.surface_power()
    at = holding_surface(lens) if surface is None else range(c.numel())[surface]
    one = torch.ones_like(c[0])
    heights, angles = yu_trace(power, t, n, one, torch.zeros_like(one))
    # change of the last angle by that behind the surface
    by_angle = one
    if at < c.numel() - 1:
        by_angle = yu_trace(power, t, n, t[at] / n[at + 1], one, first=at + 1)[1][-1]
    step = bending(n, lens.mirrors)[at]
    weak = [float(v.detach()) for v in (step, heights[at], by_angle)]
    if min(map(abs, weak)) < NO_POWER:
        raise DomainError(
            f"{lens.name}: surface {at + 1} cannot hold the focal length (index step {weak[0]:.3g}, ray "
            f"height {weak[1]:.3g}, lever {weak[2]:.3g}); name a refracting one away from an image."
        )
    # the last angle falls in proportion to the surface's power
    solved = c[at] + (angles[-1] + n[-1] / efl_mm) / (heights[at] * by_angle * step)
    return lens.replace(curvature_per_mm=torch.cat([c[:at], solved.reshape(1), c[at + 1 :]]))


def focus_at(lens: L, distance_m: float | Tensor, wavelength_um: float, spot_grid: int | None) -> L:
    """The lens with its film where an axial point is imaged; see ``GeoLens.focus_at``."""
    vergence = vergence_per_mm(lens, one_distance(distance_m))
    height, angle = paraxial.focused_image(lens, vergence, wavelength_um)
    image_mm = -height * lens.index(wavelength_um)[-1] / angle
    # where it meets again, and not within rounding of parallel; its angle is positive behind an
    # intermediate image
    if not (float(image_mm.detach()) > 0 and abs(float(angle.detach())) > 1e-12):
        raise DomainError(
            f"{lens.name}: the light of a point {float(1e-3 / vergence.detach()):.6g} m before the "
            f"entrance pupil does not converge behind the lens; {_remedy(lens)}."
        )
    focused = _last_thickness(lens, image_mm)
    if spot_grid is None:
        return focused
    return focus_rays(focused, [0.0], [wavelength_um], spot_grid, distance_m)


def least_spot_shift(position: Tensor, slope: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """How far behind their plane rays of several spots have the least mean square distance from
    their spot's mean, scalar mm; and the mean square slope that says how sharp that place is.

    Straight rays make the squared spot a parabola in z: with d the distance of a ray from its
    spot's mean and s the same of its slope, the least of sum |d + z s|^2 lies at z = -sum(d.s) /
    sum(s.s). Args:
      position, slope: [spots, M, 2].
      weight: [spots, M, 1] >= 0, with a positive sum for every spot.
    """
    total = weight.sum(1, keepdim=True)
    position, slope = (
        (v - (v * weight).sum(1, keepdim=True) / total) * (weight / total.sqrt())
        for v in (position, slope)
    )
    sharpness = slope.square().sum()
    return -(position * slope).sum() / sharpness, sharpness


def _remedy(lens):
    if not float(paraxial.image_place_mm(lens).detach()) > 0:
        return "nor does parallel light; change a curvature"
    nearest = (
        lens.first_order().entrance_pupil_z_mm - paraxial.cardinal_points(lens).front_focal_z_mm
    )
    return f"it needs more than {float(nearest.detach()) * 1e-3:.6g} m"


def focus_paraxial(lens: L, defocus_mm: float | Tensor = 0.0, at_m: float | Tensor = PARALLEL) -> L:
    """The lens with its image plane at the paraxial image of an axial point, or ``defocus_mm``
    (number or scalar tensor) behind it. Differentiable.

    Args:
      at_m: metres from the entrance pupil to the point, inf for parallel light.
        ``GeoLens.focus_at`` does the same and refuses images that are not real.
    Raises: DomainError for light that leaves the lens parallel, or a distance inside the lens. A
      focus inside the lens gives a negative last thickness, which constraints must push back.
    """
    height, angle = focused_image(lens, vergence_per_mm(lens, one_distance(at_m)))
    if abs(float(angle.detach())) < 1e-12:
        raise DomainError(
            f"{lens.name}: the light of a point {float(torch.as_tensor(at_m).detach()):.6g} m away leaves "
            "the lens parallel, so it has no focus; the lens is afocal for it: change a curvature or the "
            "distance."
        )
    return _last_thickness(lens, -height * lens.index()[-1] / angle + defocus_mm)


def focus_rays(
    lens: L,
    fields_rad: Sequence[float],
    wavelengths_um: Sequence[float] = (D_UM,),
    grid: int = 16,
    at_m: Distances = PARALLEL,
) -> L:
    """The lens with its image plane where the mean square spot over fields, distances and
    wavelengths is least.

    Spots of one object point share their mean over the wavelengths; see ``focus.least_spot_shift``.

    Args:
      fields_rad: angles; wavelengths_um.
      grid: pupil samples across, without clipping by apertures. Failed rays are left out.
      at_m: metres from the entrance pupil to the object plane, or several that share the image
        plane; inf for parallel light.
    Gradient: through the rays to every lens tensor and to at_m. Raises: DomainError when no ray of
      a field arrives, none converges, or a distance lies inside the lens.

    Example:
    >>> from codesign import lens
    >>> geo = lens.load("cooke-triplet")
    >>> sharp = lens.design.focus_rays(geo, (0.0, 0.2), at_m=(0.5, 2.0))
    >>> before, after = (lens.rms_spot_mm(g, (0.0, 0.2), at_m=(0.5, 2.0)).square().mean() for g in (geo, sharp))
    >>> bool(after < before)
    True
    """
    if len(wavelengths_um) == 0:
        raise DomainError(f"{lens.name}: no wavelength was given; give at least one, in um.")
    pupil = pupil_grid(grid, lens.dtype, lens.curvature_per_mm.device)
    source = source_rays(lens, fields_rad, pupil, at_m)
    found = []
    for wavelength in wavelengths_um:
        rays = trace_source(lens, source, wavelength)
        slope = rays.direction[..., :2] / rays.direction[..., 2:]
        columns = (rays.position_mm, slope, rays.weight[..., None])
        found.append([v.reshape(-1, pupil.shape[0], v.shape[-1]) for v in columns])
    position, slope, weight = (torch.cat(columns, 1) for columns in zip(*found, strict=True))
    total = weight.sum(1, keepdim=True)
    if bool((total == 0).any()):
        raise DomainError(
            f"{lens.name}: no ray of some field arrives, so it has no best focus; use smaller fields or "
            "weaker curvatures."
        )
    shift, sharpness = least_spot_shift(position, slope, weight)
    if not float(sharpness.detach()) >= 1e-16:
        raise DomainError(
            f"{lens.name}: {pupil.shape[0]} rays of a pupil of {grid} samples across do not converge: they are "
            "too few or leave parallel, so no image plane is better than another; give at least 2 samples, or "
            "another lens."
        )
    return _last_thickness(lens, lens.thickness_mm[-1] + shift)


def _last_thickness(lens: L, value: Tensor) -> L:
    return lens.replace(thickness_mm=torch.cat([lens.thickness_mm[:-1], value.reshape(1)]))
