"""First-order optics by the y-u trace, differentiable. Surfaces enter by their power, so the r^2
asphere term, mirrors and diffraction count."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.glass import D_UM


@dataclass(frozen=True)
class FirstOrder:
    """Paraxial figures of a lens with the object at infinity; scalar tensors in millimetres, light
    along +z.

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


class ParaxialLens(Protocol):
    """A lens of surfaces with powers, gaps and indices; GeoLens is one."""

    name: str
    thickness_mm: Tensor

    def index(self, wavelength_um: float = D_UM) -> Tensor: ...

    def surface_power(self, wavelength_um: float = D_UM) -> Tensor: ...

    def first_order(self, wavelength_um: float = D_UM) -> FirstOrder: ...


def bending(index: Tensor, mirrors: Sequence[bool]) -> Tensor:
    """Change of surface power per vertex curvature, [S]: n' - n where light passes, -2 n where it
    is reflected (unfolded axis).

    Args: index [S + 1]; mirrors: S booleans.
    """
    if not any(mirrors):
        return index[1:] - index[:-1]
    return torch.where(
        torch.tensor(mirrors, device=index.device), -2 * index[:-1], index[1:] - index[:-1]
    )


def yu_trace(
    power: Any,
    thickness_mm: Any,
    index: Any,
    y: Any,
    nu: Any,
    first: int = 0,
    last: int | None = None,
) -> tuple[list[Any], list[Any]]:
    """Paraxial height and reduced angle (n u) just after each surface from ``first`` to before
    ``last``.

    Args: power [S] per mm, thickness_mm [S], index [S + 1]; y at surface ``first`` and nu before
      it. Tensors, or plain numbers and lists of them.
    Returns: lists of y and nu per surface.
    """
    last = len(power) if last is None else last
    heights = []
    angles = []
    for i in range(first, last):
        nu = nu - y * power[i]
        heights.append(y)
        angles.append(nu)
        y = y + thickness_mm[i] * nu / index[i + 1]
    return heights, angles


def first_order(
    power: Tensor,
    thickness_mm: Tensor,
    index: Tensor,
    stop: int,
    entrance_pupil_diameter_mm: float | Tensor,
) -> FirstOrder:
    """First-order figures. Gradient: to every tensor. Raises: DomainError for an afocal lens,
    numbers that are not finite, or a stop that no ray images.

    Source: Smith, Modern Optical Engineering, ch. 2 and 9.
    """
    one = torch.ones_like(power[0])
    zero = torch.zeros_like(power[0])
    heights, angles = yu_trace(power, thickness_mm, index, one, zero)
    total = -angles[-1]
    if not math.isfinite(float(total.detach())):
        raise DomainError(
            "the lens has no finite power: a curvature, thickness or index is NaN or infinite; correct it."
        )
    if abs(float(total.detach())) < 1e-12:
        raise DomainError(
            "the lens is afocal (its power is zero), so it has no focal length; change a curvature."
        )
    efl = index[-1] / total
    bfl = index[-1] * heights[-1] / total
    # from the stop centre backwards to the object side: y and nu at the stop, undone surface by
    # surface
    y = zero
    nu = one
    for i in range(stop - 1, -1, -1):
        y = y - thickness_mm[i] * nu / index[i + 1]
        nu = nu + y * power[i]
    entrance_z = -y * index[0] / nu
    # magnification of a pupil: reduced angle at the stop over reduced angle outside
    diameter = torch.as_tensor(entrance_pupil_diameter_mm, dtype=one.dtype, device=one.device) * one
    semi_stop = diameter / 2 * nu.abs()
    heights, angles = yu_trace(power, thickness_mm, index, zero, one, first=stop)
    y = heights[-1]
    nu = angles[-1]
    exit_z = -y * index[-1] / nu
    exit_diameter = 2 * semi_stop / nu.abs()
    return FirstOrder(
        efl, bfl, efl / diameter, entrance_z, diameter, exit_z, exit_diameter, semi_stop
    )


