"""Spots of the wall that the cameras look at, in the light they see it in: what a spot designer
minimises."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from codesign import lens
from codesign.errors import DomainError
from codesign.lens.analysis import pupil_grid
from codesign.lens.analysis.rays import source_rays


@dataclass(frozen=True)
class SpotRays:
    """Rays of F points of a wall on the film plane, all wavelengths of a point in one row.

    position_mm: [F, N, 2]. slope: [F, N, 2], change of position per millimetre along the axis.
    share: [F, N] of the point's light: spectrum times what the apertures let pass, sum 1. missed:
    [] sum over rays of how far they failed.
    """

    position_mm: Tensor
    slope: Tensor
    share: Tensor
    missed: Tensor

    def spread(self) -> tuple[Tensor, Tensor]:
        """Position and slope about the mean of their spot, each [F, N, 2]."""
        share = self.share[..., None]
        centred = [v - (share * v).sum(1, keepdim=True) for v in (self.position_mm, self.slope)]
        return centred[0], centred[1]

    def rms_mm(self) -> Tensor:
        """RMS distance from the spot's mean, lateral colour included, [F] mm."""
        return (self.share[..., None] * self.spread()[0].square()).sum((1, 2)).sqrt()

    def best_focus_mm(self, weights: Sequence[float] | None = None) -> Tensor:
        """How far behind the film the weighted mean square spot is least, scalar mm: a closed form.

        Straight rays make a squared spot a parabola in the film's place: its least is at -sum(d.s)
        / sum(s.s), with d and s position and slope about the spot's mean. weights: [F], equal when
        None.
        """
        position, slope = self.spread()
        share = self.share[..., None]
        if weights is not None:
            share = torch.tensor(weights).to(share)[:, None, None] * share
        return -(share * position * slope).sum() / (share * slope.square()).sum()

    def shifted(self, distance_mm: Tensor) -> "SpotRays":
        """The same rays on a film ``distance_mm`` further behind."""
        return replace(self, position_mm=self.position_mm + distance_mm * self.slope)


def spot_rays(
    optics: lens.GeoLens,
    fields_rad: Sequence[float],
    distance_m: float,
    light: lens.Spectrum,
    grid: int = 16,
) -> SpotRays:
    """Rays from points of a wall across the axis, ``distance_m`` before the entrance pupil, to the
    film.

    Args:
      fields_rad: angles of the points' chief rays.
      grid: pupil cells across; one half of the pupil is traced, the other is its mirror image.
    Gradient: positions and slopes to every lens tensor. Raises: DomainError when no ray of a point
      arrives.
    """
    pupil = pupil_grid(grid, optics.dtype)
    source = source_rays(optics, torch.tensor(fields_rad), pupil[pupil[:, 0] > 0], distance_m)
    origin, direction = (v.reshape(-1, 3) for v in (source.origin_mm, source.direction))
    shape = source.direction.shape[:2]
    parts = []
    missed = origin.new_zeros(())
    for wavelength_um, weight in zip(light.wavelengths_um, light.weights, strict=True):
        out = optics.trace(origin, direction, wavelength_um)
        passed = (out.status == 0).to(out.weight.dtype) * out.weight.detach()
        missed = missed + out.deficit.sum()
        parts.append(
            (
                out.position_mm[:, :2].reshape(*shape, 2),
                (out.direction[:, :2] / out.direction[:, 2:]).reshape(*shape, 2),
                weight * passed.reshape(shape),
            )
        )
    position, slope, share = (torch.cat(columns, 1) for columns in zip(*parts, strict=True))
    total = share.sum(1, keepdim=True)
    if (total == 0).any():
        raise DomainError(
            f"{optics.name}: no light of some point of the wall arrives at the film; use a smaller field."
        )
    mirror = position.new_tensor([-1.0, 1.0])
    both = [torch.cat([v, v * mirror], 1) for v in (position, slope)]
    return SpotRays(both[0], both[1], torch.cat([share, share], 1) / (2 * total), missed)


def refocused(
    optics: lens.GeoLens,
    fields_rad: Sequence[float],
    distance_m: float,
    light: lens.Spectrum,
    weights: Sequence[float] | None = None,
) -> lens.GeoLens:
    """The lens with its film at ``SpotRays.best_focus_mm`` of points of the wall; see
    ``spot_rays``."""
    shift = spot_rays(optics, fields_rad, distance_m, light).best_focus_mm(weights)
    return film_moved(optics, shift)


def film_moved(optics: lens.GeoLens, distance_mm: Tensor) -> lens.GeoLens:
    """The lens with its film ``distance_mm`` further behind. Gradient: both."""
    *glass, film = optics.thickness_mm.unbind()
    return optics.replace(thickness_mm=torch.stack([*glass, film + distance_mm]))
