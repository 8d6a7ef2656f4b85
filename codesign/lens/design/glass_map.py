"""The glass map: where (nd, Vd) of a lens's glasses lie, and how far inside a convex region of real
glasses."""

from collections.abc import Sequence

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM

VD_PER_ND = 100.0  # an Abbe number of 1 counts like an index of 0.01


def places(lens: GeoLens) -> dict[int, tuple[Tensor, Tensor]]:
    """(nd, Vd) of every medium but air, by surface index: a dictionary of pairs of scalar tensors. Gradient:
    to index_offset.

    An offset shifts the index by the same amount at every wavelength, so it moves Vd = (nd - 1) / (nF - nC)
    in proportion to nd - 1.
    """
    nd, nF, nC = (lens.index(WAVELENGTH_UM[line])[1:] for line in "dFC")
    glass = [i for i, s in enumerate(lens.surfaces) if not s.mirror and float(nd[i].detach()) > 1.001]
    flat = [i + 1 for i in glass if float((nF[i] - nC[i]).detach()) <= 0]
    if flat:
        raise DomainError(
            f"{lens.name}: the media behind surfaces {flat} have no dispersion, so they have no place on "
            "the glass map; leave the glass limits out."
        )
    return {i: (nd[i], (nd[i] - 1) / (nF[i] - nC[i])) for i in glass}


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
