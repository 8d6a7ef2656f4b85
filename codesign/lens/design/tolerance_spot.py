"""The spot under manufacturing errors. Near an optimum its slope vanishes, so the linear forecast fails; the
ray errors themselves stay linear.

With r the ray errors of the nominal lens about their spot's mean (divided by the root of the ray count, so
that r.r is the squared RMS spot) and A their change per standard deviation of each error, an error e gives |r
+ A e|^2. For independent normal e this has mean r.r + tr(A^T A) and variance 4 |A^T r|^2 + 2 tr((A^T A)^2).
What is left out is the curvature of the rays themselves, r . d2r / de2.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.lens.analysis import spots
from codesign.lens.distance import PARALLEL, Distances
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM


@dataclass(frozen=True)
class SpotForecast:
    """Per field: nominal [F] squared RMS spot, linear [F, P] its slope 2 A^T r, added [F, P] the diagonal of
    A^T A (mean square that each error adds), square [F, P, P] all of A^T A. In mm^2 and per standard
    deviation."""

    nominal: Tensor
    linear: Tensor
    added: Tensor
    square: Tensor

    @property
    def mean(self) -> Tensor:
        """Expected squared RMS spot, [F] mm^2."""
        return self.nominal + self.added.sum(1)

    @property
    def deviation(self) -> Tensor:
        """Standard deviation of the squared RMS spot, [F] mm^2."""
        return (self.linear.square().sum(1) + 2 * self.square.square().sum((1, 2))).sqrt()

    @property
    def linear_deviation(self) -> Tensor:
        """The same from the slope alone; far too small near an optimum."""
        return torch.linalg.vector_norm(self.linear, dim=1)

    def at(self, amounts: Tensor) -> Tensor:
        """Squared RMS spot forecast for errors of ``amounts`` [N, P] standard deviations, [N, F] mm^2."""
        return (
            self.nominal
            + amounts @ self.linear.T
            + torch.einsum("np,fpq,nq->nf", amounts, self.square, amounts)
        )


def spot_errors(
    fields_rad: Sequence[float],
    wavelengths_um: Sequence[float] = (WAVELENGTH_UM["d"],),
    grid: int = 12,
    at_m: Distances = PARALLEL,
) -> Callable[[GeoLens], Tensor]:
    """The figure lens -> [F * M * 2]: ray errors about the mean point of their field over all wavelengths,
    mm, divided by the root of the ray count.

    Args: at_m: metres to the object plane; of D distances each counts as so many more fields, [D * F * M * 2].
    Raises: DomainError when a ray fails.
    """

    def figure(lens):
        found = [spots(lens, fields_rad, w, grid, at_m) for w in wavelengths_um]
        position = torch.cat([p.flatten(0, -3) for p, _ in found], 1)
        arrived = torch.cat([a.flatten(0, -2) for _, a in found], 1)
        if not bool(arrived.bool().all()):
            raise DomainError(
                f"{lens.name}: {int((arrived == 0).sum())} rays fail; the forecast needs every ray, so use "
                "smaller tolerances or fields."
            )
        return ((position - position.mean(1, keepdim=True)) / position.shape[1] ** 0.5).reshape(-1)

    return figure


def squared_spots(errors: Tensor, fields: int) -> Tensor:
    """Squared RMS spots [F] mm^2 out of what ``spot_errors`` gives; fields: their number, times that of distances."""
    return errors.reshape(fields, -1).square().sum(1)


def forecast_spot(nominal: Tensor, slopes: Tensor, fields: int) -> SpotForecast:
    """SpotForecast from ray errors [F * M * 2] and their sensitivities [F * M * 2, P]."""
    r = nominal.reshape(fields, -1)
    A = slopes.reshape(fields, -1, slopes.shape[1])
    square = torch.einsum("fmp,fmq->fpq", A, A)
    return SpotForecast(
        r.square().sum(1), 2 * torch.einsum("fmp,fm->fp", A, r), square.diagonal(dim1=1, dim2=2), square
    )
