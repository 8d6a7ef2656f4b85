"""Where rays meet each surface and how steeply: clear apertures and angles of incidence."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from codesign.checks import check_number
from codesign.errors import DomainError
from codesign.lens.analysis.rays import source_rays
from codesign.lens.distance import PARALLEL, Distances, one_distance, vergence_per_mm
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import D_UM
from codesign.lens.paraxial import paraxial_rays
from codesign.lens.trace import across, at_surfaces, onward, trace

DENSER = 1.5  # index behind a surface whose normal is looked for: no ray is totally reflected


@dataclass(frozen=True)
class Hits:
    """Rays at every surface. height_mm: [S, N] distance from the vertex across its own axis. cosine:
    [S, N] of the angle of incidence, 1 on a dummy that borders no glass. passed: [S, N], False from
    the surface on where a ray failed; its numbers then mean nothing."""

    height_mm: Tensor
    cosine: Tensor
    passed: Tensor


def surface_hits(
    lens: GeoLens,
    origin_mm: Tensor,
    direction: Tensor,
    wavelength_um: float = D_UM,
) -> Hits:
    """Trace rays once per surface, up to it, and once to the image. Args: origin_mm, direction
    [N, 3], see GeoLens.trace. Returns: Hits.

    The normal is read off the change of direction at the same surface before denser glass, n'd' - n
    d = const N, so shapes, decentres and tilts need no second formula, and equal indices on both
    sides have a normal too.
    Gradient: heights and cosines to rays and to every lens tensor. Raises: DomainError for a lens
      with diffractive phases, which bend off the normal.
    """
    if any(s.phase for s in lens.surfaces):
        raise DomainError(
            f"{lens.name}: angles of incidence on diffractive surfaces are not computed; leave the "
            "incidence limit out."
        )
    whole = lens.prescription(wavelength_um)
    traced = [
        *at_surfaces(whole, origin_mm, direction),
        lens.trace(origin_mm, direction, wavelength_um),
    ]
    heights = []
    cosines = []
    passed = []
    for i, (here, next_) in enumerate(pairwise(traced)):
        before = here.direction
        ok = next_.status == 0
        if lens.mirrors[i] or whole.borders_glass[i]:
            surface = replace(
                whole.part(i, i + 1),
                index=whole.index.new_tensor([1.0, DENSER]),
                mirrors=(False,),
                to_plane=False,
                efficiency=1.0,
            )
            bend = DENSER * trace(surface, *onward(here)).direction - before
            length = torch.where(ok, bend.square().sum(1), 1.0).sqrt()
            cosines.append(torch.where(ok, ((bend * before).sum(1) / length).abs(), 1.0))
        else:
            cosines.append(torch.ones_like(before[:, 0]))
        heights.append(torch.linalg.vector_norm(across(whole, i, here.position_mm), dim=1))
        passed.append(ok)
    return Hits(torch.stack(heights), torch.stack(cosines), torch.stack(passed))


def rim_rays(
    lens: GeoLens, fields_rad: Sequence[float], count: int = 16, at_m: Distances = PARALLEL
) -> tuple[Tensor, Tensor]:
    """The chief ray and ``count`` rays on the rim of the entrance pupil, for each field and
    distance.
    Returns: origins and directions [distances * fields * (count + 1), 3]."""
    number = torch.arange(count, dtype=lens.dtype, device=lens.curvature_per_mm.device)
    turn = number * (2 * torch.pi / count) + torch.pi / 2
    rim = torch.stack([turn.cos(), turn.sin()], 1)
    pupil = torch.cat([torch.zeros_like(rim[:1]), rim])
    rays = source_rays(lens, fields_rad, pupil, at_m)
    return rays.origin_mm.reshape(-1, 3), rays.direction.reshape(-1, 3)


def traced_semi_aperture_mm(
    lens: GeoLens,
    fields_rad: Sequence[float],
    margin: float = 0.05,
    at_m: Distances = PARALLEL,
) -> Tensor:
    """Semi-aperture that lets the full pupil of all fields and distances pass, [S] mm: the largest
    height of a rim ray, times 1 + margin.

    Gradient: of the highest ray. Raises: DomainError when a rim ray fails, or for a margin below 0.
    """
    check_number(
        margin, f"{lens.name}: margin", 0.0, remedy="it is added to semi-apertures as a share"
    )
    rays = rim_rays(lens, fields_rad, at_m=at_m)
    failed = lens.trace(*rays).status != 0
    if bool(failed.any()):
        raise DomainError(
            f"{lens.name}: {int(failed.sum())} of {failed.numel()} rim rays fail, so its "
            "apertures cannot be sized; use a smaller field or weaker curvatures."
        )
    whole = lens.prescription()
    places = enumerate(at_surfaces(whole, *rays))
    reached = torch.stack([across(whole, i, at.position_mm) for i, at in places])
    return torch.linalg.vector_norm(reached, dim=2).amax(1) * (1 + margin)


def fit_apertures(
    lens: GeoLens, fields_rad: Sequence[float], at_m: Distances = PARALLEL, margin: float = 0.05
) -> GeoLens:
    """The lens with the semi-apertures that its rays need, so that edges and gaps of a design that
    changed are judged, and its light clipped, where its glass would really end.

    Args:
      fields_rad, at_m: whose full pupil passes; give both signs of a field for a lens with
        decentres or tilts.
      margin: share added to the highest ray, as far as the surface reaches.
    Returns: a lens as from ``replace``. Gradient: semi_aperture_mm follows the highest rays.
    Raises: DomainError when a rim ray fails, or for a margin below 0.

    >>> from codesign import lens
    >>> geo = lens.load("double-gauss")
    >>> lens.design.fit_apertures(geo, (0.0, 0.1)).semi_aperture_mm.amax() < geo.semi_aperture_mm.amax()
    tensor(True)
    """
    wanted = traced_semi_aperture_mm(lens, fields_rad, margin, at_m=at_m)
    square = (1 + lens.conic) * lens.curvature_per_mm.square()
    reach = (1 - 1e-9) * square.clamp_min(1e-24).rsqrt()  # a sphere ends at its radius
    return lens.replace(semi_aperture_mm=torch.minimum(wanted, reach))


def paraxial_semi_aperture_mm(
    lens: GeoLens,
    half_field_rad: float | Tensor,
    margin: float = 0.05,
    at_m: float | Tensor = PARALLEL,
) -> Tensor:
    """The same from the paraxial marginal and chief ray of one distance, |y| + |y_chief|, [S] mm:
    defined for every lens, without tracing. Differentiable."""
    rays = paraxial_rays(
        lens, half_field_rad, vergence_per_mm=vergence_per_mm(lens, one_distance(at_m))
    )
    return (rays.marginal_height_mm.abs() + rays.chief_height_mm.abs()) * (1 + margin)
