"""Depth of field: which object distances a fixed film shows with a blur below a limit.

The blur of an axial point is the disc that its light fills on the film. Its diameter is linear in
the vergence 1 / distance (from the entrance pupil), so both limits are closed forms; for a thin
lens it is the circle of confusion. Traced limits hold the RMS spot instead, diameter / (2 sqrt 2)
of an evenly filled disc, aberrations included.
"""

import functools
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.analysis.spots import rms_spot_mm
from codesign.lens.distance import real_numbers
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import D_UM
from codesign.lens.paraxial import image_place_mm, yu_trace

RMS_OF_DISC = 1 / (2 * math.sqrt(2))  # RMS radius of an evenly filled disc over its diameter
CLOSEST_PER_MM = 1e3  # to a pupil that has no surface before it


@dataclass(frozen=True)
class DepthOfField:
    """Metres from the entrance pupil of the d line, scalar tensors: the nearest and the farthest
    distance within the limit (inf where parallel light is), and the sharpest."""

    near_m: Tensor
    far_m: Tensor
    focus_m: Tensor


def depth_of_field(
    lens: GeoLens,
    blur_mm: float | Tensor,
    wavelength_um: float = D_UM,
) -> DepthOfField:
    """DepthOfField where the paraxial blur disc of an axial point is at most ``blur_mm`` across.

    Args:
      blur_mm: diameter on the film, > 0; see ``GeoLens.focus_at`` for where the film stands. A near
        limit before the lens is its first vertex.
    Gradient: to every lens tensor that bends or moves light, and to the blur.
    Raises: DomainError for a limit that is not positive, and when nothing before the lens is that
      sharp.

    Example:
    >>> from codesign import lens
    >>> found = lens.analysis.depth_of_field(lens.load("cooke-triplet").focus_at(2.0), 0.02)
    >>> round(found.near_m.item(), 2), round(found.far_m.item(), 2)
    (1.86, 2.17)
    """
    (at_parallel, _), (per_vergence, _) = _film_heights(lens, wavelength_um)
    sharpest = -at_parallel / per_vergence
    reach = _checked(lens, blur_mm) / (
        lens.first_order(wavelength_um).entrance_pupil_diameter_mm * per_vergence.abs()
    )
    nearest = _nearest(lens)
    if not float((sharpest + reach).detach()) > 0 or not float(
        (sharpest - reach).detach()
    ) < 1 / max(nearest, 1e-300):
        raise DomainError(
            f"{lens.name}: no point before the lens has a blur of {float(blur_mm):.4g} mm or less on its "
            "film; move the film (focus_at), or allow more blur."
        )
    near = (1e-3 / (sharpest + reach)).clamp_min(nearest * 1e-3)
    return DepthOfField(near, _metres(sharpest - reach), _metres(sharpest))


def hyperfocal_m(lens: GeoLens, blur_mm: float | Tensor, wavelength_um: float = D_UM) -> Tensor:
    """The nearest distance to focus on (metres from the entrance pupil) for which parallel light is
    blurred to a disc of ``blur_mm`` and no more, scalar: f^2 / (N blur) + f for a thin lens.

    Gradient: as for ``depth_of_field``. Raises: DomainError for a limit that is not positive, or a
      lens behind which parallel light does not converge.
    """
    blur = _checked(lens, blur_mm)
    f = lens.first_order(wavelength_um)
    (_, parallel), (_, from_centre) = _film_heights(lens, wavelength_um)
    if not 0 < float(image_place_mm(lens, 0.0, wavelength_um).detach()) < math.inf:
        raise DomainError(
            f"{lens.name}: parallel light does not converge behind the lens, so it has no hyperfocal distance; "
            "change a curvature."
        )
    # turned over by an intermediate image
    width = torch.sign(parallel) * f.entrance_pupil_diameter_mm * lens.index(wavelength_um)[0]
    return 1e-3 * (width - blur * from_centre) / (blur * parallel)


