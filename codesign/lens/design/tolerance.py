"""What manufacturing errors do to a lens: the errors, their sensitivities, linear forecasts, and
Monte Carlo to judge.

    tolerances = Tolerances(radius_relative=1e-3, thickness_mm=0.02, index=5e-4,
    element_decentre_mm=0.01) J = sensitivities(geo, tolerances, linear_figures(0.3)) trials =
    monte_carlo(geo, tolerances, linear_figures(0.3), 1000, torch.Generator().manual_seed(0))

A figure is a function from a lens to a vector [K]. Errors are independent, normal, and each number
of Tolerances is one standard deviation. A compensator is a function from the faulty lens to the one
that is used, such as ``functools.partial(solves.focus_rays, fields_rad=(0.0, 0.3), grid=8)``; every
function takes it the same way.

The spot: near an optimum its slope vanishes, so the linear forecast fails; the ray errors
themselves stay linear. With r the ray errors of the nominal lens about their spot's mean (divided
by the root of the ray count, so that r.r is the squared RMS spot) and A their change per standard
deviation of each error, an error e gives |r + A e|^2. For independent normal e this has mean r.r +
tr(A^T A) and variance 4 |A^T r|^2 + 2 tr((A^T A)^2). What is left out is the curvature of the rays
themselves, r . d2r / de2.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.checks import check_number, check_whole
from codesign.errors import DomainError, ShapeError
from codesign.grad.jacobian import Jacobian, by_differences, finite
from codesign.lens.analysis import spots
from codesign.lens.design.constraints import is_glass
from codesign.lens.design.moves import groups, moved_element
from codesign.lens.distance import PARALLEL, Distances, one_distance, vergence_per_mm
from codesign.lens.geolens import GeoLens
from codesign.lens.glass import D_UM
from codesign.lens.paraxial import image_scale_mm
from codesign.lens.surface import passed_twice, passes_of

OF_ELEMENT = "element "  # before the argument of ``moved_element``


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations of independent normal errors, all at least 0; 0 leaves that kind out.

    radius_relative: of every radius, as a share. radius_mm: of every radius, mm. fringes: rings of
      Newton's power fringes over the semi-aperture, at 546 nm (N rings change the curvature by N
      wavelength / semi-aperture^2). The three add in squares.
    thickness_mm: of every thickness but the last, which is the focus. index: of every glass, the
      same at every wavelength.
    decentre_mm: of every surface, in x and in y. tilt_deg: of every surface, about x and about y.
    element_decentre_mm, element_tilt_deg, element_wedge_deg: of every element, a cemented group
      being one, moved as a rigid body; in x and y, and about x and y. See
      ``moves.moved_element``.
    """

    radius_relative: float = 0.0
    radius_mm: float = 0.0
    fringes: float = 0.0
    thickness_mm: float = 0.0
    index: float = 0.0
    decentre_mm: float = 0.0
    tilt_deg: float = 0.0
    element_decentre_mm: float = 0.0
    element_tilt_deg: float = 0.0
    element_wedge_deg: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            check_number(value, f"tolerance {name}", 0.0, remedy="it is a standard deviation")
        if not any(vars(self).values()):
            raise DomainError("all tolerances are 0, so nothing varies; give at least one.")


@dataclass(frozen=True)
class Error:
    """One independent error: a name with the surfaces counted from 1, the lens tensor (or the
    argument of ``moved_element``) and the entry it changes, and its standard deviation."""

    name: str
    tensor: str
    at: tuple[int, ...]
    deviation: float

    @property
    def drawn(self) -> str:
        """The tolerance of a drawing it falls under: the name without the axis."""
        return re.sub(r" (in|about) [xy]$", "", self.name)


