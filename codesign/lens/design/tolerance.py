"""What manufacturing errors do to a lens: sensitivities, their linear forecast, and Monte Carlo to judge it.

    tolerances = Tolerances(radius_relative=1e-3, thickness_mm=0.02, index=5e-4, element_decentre_mm=0.01)
    J = sensitivities(geo, tolerances, linear_figures(0.3))
    trials = monte_carlo(geo, tolerances, linear_figures(0.3), 1000, torch.Generator().manual_seed(0))

A figure is a function from a lens to a vector [K]. Errors are independent, normal, and each number of
Tolerances is one standard deviation. A compensator is a function from the faulty lens to the one that is used, such
as ``functools.partial(solves.focus_rays, fields_rad=(0.0, 0.3), grid=8)``; every function takes it the same way.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.grad.jacobian import Jacobian, by_differences, finite
from codesign.lens.analysis import spots
from codesign.lens.design.tolerance_errors import Error, Tolerances, errors_of, perturbed
from codesign.lens.distance import PARALLEL, one_distance, vergence_per_mm
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import WAVELENGTH_UM
from codesign.lens.paraxial import image_scale_mm

Figures = Callable[[GeoLens], Tensor]
Compensator = Callable[[GeoLens], GeoLens]


def linear_figures(
    half_field_rad: float,
    wavelength_um: float = WAVELENGTH_UM["d"],
    grid: int = 8,
    at_m: float = PARALLEL,
) -> Figures:
    """Figures that errors change in proportion: the function lens -> [5] of EFL, BFL, distortion at the field
    (relative), and the x and y of the axial spot's mean point; lengths in mm. Names: LINEAR_FIGURES.

    Args: at_m: metres from the (faulty) lens's entrance pupil to the object of the spots and of the distortion.
    """
    one_distance(at_m)

    def figures(lens):
        f = lens.first_order(wavelength_um)
        position, arrived = spots(lens, (0.0, half_field_rad), wavelength_um, grid, at_m)
        scale = image_scale_mm(lens, vergence_per_mm(lens, at_m), wavelength_um)
        weight = arrived[..., None] / arrived.sum(1)[:, None, None]
        mean = (position * weight).sum(1)
        shift = mean[1, 1] - mean[0, 1]
        return torch.stack(
            [f.efl_mm, f.bfl_mm, shift / (scale * math.tan(half_field_rad)) - 1, mean[0, 0], mean[0, 1]]
        )

    return figures


LINEAR_FIGURES = ("EFL (mm)", "BFL (mm)", "distortion", "image shift x (mm)", "image shift y (mm)")


def compensated(figures: Figures, compensate: Compensator | None) -> Figures:
    """The figures of a lens after a compensator has done what it can; as they are for None."""
    if compensate is None:
        return figures

    def after(lens):
        return figures(compensate(lens))

    return after


def sensitivities(
    lens: GeoLens,
    tolerances: Tolerances | Sequence[Error],
    figures: Figures,
    jacobian: Jacobian | None = None,
    compensate: Compensator | None = None,
) -> Tensor:
    """Change of every figure per standard deviation of every error, [K, P]. The columns are in the order of
    ``errors_of``.

    Args: figures: lens -> [K]. jacobian: optimise.by_autograd for analytic gradients (K backward passes, best
      for few figures), or optimise.by_differences(step), step in standard deviations; central differences of
      0.1 when left out (2 P evaluations). compensate: applied to the faulty lens first.
    Gradient: none.
    """
    errors = errors_of(lens, tolerances)
    figures = compensated(figures, compensate)
    still = torch.zeros(len(errors), dtype=lens.dtype, device=lens.curvature_per_mm.device)

    def function(amounts):
        return figures(perturbed(lens, errors, amounts))

    with torch.no_grad():
        value = function(still)
    return (jacobian or by_differences(0.1, central=True))(function, still, value)


@dataclass(frozen=True)
class Trials:
    """Monte Carlo: amounts [N, P] in standard deviations, figures [N, K], nominal [K], failed: trials without
    a finite result (their figures are NaN)."""

    amounts: Tensor
    figures: Tensor
    nominal: Tensor
    failed: int

    def quantiles(self, shares: Sequence[float] = (0.05, 0.5, 0.95)) -> Tensor:
        """Quantiles of every figure over the trials that worked, [len(shares), K]."""
        good = self.figures[self.figures.isfinite().all(1)]
        return torch.quantile(good, torch.tensor(shares, dtype=good.dtype), dim=0)


def monte_carlo(
    lens: GeoLens,
    tolerances: Tolerances | Sequence[Error],
    figures: Figures,
    count: int,
    generator: torch.Generator,
    progress: Callable[[], object] | None = None,
    compensate: Compensator | None = None,
) -> Trials:
    """Trials of ``count`` lenses with random errors.

    Args: generator: torch.Generator (CPU). progress: called after every trial, or None. compensate: applied to every
      faulty lens, and to the nominal one.
    A lens that raises DomainError (no ray arrives, no focal length) is a failed trial: counted, never dropped
    in silence.
    """
    if count < 1:
        raise DomainError(f"{count} trials were asked for; give at least 1.")
    errors = errors_of(lens, tolerances)
    figures = compensated(figures, compensate)
    amounts = torch.randn(count, len(errors), generator=generator, dtype=lens.dtype)
    with torch.no_grad():
        nominal = figures(lens)
        rows = []
        for draw in amounts:
            try:
                row = figures(perturbed(lens, errors, draw.to(nominal.device)))
            except DomainError:
                row = torch.full_like(nominal, math.nan)
            rows.append(row if finite(row) else torch.full_like(row, math.nan))
            if progress is not None:
                progress()
    found = torch.stack(rows)
    return Trials(amounts, found, nominal, int((~found.isfinite().all(1)).sum()))


@dataclass(frozen=True)
class Comparison:
    """Linear forecast against trials, each [K]: standard deviations forecast and simulated, the correlation
    of the changes forecast and simulated trial by trial, and how far the mean moved, in simulated standard
    deviations (0 for a figure that is linear)."""

    forecast: Tensor
    simulated: Tensor
    correlation: Tensor
    bias: Tensor


def compare(slopes: Tensor, trials: Trials) -> Comparison:
    """Comparison of ``sensitivities`` [K, P] with trials of the same lens and tolerances. A figure that
    nothing changes has correlation 1."""
    good = trials.figures.isfinite().all(1)
    if int(good.sum()) < 3:
        raise DomainError(
            f"only {int(good.sum())} trials worked, too few to compare; use smaller tolerances."
        )
    change = trials.figures[good] - trials.nominal
    linear = trials.amounts[good] @ slopes.T
    simulated = change.std(0)
    a = linear - linear.mean(0)
    b = change - change.mean(0)
    size = torch.linalg.vector_norm(a, dim=0) * torch.linalg.vector_norm(b, dim=0)
    correlation = torch.where(size > 0, (a * b).sum(0) / size.clamp_min(1e-300), 1.0)
    return Comparison(
        torch.linalg.vector_norm(slopes, dim=1),
        simulated,
        correlation,
        change.mean(0) / simulated.clamp_min(1e-300),
    )


def worst_offenders(
    lens: GeoLens, tolerances: Tolerances | Sequence[Error], slopes: Tensor, figure: int, most: int = 10
) -> list[tuple[str, float, float]]:
    """The errors that change one figure most: a list of (name, change per standard deviation, share of the
    forecast variance)."""
    errors = errors_of(lens, tolerances)
    row = slopes[figure]
    total = float(row.square().sum())
    order = row.abs().argsort(descending=True)[:most].tolist()
    return [(errors[k].name, float(row[k]), float(row[k]) ** 2 / total if total else 0.0) for k in order]
