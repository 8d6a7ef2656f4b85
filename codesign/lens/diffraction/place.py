"""Where a phase plate stands in a lens, and how finely light has to be sampled to see it."""

import math

import torch
from torch import Tensor

from codesign.checks import check_number
from codesign.errors import DomainError
from codesign.lens import paraxial
from codesign.lens.analysis.rays import source_rays
from codesign.lens.diffraction.plates import Plate
from codesign.lens.geolens import GeoLens
from codesign.lens.surface import sag_mm
from codesign.lens.trace import to_plate

HEIGHTS = 65  # at which the room between surfaces is looked at
ACROSS = 129  # points of the plate at which its steepest phase is looked for
LARGEST_STEP_WAVES = 0.5  # of the plate alone, between neighbouring cells of a pupil


def with_plate(
    lens: GeoLens,
    plate: Plate | None,
    surface: int | None = None,
    z_mm: float = 0.0,
) -> GeoLens:
    """A lens with a phase plate in its stop or behind its last surface.

    >>> from codesign import lens
    >>> from codesign.lens import diffraction
    >>> geo = lens.load("double-gauss")  # its stop is a plane in air
    >>> plate = diffraction.ZernikePlate({11: 0.0}, radius_mm=11.0)
    >>> plated = diffraction.with_plate(geo, plate)
    >>> optimiser = torch.optim.Adam([*plate.parameters(), *geo.variables("focus")], lr=0.1)

    Args:
      plate: None takes the lens's plate out.
      surface: from 0; None is the stop, -1 the last surface.
      z_mm: distance of the plate's plane from that surface's vertex, negative before the stop.
    Returns: a lens as from ``replace``, which shares tensors and plate (a converted one has a plate
      of its own); everything that traces rays sees the plate. First-order figures and Seidel sums
      are those of the lens alone.
    Raises: DomainError for another surface, in glass, or where the plane meets a surface.
    """
    twin = lens.replace()
    twin.plate = plate
    twin.borrows = False
    if plate is None:
        return twin
    check_number(z_mm, f"{lens.name}: distance of a plate, mm,")
    last = len(lens.surfaces) - 1
    at = lens.stop_index if surface is None else surface
    at = last if at == -1 else at
    if at not in (lens.stop_index, last) or (z_mm < 0 and at != lens.stop_index):
        raise DomainError(
            f"{lens.name}: a plate {z_mm:g} mm from surface {at + 1} is not modelled; put it next to the "
            f"stop (surface {lens.stop_index + 1}) or behind the last surface ({last + 1})."
        )
    gap = at if z_mm >= 0 else at - 1
    room = lens.thickness_mm.detach()
    after = z_mm if z_mm >= 0 or gap < 0 else float(room[gap]) + z_mm
    if gap >= 0 and bool(lens.glass[gap]):
        raise DomainError(
            f"{lens.name}: the gap behind surface {gap + 1} is glass; put the plate on the other side of "
            f"surface {at + 1}."
        )
    low = -math.inf if gap < 0 else _reach(lens, gap, -1 if lens.mirrors[gap] else 1)
    high = float(room[gap]) if gap >= 0 else 0.0
    high = high - _reach(lens, gap + 1, -1) if gap < last else high
    if not low <= after <= high:
        raise DomainError(
            f"{lens.name}: a plate {after:.4g} mm behind "
            f"{f'surface {gap + 1}' if gap >= 0 else 'the first vertex'} meets a surface or the film; "
            f"between {low:.4g} and {high:.4g} mm there is room."
        )
    twin.plate_at = (gap, after)
    return twin


def cells_for_plate(lens: GeoLens, wavelength_um: float) -> int:
    """Cells across the pupil that a lens's plate asks for, so that its phase steps by at most half
    a wave from cell to cell and no detail of it falls between them; 0 without a plate. No gradient.

    The beam is that of the axis in parallel light, by its paraxial marginal ray.
    """
    plate = lens.plate
    if plate is None:
        return 0
    gap, after = lens.plate_at
    index = lens.index(wavelength_um)
    with torch.no_grad():
        radius = torch.as_tensor(
            lens.entrance_pupil_diameter_mm / 2, dtype=lens.dtype, device=index.device
        )
        if gap >= 0:
            heights, angles = paraxial.yu_trace(
                lens.surface_power(wavelength_um), lens.thickness_mm, index, radius, 0 * radius
            )
            radius = (heights[gap] + after * angles[gap] / index[gap + 1]).abs()
        line = torch.linspace(-1, 1, ACROSS, dtype=lens.dtype, device=index.device) * radius
        points = torch.stack(torch.meshgrid(line, line, indexing="xy"), -1).reshape(-1, 2)
        _, slope, reaches = plate.look(points[points.square().sum(1) <= radius.square()])
        steepest = (
            float((slope.norm(dim=1) * reaches).max())
            * plate.mm_per_rad(wavelength_um)
            / (wavelength_um * 1e-3)
        )
    return math.ceil(2 * float(radius) * max(steepest / LARGEST_STEP_WAVES, 1 / plate.finest_mm))


def plate_waves(
    lens: GeoLens, field_rad: float, pupil: Tensor, wavelength_um: float, at_m: float | Tensor
) -> tuple[Tensor, Tensor]:
    """What a lens's plate adds to the light of an object point: optical path in waves where the
    rays of the bare lens meet it, [M] for pupil points [M, 2], and whether it reaches there, [M]
    bool.

    This is a thin element in the field of the lens, for plates of any slope and place; turned rays
    agree with it to second order of the angle. Gradient: to the plate, the lens and at_m.
    """
    p = lens.prescription(wavelength_um)
    placed = p.plate
    if placed is None:
        raise DomainError(
            f"{lens.name} has no phase plate; give it one with diffraction.with_plate."
        )
    source = source_rays(lens, field_rad, pupil, at_m)
    rays = to_plate(p, placed, source.origin_mm, source.direction)
    phase, _, reaches = placed.look(rays.position_mm[:, :2])
    return phase * (placed.mm_per_rad / (wavelength_um * 1e-3)), reaches


def _reach(lens, surface, sign):
    """How far a surface bulges towards +z (sign 1) or -z (-1) within its aperture, mm."""
    height = torch.linspace(0, 1, HEIGHTS, dtype=lens.dtype) * float(lens.semi_aperture_mm[surface])
    with torch.no_grad():
        sag = sag_mm(
            height, lens.curvature_per_mm[surface], lens.conic[surface], lens.asphere[surface]
        )
    return float((sign * sag).max())