def errors_of(lens: GeoLens, tolerances: Tolerances | Sequence[Error]) -> list[Error]:
    """The independent errors of a lens under ``tolerances``, a list of Error, surface by surface
    and then element by element; errors given as such stay as they are. A plane keeps its radius but
    not its fringes.

    Surfaces that do not bend light (a stop in air) have no shape or place to get wrong.
    Raises: DomainError for tolerances of elements with a mirror in them, or of glass that the light
      passes twice.
    """
    if not isinstance(tolerances, Tolerances):
        return list(tolerances)
    found = []
    glass = is_glass(lens)
    t = tolerances
    for i, (c, a) in enumerate(
        zip(lens.curvature_per_mm.tolist(), lens.semi_aperture_mm.tolist(), strict=True)
    ):
        where = f"surface {i + 1}"
        # even where both have one index today
        bends = glass[i] or (i > 0 and glass[i - 1]) or lens.mirrors[i]
        curvature = (
            math.hypot(c * t.radius_relative, c * c * t.radius_mm, t.fringes * 0.546074e-3 / a**2)
            if bends
            else 0.0
        )
        found.append(Error(f"curvature of {where}", "curvature_per_mm", (i,), curvature))
        if i + 1 < len(glass):
            found.append(Error(f"thickness behind {where}", "thickness_mm", (i,), t.thickness_mm))
        if glass[i] and not lens.mirrors[i]:
            found.append(Error(f"index behind {where}", "index_offset", (i,), t.index))
        decentres = _two("decentre", where, "decentre_mm", i, t.decentre_mm * bends)
        tilts = _two("tilt", where, "tilt_rad", i, math.radians(t.tilt_deg) * bends)
        found += [error for axis in zip(decentres, tilts, strict=True) for error in axis]
    of_elements = {
        "decentre_mm": t.element_decentre_mm,
        "tilt_rad": math.radians(t.element_tilt_deg),
        "wedge_rad": math.radians(t.element_wedge_deg),
    }
    for g, (first, last) in enumerate(groups(lens) if any(of_elements.values()) else ()):
        _check_body(lens, first, last)
        for kind, deviation in of_elements.items():
            element = f"element {first + 1}-{last + 1}"
            found += _two(kind.split("_")[0], element, OF_ELEMENT + kind, g, deviation)
    found = [error for error in found if error.deviation > 0]
    faces, gaps, media = passed_twice(lens.surfaces)
    tied = {"thickness_mm": gaps, "index_offset": media}
    for error in found:
        if not error.tensor.startswith(OF_ELEMENT) and error.at[0] in tied.get(error.tensor, faces):
            raise DomainError(
                f"{lens.name}: the light passes a piece of glass twice, as a mirror sends it back, and the "
                f"{error.name} would err in one pass alone; give a list of Error without that piece."
            )
    return found


def _two(noun, where, tensor, row, deviation):
    """An error along or about x, and the same for y."""
    side = "in" if noun == "decentre" else "about"
    return [
        Error(f"{noun} of {where} {side} {label}", tensor, (row, axis), deviation)
        for axis, label in enumerate("xy")
    ]


def _check_body(lens, first, last):
    surfaces = lens.to_surfaces()
    if any(lens.mirrors[first : last + 1]) or any(
        passes_of(surfaces, i) for i in range(first, last)
    ):
        raise DomainError(
            f"{lens.name}: element {first + 1}-{last + 1} holds a mirror or is passed twice by the light, "
            "and moving it as a body is not modelled; give tolerances of surfaces instead of elements."
        )


def perturbed(lens: GeoLens, errors: Sequence[Error], amounts: Tensor) -> GeoLens:
    """The lens with errors of ``amounts`` [P] standard deviations. Gradient: to the amounts and to
    the lens."""
    if amounts.shape != (len(errors),):
        raise ShapeError(
            f"{len(errors)} errors need as many amounts, got shape {tuple(amounts.shape)}."
        )
    tensors = {}
    bodies = {}
    elements = groups(lens)
    for name in dict.fromkeys(e.tensor for e in errors):
        mine = [k for k, e in enumerate(errors) if e.tensor == name]
        of_element = name.startswith(OF_ELEMENT)
        base = lens.decentre_mm.new_zeros(len(elements), 2) if of_element else getattr(lens, name)
        places = tuple(
            torch.tensor(axis) for axis in zip(*(errors[k].at for k in mine), strict=True)
        )
        sizes = torch.tensor(
            [errors[k].deviation for k in mine], dtype=base.dtype, device=base.device
        )
        faulty = base.index_put(places, sizes * amounts[mine], accumulate=True)
        if of_element:
            bodies[name.removeprefix(OF_ELEMENT)] = faulty
        else:
            tensors[name] = faulty
    lens = lens.replace(**tensors)
    for g, faces in enumerate(elements if bodies else ()):
        lens = moved_element(lens, faces, **{name: table[g] for name, table in bodies.items()})
    return lens


Figures = Callable[[GeoLens], Tensor]
Compensator = Callable[[GeoLens], GeoLens]


