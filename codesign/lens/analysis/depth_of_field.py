"""Depth of field: which object distances a fixed film shows with a blur below a limit.

The blur of an axial point is the disc that its light fills on the film. Its diameter is linear in the
vergence 1 / distance (from the entrance pupil), so both limits are closed forms; for a thin lens it is the
circle of confusion. Traced limits hold the RMS spot instead, diameter / (2 sqrt 2) of an evenly filled disc,
aberrations included.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError
from codesign.lens.analysis.spots import rms_spot_mm
from codesign.lens.distance import real_numbers
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM
from codesign.lens.paraxial import yu_trace

RMS_OF_DISC = 1 / (2 * math.sqrt(2))  # RMS radius of an evenly filled disc over its diameter
SAMPLES = 33  # vergences of one trace
ROUNDS = 5  # of traces, each looking into one step of the one before
CLOSEST_PER_MM = 1e3  # to a pupil that has no surface before it


@dataclass(frozen=True)
class DepthOfField:
    """Metres from the entrance pupil of the d line, scalar tensors: the nearest and the farthest distance
    within the limit (inf where parallel light is), and the sharpest."""

    near_m: Tensor
    far_m: Tensor
    focus_m: Tensor


def depth_of_field(
    lens: GeoLens,
    blur_mm: float | Tensor,
    focus_m: float | Tensor | None = None,
    wavelength_um: float = WAVELENGTH_UM["d"],
) -> DepthOfField:
    """DepthOfField where the paraxial blur disc of an axial point is at most ``blur_mm`` across.

    Args: blur_mm: diameter on the film, > 0. focus_m: distance to focus on first (``GeoLens.focus_at``), None
      leaves the film where it is. A near limit before the lens is its first vertex.
    Gradient: to every lens tensor that bends or moves light, to the blur and to focus_m.
    Raises: DomainError for a limit that is not positive, and when nothing before the lens is that sharp.

    Example:
    >>> from codesign import lens
    >>> found = lens.analysis.depth_of_field(lens.load("cooke-triplet"), 0.02, focus_m=2.0)
    >>> round(found.near_m.item(), 2), round(found.far_m.item(), 2)
    (1.86, 2.17)
    """
    lens = lens if focus_m is None else lens.focus_at(focus_m, wavelength_um)
    (at_parallel, _), (per_vergence, _) = _film_heights(lens, wavelength_um)
    sharpest = -at_parallel / per_vergence
    reach = _checked(lens, blur_mm) / (
        lens.first_order(wavelength_um).entrance_pupil_diameter_mm * per_vergence.abs()
    )
    nearest = _nearest(lens)
    if not float((sharpest + reach).detach()) > 0 or not float((sharpest - reach).detach()) < 1 / max(
        nearest, 1e-300
    ):
        raise DomainError(
            f"{lens.name}: no point before the lens has a blur of {float(blur_mm):.4g} mm or less on its "
            "film; move "
            "the film (focus_at), or allow more blur."
        )
    near = (1e-3 / (sharpest + reach)).clamp_min(nearest * 1e-3)
    return DepthOfField(near, _metres(sharpest - reach), _metres(sharpest))


def hyperfocal_m(lens: GeoLens, blur_mm: float | Tensor, wavelength_um: float = WAVELENGTH_UM["d"]) -> Tensor:
    """The nearest distance to focus on (metres from the entrance pupil) for which parallel light is blurred
    to a disc of ``blur_mm`` and no more, scalar: f^2 / (N blur) + f for a thin lens.

    Gradient: as for ``depth_of_field``. Raises: DomainError for a limit that is not positive, or a diverging
      lens.
    """
    blur = _checked(lens, blur_mm)
    f = lens.first_order(wavelength_um)
    (_, parallel), (_, from_centre) = _film_heights(lens, wavelength_um)
    if not float(parallel.detach()) < 0:
        raise DomainError(
            f"{lens.name}: a lens that diverges has no hyperfocal distance; change a curvature."
        )
    index = lens.index(wavelength_um)[0]
    return -1e-3 * (f.entrance_pupil_diameter_mm * index + blur * from_centre) / (blur * parallel)


@torch.no_grad()
def traced_depth_of_field(
    lens: GeoLens,
    blur_mm: float,
    focus_m: float | None = None,
    fields_rad: Sequence[float] = (0.0,),
    wavelength_um: float = WAVELENGTH_UM["d"],
    grid: int = 16,
) -> DepthOfField:
    """DepthOfField where the RMS spot over the fields is at most that of an even disc ``blur_mm`` across.

    Aberrations share the blur: this range is the smaller the more of the limit they take. Args as for
    ``depth_of_field``; fields_rad: angles whose mean square counts. Gradient: none (limits are searched, to
    1e-6).
    Raises: DomainError for a limit that is not positive, and when aberrations alone exceed it.
    """
    if torch.as_tensor(fields_rad).ndim != 1:
        raise ShapeError(f"fields_rad must be a list of angles in radians, got {fields_rad}.")
    lens = lens if focus_m is None else lens.focus_at(focus_m, wavelength_um)
    limit = float(_checked(lens, blur_mm)) * RMS_OF_DISC
    (at_parallel, _), (per_vergence, _) = _film_heights(lens, wavelength_um)
    sharpest = float(-at_parallel / per_vergence)
    width = 3 * float(blur_mm) / float(lens.first_order().entrance_pupil_diameter_mm * per_vergence.abs())
    nearest = _nearest(lens)
    top = 0.999 / nearest if nearest else CLOSEST_PER_MM
    centre = min(max(sharpest, 0.0), top)

    def rms(vergences):
        spots = rms_spot_mm(lens, fields_rad, wavelength_um, grid, 1e-3 / vergences)
        return spots.square().mean(1).sqrt()

    def line(low, high):
        return torch.linspace(low, high, 8 * SAMPLES, dtype=lens.dtype, device=lens.thickness_mm.device)

    while True:  # aberrations, or a plate, may move the sharpest place far from the paraxial one
        low, high = max(0.0, centre - width), min(top, centre + width)
        at = line(low, high)
        found = rms(at)
        best = int(found.argmin())
        ends_low = low == 0 or (best > 0 and float(found[0]) > limit)
        ends_high = high == top or (best < len(at) - 1 and float(found[-1]) > limit)
        if ends_low and ends_high:
            break
        width *= 2
    least = at[max(best - 1, 0) : best + 2]
    for _ in range(ROUNDS):  # the range within the limit may be narrower than a step
        least = line(float(least[0]), float(least[-1]))
        k = int(rms(least).argmin())
        least = least[max(k - 1, 0) : k + 2]
    at = torch.cat([at, least]).unique()  # in order
    found = rms(at)
    best = int(found.argmin())
    if not float(found[best]) <= limit:
        raise DomainError(
            f"{lens.name}: its RMS spot is {float(found[best]):.4g} mm at best, above the {limit:.4g} mm of "
            "a disc of "
            f"{float(blur_mm):.4g} mm; allow more blur, or stop down."
        )
    far, near = (_edge(rms, at, found, best, step, limit) for step in (-1, 1))
    return DepthOfField(_metres(near), _metres(far), _metres(at[best]))


def _edge(rms, at, found, best, step, limit):
    """Vergence where the spot reaches the limit, going from the best sample in one direction."""
    k = best
    while 0 <= k + step < len(at) and float(found[k + step]) <= limit:
        k += step
    if not 0 <= k + step < len(at):
        return at[k]
    inside, outside = at[k], at[k + step]
    for _ in range(ROUNDS):
        between = inside + (outside - inside) * torch.linspace(
            0, 1, SAMPLES, dtype=at.dtype, device=at.device
        )
        sharp = (rms(between) <= limit).long().cumprod(0).sum()
        inside, outside = between[(sharp - 1).clamp_min(0)], between[sharp.clamp_max(SAMPLES - 1)]
    return inside


def _film_heights(lens, wavelength_um):
    """Height on the film, and reduced angle there, of two rays: of height 1 and slope 0, and of height 0 and
    slope 1, at the centre of the entrance pupil."""
    power, index = lens.surface_power(wavelength_um), lens.index(wavelength_um)
    pupil_z = lens.first_order().entrance_pupil_z_mm
    one, zero = torch.ones_like(pupil_z), torch.zeros_like(pupil_z)
    found = []
    for start in ((one, zero), (-pupil_z, index[0] * one)):
        heights, angles = yu_trace(power, lens.thickness_mm, index, *start)
        found.append((heights[-1] + lens.thickness_mm[-1] * angles[-1] / index[-1], angles[-1]))
    return found


def _nearest(lens):
    """Distance from the entrance pupil to the first vertex where that lies before it, mm, else 0."""
    return max(float(lens.first_order().entrance_pupil_z_mm.detach()), 0.0)


def _metres(vergence_per_mm):
    """Distance, inf where light is parallel or comes from beyond."""
    seen = vergence_per_mm > 0
    return torch.where(seen, 1e-3 / torch.where(seen, vergence_per_mm, 1), math.inf)


def _checked(lens, blur_mm):
    """The limit as a tensor. Raises: DomainError unless it is positive and finite."""
    blur = real_numbers(blur_mm, "limit of blur").to(lens.thickness_mm)
    if blur.ndim:
        raise DomainError(f"limit of blur: {blur_mm} is not one finite number; give a diameter in mm.")
    if not 0 < float(blur.detach()) < math.inf:
        raise DomainError(
            f"a limit of {float(blur):.4g} mm of blur cannot be; give a positive diameter in mm."
        )
    return blur