def system_matrix(lens: ParaxialLens, wavelength_um: float = D_UM) -> Tensor:
    """Matrix [[A, B], [C, D]] from the plane of the first vertex to that of the last, for columns
    (y in mm, n u). Its determinant is 1.

    C is minus the power per mm. Gradient: to every lens tensor that bends or moves light. Source:
    Gerrard and Burch, Matrix Methods in Optics, ch. 2.
    """
    power = lens.surface_power(wavelength_um)
    thickness_mm = lens.thickness_mm
    index = lens.index(wavelength_um)
    one = torch.ones_like(power[0])
    zero = torch.zeros_like(power[0])
    columns = [
        (heights[-1], angles[-1])
        for heights, angles in (
            yu_trace(power, thickness_mm, index, *start) for start in ((one, zero), (zero, one))
        )
    ]
    return torch.stack([torch.stack([column[i] for column in columns]) for i in (0, 1)])


@dataclass(frozen=True)
class CardinalPoints:
    """Positions on the axis, scalar tensors in mm: those of object space from the first vertex,
    those of image space from the last vertex, positive along +z."""

    front_focal_z_mm: Tensor
    front_principal_z_mm: Tensor
    front_nodal_z_mm: Tensor
    rear_focal_z_mm: Tensor
    rear_principal_z_mm: Tensor
    rear_nodal_z_mm: Tensor
    front_focal_length_mm: Tensor
    rear_focal_length_mm: Tensor


def cardinal_points(lens: ParaxialLens, wavelength_um: float = D_UM) -> CardinalPoints:
    """CardinalPoints of a lens. Focal lengths are n / power and n' / power, both positive for a
    converging lens.

    Gradient: to every lens tensor that bends or moves light. Raises: DomainError for an afocal
      lens. Source: Gerrard and Burch, ch. 2.
    """
    (A, _), (C, D) = system_matrix(lens, wavelength_um)
    index = lens.index(wavelength_um)
    if abs(float(C.detach())) < 1e-12:
        raise DomainError(
            f"{lens.name}: the lens is afocal (its power is zero), so it has no cardinal points; change a "
            "curvature."
        )
    front = -index[0] / C
    rear = -index[-1] / C
    shift = rear - front  # from a principal point to the nodal point of the same space
    return CardinalPoints(
        -front * D,
        front * (1 - D),
        front * (1 - D) + shift,
        rear * A,
        rear * (A - 1),
        rear * (A - 1) + shift,
        front,
        rear,
    )


@dataclass(frozen=True)
class ParaxialRays:
    """The marginal ray (from the axial object point to the rim of the pupil) and the chief ray
    (from the rim of the field through the centre of the stop).

    marginal_height_mm, chief_height_mm: [S] on each surface. marginal_angle, chief_angle: [S + 1]
      slopes before the first surface and behind each surface. invariant_mm: scalar n (chief slope x
      marginal height - marginal slope x chief height), the same everywhere.
    """

    marginal_height_mm: Tensor
    marginal_angle: Tensor
    chief_height_mm: Tensor
    chief_angle: Tensor
    invariant_mm: Tensor


def paraxial_rays(
    lens: ParaxialLens,
    field_rad: float | Tensor,
    wavelength_um: float = D_UM,
    vergence_per_mm: float | Tensor = 0.0,
) -> ParaxialRays:
    """ParaxialRays of an object plane.

    Args:
      field_rad: half field, whose tangent is the slope of the d line's chief ray in object space; a
        number or scalar tensor, below 90 degrees.
      vergence_per_mm: 1 / distance of the object from the entrance pupil of the d line, a number or
        scalar tensor (see ``distance.vergence_per_mm``); 0 is parallel light. The diameter of the
        entrance pupil is the lens's at every distance.
    Gradient: to every lens tensor that bends or moves light, and to the vergence. Raises:
      DomainError for a field of 90 degrees and more, or an entrance pupil at infinity.
    """
    field = field_angles(lens, field_rad)
    f = lens.first_order(wavelength_um)
    if not math.isfinite(float(f.entrance_pupil_z_mm.detach())):
        raise DomainError(
            f"{lens.name}: the entrance pupil lies at infinity, so no chief ray comes from an object at "
            "infinity; move the stop."
        )
    power = lens.surface_power(wavelength_um)
    thickness_mm = lens.thickness_mm
    index = lens.index(wavelength_um)
    vergence = torch.as_tensor(vergence_per_mm, dtype=power.dtype, device=power.device)
    # colours have pupils of their own, and one object plane
    d_line = f if wavelength_um == D_UM else lens.first_order()
    shift = f.entrance_pupil_z_mm - d_line.entrance_pupil_z_mm
    slope = field.tan().to(power) / (1 + vergence * shift)
    spread = vergence / (1 + vergence * shift) * (f.entrance_pupil_diameter_mm / 2)
    starts = (
        (f.entrance_pupil_diameter_mm / 2 - spread * f.entrance_pupil_z_mm, spread * index[0]),
        (-slope * f.entrance_pupil_z_mm, slope * index[0]),
    )
    (y, nu), (y_bar, nu_bar) = (
        tuple(map(torch.stack, yu_trace(power, thickness_mm, index, *start))) for start in starts
    )
    angles = torch.cat([starts[0][1].reshape(1), nu]) / index
    chief_angles = torch.cat([starts[1][1].reshape(1), nu_bar]) / index
    return ParaxialRays(
        y, angles, y_bar, chief_angles, slope * index[0] * (f.entrance_pupil_diameter_mm / 2)
    )


