"""Spot diagrams and encircled energy of a lens."""

from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.checks import check_number
from codesign.errors import ShapeError
from codesign.lens.analysis.rays import (
    Light,
    Values,
    chief_ray,
    pupil_grid,
    source_rays,
    spectral_lines,
    trace_field,
    trace_source,
)
from codesign.lens.distance import PARALLEL, Distances, one_distance
from codesign.lens.glass import D_UM
from codesign.lens.traced import TracedLens


def spots(
    lens: TracedLens,
    fields_rad: Sequence[float],
    wavelength_um: float = D_UM,
    grid: int = 32,
    at_m: Distances = PARALLEL,
) -> tuple[Tensor, Tensor]:
    """Spot diagrams: ray positions on the image plane, [fields, M, 2] mm, and weights [fields, M]
    (1, or 0 for failed rays). All fields and distances are one trace.

    Equal weights over a square pupil grid, no clipping by apertures.
    Args:
      at_m: metres from the entrance pupil to the object plane, inf for parallel light; of D
        distances the results are [D, fields, M, 2] and [D, fields, M].
    Gradient: positions to every lens tensor and to at_m. Raises: DomainError for a distance inside
      the lens.
    """
    pupil = pupil_grid(grid, lens.curvature_per_mm.dtype, lens.curvature_per_mm.device)
    rays = trace_source(lens, source_rays(lens, fields_rad, pupil, at_m), wavelength_um)
    return rays.position_mm, rays.weight


def rms_spot_mm(
    lens: TracedLens,
    fields_rad: Sequence[float],
    wavelength_um: float = D_UM,
    grid: int = 32,
    at_m: Distances = PARALLEL,
    vignetting: bool = False,
) -> Tensor:
    """RMS distance of rays from their mean point, [fields] mm; [D, fields] for D distances
    ``at_m``, see ``spots``; ``vignetting``: of those that all apertures let through. Raises
    DomainError where no ray of a field arrives.

    Example:
    >>> from codesign import lens
    >>> geo = lens.load("cooke-triplet")
    >>> [round(spot, 3) for spot in lens.rms_spot_mm(geo, (0.0, 0.2)).tolist()]
    [0.005, 0.012]
    >>> near = lens.rms_spot_mm(geo.focus_at(1.0), (0.0,), at_m=(0.5, 1.0, 2.0))[:, 0]
    >>> [round(spot, 3) for spot in near.tolist()]
    [0.172, 0.015, 0.108]
    """
    pupil = pupil_grid(grid, lens.curvature_per_mm.dtype, lens.curvature_per_mm.device)
    rays = trace_field(lens, fields_rad, pupil, wavelength_um, vignetting, at_m=at_m)
    positions, weight = rays.position_mm, rays.weight
    total = weight.sum(-1)
    w = weight[..., None]
    centre = (positions * w).sum(-2, keepdim=True) / total[..., None, None]
    root = torch.where(w > 0, torch.where(w > 0, w, 1).sqrt(), 0)
    # the gradient at a point image is 0
    return torch.linalg.vector_norm((positions - centre) * root, dim=(-2, -1)) / total.sqrt()


def polychromatic_spot(
    lens: TracedLens,
    field_rad: float,
    light: Light,
    grid: int = 32,
    vignetting: bool = False,
    at_m: float | Tensor = PARALLEL,
) -> tuple[Tensor, Tensor]:
    """Spot of one object point in light of several wavelengths, lateral colour included.

    Args:
      light: see ``spectral_lines``.
      grid: pupil cells across.
      vignetting, at_m (one distance): see ``trace_field``.
    Returns: positions [W, M, 2] mm on the image plane, and weights [W, M] that sum to 1 (rays of
      one wavelength share its weight as far as they arrive).
    Gradient: positions (with vignetting also weights) to every lens tensor and to at_m. Raises:
      DomainError when no ray of a wavelength arrives.
    """
    one_distance(at_m)
    pupil = pupil_grid(grid, lens.dtype, lens.curvature_per_mm.device)
    wavelengths, shares = spectral_lines(light)
    rays = [trace_field(lens, field_rad, pupil, w, vignetting, at_m) for w in wavelengths]
    weight = torch.stack([r.weight * share for r, share in zip(rays, shares, strict=True)])
    return torch.stack([r.position_mm for r in rays]), weight / weight.sum()


