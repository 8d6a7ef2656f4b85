"""The glass map: where (nd, Vd) of a lens's glasses lie, how far inside a convex region of real glasses, and
which glasses of the catalogue are nearest to one."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens import glass
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM, Glass

VD_PER_ND = 100.0  # an Abbe number of 1 counts like an index of 0.01


def places(lens: GeoLens) -> dict[int, tuple[Tensor, Tensor]]:
    """(nd, Vd) of every medium but air, by surface index: a dictionary of pairs of scalar tensors. Gradient:
    to index_offset.

    An offset shifts the index by the same amount at every wavelength, so it moves Vd = (nd - 1) / (nF - nC)
    in proportion to nd - 1.
    """
    nd, nF, nC = (lens.index(WAVELENGTH_UM[line])[1:] for line in "dFC")
    filled = [i for i, s in enumerate(lens.surfaces) if not s.mirror and float(nd[i].detach()) > 1.001]
    flat = [i + 1 for i in filled if float((nF[i] - nC[i]).detach()) <= 0]
    if flat:
        raise DomainError(
            f"{lens.name}: the media behind surfaces {flat} have no dispersion, so they have no place on "
            "the glass map; leave the glass limits out."
        )
    return {i: (nd[i], (nd[i] - 1) / (nF[i] - nC[i])) for i in filled}


def inside(nd: Tensor, vd: Tensor, polygon: Sequence[tuple[float, float]]) -> Tensor:
    """Signed distance of a glass to the nearest side of a convex polygon, positive inside, in units of nd
    (100 of Vd count as 1).

    Args: nd, vd: scalar tensors. polygon: corners (nd, Vd) in either sense of rotation. Raises: DomainError
      unless it is convex with an area.
    """
    corners = torch.tensor([[n, v / VD_PER_ND] for n, v in polygon], dtype=nd.dtype, device=nd.device)
    side = corners.roll(-1, 0) - corners
    turn = side[:, 0] * side.roll(-1, 0)[:, 1] - side[:, 1] * side.roll(-1, 0)[:, 0]
    if len(polygon) < 3 or not (bool((turn > 0).all()) or bool((turn < 0).all())):
        raise DomainError(
            f"the corners {polygon} do not go once around a convex region of the glass map; give at least "
            "three (nd, Vd) pairs in order."
        )
    away = torch.stack([nd, vd / VD_PER_ND]) - corners
    cross = (side[:, 0] * away[:, 1] - side[:, 1] * away[:, 0]) * torch.sign(turn[0])
    return (cross / torch.linalg.vector_norm(side, dim=1)).amin()


def neighbour_glasses(
    medium: Glass | str, count: int = 4, apart: float = 2e-3, among: Sequence[str] | None = None
) -> list[Glass]:
    """The catalogue's glasses nearest to one on the (nd, Vd) map, the nearest first.

    The distance is hypot(nd difference, Vd difference / 100), see VD_PER_ND.
    Args: medium: a Glass, or a name of the catalogue. apart: least distance; other makers' versions of the
      same glass lie closer and are left out. among: names of the catalogue to choose from, None for all.
    Returns: at most ``count`` glasses. Raises: DomainError for a name the catalogue does not know, or a
      medium without dispersion.

    >>> from codesign import lens
    >>> [glass.name for glass in lens.design.neighbour_glasses("F2", 3)]
    ['F4', 'F1', 'S-TIM1']
    """
    given = Glass.named(medium) if isinstance(medium, str) else medium
    if count < 1:
        raise DomainError(f"{count} neighbours of {given.name} were asked for; give at least 1.")
    if math.isinf(given.abbe_number):
        raise DomainError(
            f"medium {given.name} has no dispersion, so it has no place on the glass map and no neighbours."
        )
    chosen = map(Glass.named, glass.names() if among is None else among)
    found = [
        (math.hypot(g.index_d - given.index_d, (g.abbe_number - given.abbe_number) / VD_PER_ND), g)
        for g in chosen
        if _covers_lines(g)
    ]
    found = [entry for entry in found if entry[0] >= apart and not math.isinf(entry[0])]
    return [g for _, g in sorted(found, key=lambda entry: entry[0])[:count]]


def _covers_lines(g):
    return g.range_um[0] <= WAVELENGTH_UM["F"] and g.range_um[1] >= WAVELENGTH_UM["C"]