def field_angles(lens: ParaxialLens, fields_rad: float | Sequence[float] | Tensor) -> Tensor:
    """The angles as float64. Raises: DomainError for 90 degrees and more, as of degrees given for
    radians."""
    fields = torch.as_tensor(fields_rad, dtype=torch.float64)
    beyond = fields.detach()[~(fields.detach().abs() < math.pi / 2)]
    if beyond.numel():
        raise DomainError(
            f"{lens.name}: light at {math.degrees(float(beyond[0])):.4g} degrees does not enter from the "
            "front; give fields in radians, below 90 degrees."
        )
    return fields


def focused_image(
    lens: ParaxialLens, vergence_per_mm: float | Tensor = 0.0, wavelength_um: float = D_UM
) -> tuple[Tensor, Tensor]:
    """Height and reduced angle (n u) behind the last vertex of the ray of an axial point that
    crosses the first vertex plane at height 1, so that its image lies -height n / angle behind the
    last vertex.

    Args:
      vergence_per_mm: 1 / distance of the point from the entrance pupil of the d line, scalar or
        [D].
    Returns: two tensors of the shape of the vergence. Gradient: to it, and to every lens tensor
      that bends or moves light.
    """
    power = lens.surface_power(wavelength_um)
    index = lens.index(wavelength_um)
    vergence = torch.as_tensor(vergence_per_mm, dtype=power.dtype, device=power.device)
    # seen from the first vertex
    vergence = vergence / (1 - vergence * lens.first_order().entrance_pupil_z_mm)
    heights, angles = yu_trace(
        power, lens.thickness_mm, index, torch.ones_like(vergence), index[0] * vergence
    )
    return heights[-1], angles[-1]


def image_place_mm(
    lens: ParaxialLens, vergence_per_mm: float | Tensor = 0.0, wavelength_um: float = D_UM
) -> Tensor:
    """Distance from the last vertex to the paraxial image of an axial point, mm: the back focal
    length for parallel light. Negative where the image lies in the lens or is virtual, infinite
    where the light leaves parallel. Shape of the vergence; gradient as for ``focused_image``."""
    height, angle = focused_image(lens, vergence_per_mm, wavelength_um)
    return -height * lens.index(wavelength_um)[-1] / angle


def image_scale_mm(
    lens: ParaxialLens, vergence_per_mm: float | Tensor = 0.0, wavelength_um: float = D_UM
) -> Tensor:
    """Height of the paraxial image per tangent of the field, mm: the focal length for parallel
    light, and magnification x distance otherwise. Shape of the vergence; gradient as for
    ``focused_image``."""
    pupil_z = lens.first_order().entrance_pupil_z_mm
    _, angle = focused_image(lens, vergence_per_mm, wavelength_um)
    # Lagrange's invariant of the chief ray and of this one, whose height at the pupil is 1 / (1 -
    # vergence z)
    return -lens.index(wavelength_um)[0] / ((1 - vergence_per_mm * pupil_z) * angle)


def chief_scale_mm(lens: ParaxialLens, wavelength_um: float = D_UM) -> Tensor:
    """Height on the image plane, wherever it stands, per tangent of the field, of the paraxial ray
    through the centre of the d line's entrance pupil, scalar mm; that of ``image_scale_mm`` where
    the plane is in focus. Gradient: to every lens tensor that bends or moves light."""
    index = lens.index(wavelength_um)
    heights, angles = yu_trace(
        lens.surface_power(wavelength_um),
        lens.thickness_mm,
        index,
        -lens.first_order().entrance_pupil_z_mm,
        index[0],
    )
    return heights[-1] + lens.thickness_mm[-1] * angles[-1] / index[-1]
