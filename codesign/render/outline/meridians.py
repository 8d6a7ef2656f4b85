"""Where the pictures on spheres begin: half circles from pole to pole, on which texture coordinates jump."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign.render.outline.curves import ROUND, Curve, cut

GRAZING = (
    0.05  # cosine of the view below which a piece is left out: it runs along the outline, which is listed
)


@dataclass(frozen=True)
class Meridians(Curve):
    """Half circles centre + sin u + cos v for angles 0 to pi. centre, u, v: [C, 3], u and v of the sphere's radius."""

    centre: Tensor
    u: Tensor
    v: Tensor

    def pieces(self, viewpoint: Tensor, angle: float, within_m: float = 0.0) -> tuple[Tensor, Tensor]:
        """As for Segments; those that face the viewpoint [3]."""
        index, s = cut(torch.arange(len(self.centre)), torch.full((len(self.centre),), ROUND // 2))
        seen = torch.ones(len(index), dtype=torch.bool)
        for end in s.unbind(1):
            seen &= self._cosine(index, self.points(index, end, viewpoint), viewpoint) > GRAZING
        return index[seen], s[seen]

    def points(self, index: Tensor, s: Tensor, viewpoint: Any) -> Tensor:
        """As for Segments."""
        turn = torch.pi * s[:, None]
        return self.centre[index] + turn.sin() * self.u[index] + turn.cos() * self.v[index]

    def aside_rad(self, index: Tensor, viewpoint: Tensor) -> Tensor:
        """As for Segments: texture coordinates follow the point that is met, good to float32 of its distance."""
        distance = (self.centre[index] - viewpoint).norm(dim=1)
        return 1e-5 + 1e-6 * distance / self.u[index].norm(dim=1)

    def counts(self, index: Tensor, y: Tensor, viewpoint: Tensor) -> Tensor:
        """As for Curve: on the side that faces the viewpoint."""
        return self._cosine(index, y, viewpoint) > 0

    def face_slope(self, index: Tensor, y: Tensor, viewpoint: Tensor) -> Tensor:
        """As for Curve: of the sphere, on both sides."""
        cosine = self._cosine(index, y, viewpoint)
        return torch.where(cosine > 0, (1 - cosine.square()).clamp_min(0).sqrt() / cosine, torch.inf)

    def _cosine(self, index, y, viewpoint):
        towards = torch.nn.functional.normalize(viewpoint - y, dim=1)
        return (torch.nn.functional.normalize(y - self.centre[index], dim=1) * towards).sum(1)
