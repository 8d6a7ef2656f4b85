"""First-order optics by the y-u trace, differentiable, with the r^2 asphere term counted as curvature."""

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


def powers_curvature(curvature_per_mm, asphere):
    """Vertex curvature [S] including the r^2 coefficient: c + 2 a_1."""
    return curvature_per_mm + 2 * asphere[:, 0] if asphere.shape[1] else curvature_per_mm


def yu_trace(curvature_per_mm, thickness_mm, index, y, nu, first=0, last=None):
    """Paraxial height and reduced angle (n u) just after each refraction from surface ``first`` to before ``last``.

    Args: curvature_per_mm [S] (vertex), thickness_mm [S], index [S + 1]; y at surface ``first`` and nu before it.
    Returns: lists of y and nu per surface.
    """
    last = curvature_per_mm.numel() if last is None else last
    heights, angles = [], []
    for i in range(first, last):
        nu = nu - y * curvature_per_mm[i] * (index[i + 1] - index[i])
        heights.append(y)
        angles.append(nu)
        y = y + thickness_mm[i] * nu / index[i + 1]
    return heights, angles


def first_order(curvature_per_mm, thickness_mm, index, stop, entrance_pupil_diameter_mm):
    """First-order figures. Gradient: to every tensor. Raises: DomainError for an afocal lens or a stop that no ray images.

    Source: Smith, Modern Optical Engineering, ch. 2 and 9.
    """
    one, zero = torch.ones_like(curvature_per_mm[0]), torch.zeros_like(curvature_per_mm[0])
    heights, angles = yu_trace(curvature_per_mm, thickness_mm, index, one, zero)
    power = -angles[-1]
    if abs(float(power.detach())) < 1e-12:
        raise DomainError("the lens is afocal (its power is zero), so it has no focal length; change a curvature.")
    efl, bfl = index[-1] / power, index[-1] * heights[-1] / power
    # from the stop centre backwards to the object side: y and nu at the stop, undone surface by surface
    y, nu = zero, one
    for i in range(stop - 1, -1, -1):
        y = y - thickness_mm[i] * nu / index[i + 1]
        nu = nu + y * curvature_per_mm[i] * (index[i + 1] - index[i])
    entrance_z = -y * index[0] / nu
    semi_stop = entrance_pupil_diameter_mm / 2 * nu.abs()  # magnification of a pupil: reduced angle at the stop over reduced angle outside
    heights, angles = yu_trace(curvature_per_mm, thickness_mm, index, zero, one, first=stop)
    y, nu = heights[-1], angles[-1]
    exit_z, exit_diameter = -y * index[-1] / nu, 2 * semi_stop / nu.abs()
    diameter = torch.as_tensor(entrance_pupil_diameter_mm, dtype=one.dtype, device=one.device) * one
    return FirstOrder(efl, bfl, efl / diameter, entrance_z, diameter, exit_z, exit_diameter, semi_stop)
