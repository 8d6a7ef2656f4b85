"""Solves: the focal length held by a curvature, focus held by the last thickness. Closed forms,
differentiable."""

import torch

from codesign.errors import DomainError
from codesign.lens.analysis import field_rays, pupil_grid
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM
from codesign.lens.paraxial import bending, yu_trace

FLAT = 1e-12  # per mm; a curvature below this is a plane
NO_POWER = 1e-9  # index step, or ray height in mm, below which a curvature cannot bend the ray


def holding_surface(lens):
    """Index of the surface whose curvature holds the focal length: the last that bends light and is not the
    face of a plane-parallel plate.

    A stop in air and a cover glass behind the lens are passed over; the plane side of a plano-convex lens is
    not. When all are plane
    (a design from scratch) it is the last that bends light. It goes by today's curvatures: where those of a
    cover glass vary, name the
    surface instead. Raises: DomainError when none does.
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
            j for j, n in ((i - 1, index[i]), (i + 1, index[i + 1])) if 0 <= j < len(curved) and n > 1 + 1e-3
        ]
        return curved[i] or any(curved[j] for j in neighbours)

    return next((i for i in reversed(bends) if has_shape(i)), bends[-1])


def hold_efl(lens, efl_mm, surface=None):
    """The lens with one curvature solved so that the focal length is ``efl_mm`` exactly.

    Args: efl_mm: not 0, at the d line. surface: index of the curvature to solve; ``holding_surface(lens)``
      when left out.
    Gradient: the solved curvature carries that of all others, of thicknesses and of indices; efl_mm too when
      it is a tensor.
    Raises: DomainError when that curvature cannot do it.
    Source: the y-u trace solved for one refraction, n'u' = n u - y phi, with the surfaces behind it as a
      linear map
      of (y, n'u') (Smith, Modern Optical Engineering, ch. 2).
    """
    c = lens.curvature_per_mm
    t = lens.thickness_mm
    n = lens.index()
    power = lens.surface_power()
    at = holding_surface(lens) if surface is None else range(c.numel())[surface]
    count = c.numel()
    one = torch.ones_like(c[0])
    zero = torch.zeros_like(c[0])
    heights, angles = yu_trace(power, t, n, one, zero, last=at)
    y, nu = (heights[-1] + t[at - 1] * angles[-1] / n[at], angles[-1]) if heights else (one, zero)
    # the last angle = by_height * y + by_angle * nu'
    by_height = zero
    by_angle = one
    if at < count - 1:
        by_height = yu_trace(power, t, n, one, zero, first=at + 1)[1][-1]
        by_angle = yu_trace(power, t, n, t[at] / n[at + 1], one, first=at + 1)[1][-1]
    step = bending(n, lens.mirrors)[at]
    weak = [float(v.detach()) for v in (step, y, by_angle)]
    if min(map(abs, weak)) < NO_POWER:
        raise DomainError(
            f"{lens.name}: surface {at + 1} cannot hold the focal length (index step {weak[0]:.3g}, ray "
            f"height {weak[1]:.3g}, lever {weak[2]:.3g}); name a refracting one away from an image."
        )
    wanted = (-n[-1] / efl_mm - by_height * y) / by_angle
    solved = c[at] + ((nu - wanted) / y - power[at]) / step
    return lens.replace(curvature_per_mm=torch.cat([c[:at], solved.reshape(1), c[at + 1 :]]))


def focus_paraxial(lens, wavelength_um=WAVELENGTH_UM["d"], defocus_mm=0.0):
    """The lens with its image plane at the paraxial focus, or ``defocus_mm`` (number or scalar tensor) behind
    it. Differentiable.

    Raises: DomainError for an afocal lens. A focus inside the lens gives a negative last thickness, which
      constraints must push back.
    """
    return _last_thickness(lens, lens.first_order(wavelength_um).bfl_mm + defocus_mm)


def focus_rays(lens, fields_rad, wavelengths_um=(WAVELENGTH_UM["d"],), grid=16):
    """The lens with its image plane where the mean square spot over fields and wavelengths is least.

    Straight rays make the squared spot a parabola in z: with d the distance of a ray from its spot's mean and
      s the same of its slope,
    the least of sum |d + z s|^2 lies at z = -sum(d.s) / sum(s.s). Spots of one field share their mean over
    the wavelengths.

    Args: fields_rad: angles; wavelengths_um; grid: pupil samples across, without clipping by apertures.
      Failed rays are left out.
    Gradient: through the rays to every lens tensor. Raises: DomainError when no ray of a field arrives or
      none converges.
    """
    pupil = pupil_grid(grid, lens.dtype, lens.curvature_per_mm.device)
    found = []
    for wavelength in wavelengths_um:
        rays = [field_rays(lens, float(f), pupil) for f in fields_rad]
        out = lens.trace(torch.cat([o for o, _ in rays]), torch.cat([d for _, d in rays]), wavelength)
        found.append(
            [
                v.reshape(len(rays), pupil.shape[0], -1)
                for v in (
                    out.position_mm[:, :2],
                    out.direction[:, :2] / out.direction[:, 2:],
                    (out.status == 0).to(lens.dtype),
                )
            ]
        )
    position, slope, weight = (torch.cat(columns, 1) for columns in zip(*found, strict=True))
    total = weight.sum(1, keepdim=True)
    if bool((total == 0).any()):
        raise DomainError(
            f"{lens.name}: no ray of some field arrives, so it has no best focus; use smaller fields or "
            "weaker curvatures."
        )
    position, slope = (
        (v - (v * weight).sum(1, keepdim=True) / total) * (weight / total.sqrt()) for v in (position, slope)
    )
    curvature = slope.square().sum()
    if float(curvature.detach()) < 1e-16:
        raise DomainError(f"{lens.name}: its rays leave parallel, so no image plane is better than another.")
    return _last_thickness(lens, lens.thickness_mm[-1] - (position * slope).sum() / curvature)


def _last_thickness(lens: GeoLens, value):
    return lens.replace(thickness_mm=torch.cat([lens.thickness_mm[:-1], value.reshape(1)]))