def lit_points(
    lens: TracedLens,
    field_rad: float,
    light: Light,
    grid: int,
    vignetting: bool,
    at_m: float | Tensor,
) -> tuple[Tensor, Tensor]:
    """The rays of a ``polychromatic_spot`` that arrive: positions [N, 2] mm and weights [N]."""
    positions, weight = polychromatic_spot(lens, field_rad, light, grid, vignetting, at_m)
    lit = weight.detach() > 0
    return positions[lit], weight[lit]


def spot_radius_mm(positions_mm: Tensor, weight: Tensor) -> Tensor:
    """RMS distance from the weighted mean point. Args: positions [..., 2] mm, weight [...].
    Returns: scalar mm; its gradient is 0 at a point image."""
    if weight.shape != positions_mm.shape[:-1]:
        raise ShapeError(
            f"weight has shape {list(weight.shape)}, positions {list(positions_mm.shape)}; one each."
        )
    points = positions_mm.reshape(-1, 2)
    w = (weight / weight.sum()).reshape(-1, 1)
    # norm of positions times root weights: regular at a point image; the root of a weight 0 has no
    # derivative, so it is left out
    passed = w.detach()[:, 0] > 0
    points = points[passed]
    w = w[passed]
    return torch.linalg.vector_norm((points - (points * w).sum(0)) * w.sqrt())


def encircled_energy(
    lens: TracedLens,
    field_rad: float,
    radii_mm: Values,
    light: Light = D_UM,
    grid: int = 64,
    vignetting: bool = False,
    about_chief: bool = False,
    at_m: float | Tensor = PARALLEL,
) -> Tensor:
    """Share of rays within circles about the spot's mean point (or the chief ray of the first
    wavelength).

    Args:
      radii_mm: [K] increasing or not; the others as for ``polychromatic_spot``.
    Returns: [K] in [0, 1], geometric, without diffraction.
    Gradient: none (a count).
    """
    distance, reached = _distances(lens, field_rad, light, grid, vignetting, about_chief, at_m)
    radii = torch.as_tensor(radii_mm, dtype=distance.dtype, device=distance.device).reshape(-1)
    energy = torch.cat([torch.zeros_like(reached[:1]), reached])
    return energy[torch.searchsorted(distance.detach(), radii, right=True)].clamp_max(1.0)


def encircled_radius_mm(
    lens: TracedLens,
    field_rad: float,
    share: float = 0.8,
    light: Light = D_UM,
    grid: int = 64,
    vignetting: bool = False,
    about_chief: bool = False,
    at_m: float | Tensor = PARALLEL,
) -> Tensor:
    """Radius that holds a share of the rays, scalar mm. Gradient: that of the ray on the rim.
    Raises:
    DomainError for a share outside (0, 1]."""
    check_number(share, "share of encircled energy", above=0.0, most=1.0)
    distance, reached = _distances(lens, field_rad, light, grid, vignetting, about_chief, at_m)
    at = int(torch.searchsorted(reached, reached.new_tensor(share - 1e-12)))
    return distance[min(at, len(distance) - 1)]


def _distances(lens, field_rad, light, grid, vignetting, about_chief, at_m):
    """Distances of the rays from the centre, in order, and the share of light up to each."""
    points, weight = lit_points(lens, field_rad, light, grid, vignetting, at_m)
    if about_chief:
        centre = chief_ray(lens, field_rad, spectral_lines(light)[0][0], at_m).position_mm
    else:
        centre = (points * weight[:, None]).sum(0)
    distance, order = torch.linalg.vector_norm(points - centre, dim=1).sort()
    return distance, weight.detach()[order].cumsum(0)
