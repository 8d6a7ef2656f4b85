"""First-order optics by the y-u trace, differentiable. Surfaces enter by their power, so the r^2 asphere term, mirrors and diffraction count."""

from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.errors import DomainError


@dataclass(frozen=True)
class FirstOrder:
    """Paraxial figures of a lens with the object at infinity; scalar tensors in millimetres, light along +z.

    efl_mm, bfl_mm: effective and back focal length. fno: efl / entrance pupil diameter.
    entrance_pupil_z_mm: from the first vertex. exit_pupil_z_mm: from the last vertex.
    stop_semi_aperture_mm: radius of the stop that gives the entrance pupil.
    """

    efl_mm: Tensor
    bfl_mm: Tensor
    fno: Tensor
    entrance_pupil_z_mm: Tensor
    entrance_pupil_diameter_mm: Tensor
    exit_pupil_z_mm: Tensor
    exit_pupil_diameter_mm: Tensor
    stop_semi_aperture_mm: Tensor


def bending(index, mirrors):
    """Change of surface power per vertex curvature, [S]: n' - n where light passes, -2 n where it is reflected (unfolded axis).

    Args: index [S + 1]; mirrors: S booleans.
    """
    if not any(mirrors):
        return index[1:] - index[:-1]
    return torch.where(torch.tensor(mirrors, device=index.device), -2 * index[:-1], index[1:] - index[:-1])


def yu_trace(power, thickness_mm, index, y, nu, first=0, last=None):
    """Paraxial height and reduced angle (n u) just after each surface from ``first`` to before ``last``.

    Args: power [S] per mm, thickness_mm [S], index [S + 1]; y at surface ``first`` and nu before it.
    Returns: lists of y and nu per surface.
    """
    last = power.numel() if last is None else last
    heights, angles = [], []
    for i in range(first, last):
        nu = nu - y * power[i]
        heights.append(y)
        angles.append(nu)
        y = y + thickness_mm[i] * nu / index[i + 1]
    return heights, angles


def first_order(power, thickness_mm, index, stop, entrance_pupil_diameter_mm):
    """First-order figures. Gradient: to every tensor. Raises: DomainError for an afocal lens or a stop that no ray images.

    Source: Smith, Modern Optical Engineering, ch. 2 and 9.
    """
    one, zero = torch.ones_like(power[0]), torch.zeros_like(power[0])
    heights, angles = yu_trace(power, thickness_mm, index, one, zero)
    total = -angles[-1]
    if abs(float(total.detach())) < 1e-12:
        raise DomainError("the lens is afocal (its power is zero), so it has no focal length; change a curvature.")
    efl, bfl = index[-1] / total, index[-1] * heights[-1] / total
    # from the stop centre backwards to the object side: y and nu at the stop, undone surface by surface
    y, nu = zero, one
    for i in range(stop - 1, -1, -1):
        y = y - thickness_mm[i] * nu / index[i + 1]
        nu = nu + y * power[i]
    entrance_z = -y * index[0] / nu
    semi_stop = entrance_pupil_diameter_mm / 2 * nu.abs()  # magnification of a pupil: reduced angle at the stop over reduced angle outside
    heights, angles = yu_trace(power, thickness_mm, index, zero, one, first=stop)
    y, nu = heights[-1], angles[-1]
    exit_z, exit_diameter = -y * index[-1] / nu, 2 * semi_stop / nu.abs()
    diameter = torch.as_tensor(entrance_pupil_diameter_mm, dtype=one.dtype, device=one.device) * one
    return FirstOrder(efl, bfl, efl / diameter, entrance_z, diameter, exit_z, exit_diameter, semi_stop)