@torch.no_grad()
def traced_depth_of_field(
    lens: GeoLens,
    blur_mm: float,
    wavelength_um: float = D_UM,
    grid: int = 16,
) -> DepthOfField:
    """DepthOfField where the RMS spot on the axis is at most that of an even disc ``blur_mm``
    across.

    Aberrations share the blur: this range is the smaller the more of the limit they take. Args as
    for ``depth_of_field``; grid: pupil samples across. Gradient: none (limits are searched, to
    1e-6).
    Raises: DomainError for a limit that is not positive, and when aberrations alone exceed it.
    """
    limit = float(_checked(lens, blur_mm)) * RMS_OF_DISC
    (at_parallel, _), (per_vergence, _) = _film_heights(lens, wavelength_um)
    nearest = _nearest(lens)
    top = 0.999 / nearest if nearest else CLOSEST_PER_MM
    centre = min(max(float(-at_parallel / per_vergence), 0.0), top)
    cone = float(lens.first_order().entrance_pupil_diameter_mm * per_vergence.abs())
    width = 3 * float(blur_mm) / cone

    @functools.cache
    def rms(vergence):
        at_m = 1e-3 / per_vergence.new_tensor(vergence, dtype=lens.dtype)
        return float(rms_spot_mm(lens, [0.0], wavelength_um, grid, at_m))

    while True:  # aberrations, or a plate, may move the sharpest place far from the paraxial one
        low, high = max(0.0, centre - width), min(top, centre + width)
        centre = min(low, high, _least(rms, low, high), key=rms)
        if low < centre < high or centre in (0.0, top):
            break
        width *= 2
    if not rms(centre) <= limit:
        raise DomainError(
            f"{lens.name}: its RMS spot is {rms(centre):.4g} mm at best, above the {limit:.4g} mm of a disc of "
            f"{float(blur_mm):.4g} mm; allow more blur, or stop down."
        )
    near, far = (_edge(lambda v: rms(v) - limit, centre, end, width) for end in (top, 0.0))
    like = lens.thickness_mm.detach()
    return DepthOfField(*(_metres(like.new_tensor(v)) for v in (near, far, centre)))


def _least(function, low, high):
    """Where a function of one number is least between two ends."""
    from scipy.optimize import minimize_scalar

    found: Any = minimize_scalar(
        function, bounds=(low, high), method="bounded", options={"xatol": 1e-6 * (high - low)}
    )
    return float(found.x)


def _edge(function, start, end, step):
    """Where a function that is at most 0 at the start turns positive on the way to the end; the end
    if nowhere."""
    from scipy.optimize import brentq

    inside = start
    while inside != end:
        ahead = min(inside + step, end) if end > start else max(inside - step, end)
        if function(ahead) > 0:
            return brentq(function, inside, ahead, xtol=1e-7 * abs(ahead - inside))
        inside, step = ahead, 2 * step
    return end


def _film_heights(lens, wavelength_um):
    """Height on the film, and reduced angle there, of two rays: of height 1 and slope 0, and of
    height 0 and slope 1, at the centre of the entrance pupil."""
    power, index = lens.surface_power(wavelength_um), lens.index(wavelength_um)
    pupil_z = lens.first_order().entrance_pupil_z_mm
    one, zero = torch.ones_like(pupil_z), torch.zeros_like(pupil_z)
    found = []
    for start in ((one, zero), (-pupil_z, index[0] * one)):
        heights, angles = yu_trace(power, lens.thickness_mm, index, *start)
        found.append((heights[-1] + lens.thickness_mm[-1] * angles[-1] / index[-1], angles[-1]))
    return found


def _nearest(lens):
    """Distance from the entrance pupil to the first vertex where that lies before it, mm, else
    0."""
    return max(float(lens.first_order().entrance_pupil_z_mm.detach()), 0.0)


def _metres(vergence_per_mm):
    """Distance, inf where light is parallel or comes from beyond."""
    seen = vergence_per_mm > 0
    return torch.where(seen, 1e-3 / torch.where(seen, vergence_per_mm, 1), math.inf)


def _checked(lens, blur_mm):
    """The limit as a tensor. Raises: DomainError unless it is positive and finite."""
    blur = real_numbers(blur_mm, "limit of blur").to(lens.thickness_mm)
    if blur.ndim:
        raise DomainError(
            f"limit of blur: {blur_mm} is not one finite number; give a diameter in mm."
        )
    if not 0 < float(blur.detach()) < math.inf:
        raise DomainError(
            f"a limit of {float(blur):.4g} mm of blur cannot be; give a positive diameter in mm."
        )
    return blur