def linear_figures(half_field_rad: float, at_m: float = PARALLEL) -> Figures:
    """Figures that errors change in proportion: the function lens -> [5] of EFL, BFL, distortion at
    the field (relative), and the x and y of the axial spot's mean point; lengths in mm. Names:
    LINEAR_FIGURES.

    Args:
      at_m: metres from the (faulty) lens's entrance pupil to the object of the spots and of the
        distortion.
    """
    one_distance(at_m)

    def figures(lens):
        f = lens.first_order()
        position, arrived = spots(lens, (0.0, half_field_rad), grid=8, at_m=at_m)
        scale = image_scale_mm(lens, vergence_per_mm(lens, at_m))
        weight = arrived[..., None] / arrived.sum(1)[:, None, None]
        mean = (position * weight).sum(1)
        shift = mean[1, 1] - mean[0, 1]
        return torch.stack(
            [
                f.efl_mm,
                f.bfl_mm,
                shift / (scale * math.tan(half_field_rad)) - 1,
                mean[0, 0],
                mean[0, 1],
            ]
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
    """Change of every figure per standard deviation of every error, [K, P]. The columns are in the
    order of ``errors_of``.

    Args:
      figures: lens -> [K].
      jacobian: optimise.by_autograd for analytic gradients (K backward passes, best for few
        figures), or optimise.by_differences(step), step in standard deviations; central differences
        of 0.1 when left out (2 P evaluations).
      compensate: applied to the faulty lens first.
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
    """Monte Carlo: amounts [N, P] in standard deviations, figures [N, K], nominal [K], failed:
    trials without a finite result (their figures are NaN)."""

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
    compensate: Compensator | None = None,
) -> Trials:
    """Trials of ``count`` lenses with random errors.

    Args:
      generator: torch.Generator (CPU).
      compensate: applied to every faulty lens, and to the nominal one.
    A lens that raises DomainError (no ray arrives, no focal length) is a failed trial: counted,
    never dropped in silence.
    """
    count = check_whole(count, "number of trials")
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
    found = torch.stack(rows)
    return Trials(amounts, found, nominal, int((~found.isfinite().all(1)).sum()))


@dataclass(frozen=True)
class Comparison:
    """Linear forecast against trials, each [K]: standard deviations forecast and simulated, the
    correlation of the changes forecast and simulated trial by trial, and how far the mean moved, in
    simulated standard deviations (0 for a figure that is linear)."""

    forecast: Tensor
    simulated: Tensor
    correlation: Tensor
    bias: Tensor


def compare(slopes: Tensor, trials: Trials) -> Comparison:
    """Comparison of ``sensitivities`` [K, P] with trials of the same lens and tolerances. A figure
    that nothing changes has correlation 1, one that changes against the forecast of none 0."""
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
    told, seen = torch.linalg.vector_norm(a, dim=0), torch.linalg.vector_norm(b, dim=0)
    still = (torch.maximum(told, seen) == 0).to(a)
    correlation = still + (a * b).sum(0) / (told * seen).clamp_min(1e-300)
    return Comparison(
        torch.linalg.vector_norm(slopes, dim=1),
        simulated,
        correlation,
        change.mean(0) / simulated.clamp_min(1e-300),
    )


def worst_offenders(
    lens: GeoLens,
    tolerances: Tolerances | Sequence[Error],
    slopes: Tensor,
    figure: int,
    most: int = 10,
) -> list[tuple[str, float, float]]:
    """The errors that change one figure most: a list of (name, change per standard deviation, share
    of the forecast variance)."""
    errors = errors_of(lens, tolerances)
    row = slopes[figure]
    total = float(row.square().sum())
    order = row.abs().argsort(descending=True)[:most].tolist()
    changes = [(errors[k].name, float(row[k])) for k in order]
    return [(name, change, change**2 / total if total else 0.0) for name, change in changes]


@dataclass(frozen=True)
class Forecast:
    """Figures to second order in P independent errors of one standard deviation each: nominal +
    linear . e + e . square e. nominal [...], or a number; linear [..., P]; square [..., P, P],
    symmetric."""

    nominal: float | Tensor
    linear: Tensor
    square: Tensor

    @property
    def added(self) -> Tensor:
        """What each error adds in the mean, [..., P]."""
        return self.square.diagonal(dim1=-2, dim2=-1)

    def at(self, amounts: Tensor) -> Tensor:
        """The figures at errors [N, P], [N, ...]."""
        bent = torch.einsum("np,...pq,nq->n...", amounts, self.square, amounts)
        return self.nominal + torch.einsum("np,...p->n...", amounts, self.linear) + bent

    def moments(self, factors: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the increase, [...], when every error has its factor [P]
        times the deviation; 1 where None are given."""
        v = self.linear.new_ones(self.linear.shape[-1]) if factors is None else factors.square()
        return self.added @ v, (
            self.linear.square() @ v + 2 * (self.square.square() @ v) @ v
        ).sqrt()

    def averaged(self) -> "Forecast":
        """The mean over the figures, as one."""
        return Forecast(
            float(torch.as_tensor(self.nominal).mean()), self.linear.mean(0), self.square.mean(0)
        )


def spot_errors(
    fields_rad: Sequence[float],
    wavelengths_um: Sequence[float] = (D_UM,),
    grid: int = 12,
    at_m: Distances = PARALLEL,
) -> Callable[[GeoLens], Tensor]:
    """The figure lens -> [F * M * 2]: ray errors about the mean point of their field over all
    wavelengths, mm, divided by the root of the ray count.

    Args:
      at_m: metres to the object plane; of D distances each counts as so many more fields,
        [D * F * M * 2].
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
    """Squared RMS spots [F] mm^2 out of what ``spot_errors`` gives; fields: their number, times
    that of distances."""
    return errors.reshape(fields, -1).square().sum(1)


def forecast_spot(nominal: Tensor, slopes: Tensor, fields: int) -> Forecast:
    """Forecast of the squared RMS spots, [F] mm^2, from ray errors [F * M * 2] and their
    sensitivities [F * M * 2, P]."""
    r = nominal.reshape(fields, -1)
    A = slopes.reshape(fields, -1, slopes.shape[1])
    square = torch.einsum("fmp,fmq->fpq", A, A)
    return Forecast(r.square().sum(1), 2 * torch.einsum("fmp,fm->fp", A, r), square)
