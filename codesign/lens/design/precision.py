"""What precision each surface needs: tolerances out of a budget, the other way round.

A figure is forecast to second order in the errors, F(e) = F0 + s.e + e.Q e, with e in units of the
deviations that the errors have so far. With factors f on these deviations its increase has the mean
sum Q_ii f_i^2 and the variance sum s_i^2 f_i^2 + 2 sum Q_ij^2 f_i^2 f_j^2. The budget is the
increase that a share of all lenses stays within. With v = f^2 and w the slope of mean + z deviation
over v (z the normal quantile of the share), the cheapest tolerances at costs 1 / f have f
proportional to w^(-1/3) (Lagrange). Where Q = 0 that is the closed form of a root sum of squares;
else w depends on v, and both are a fixed point. The scale of all factors follows from the
distribution of the quadratic form itself, not from its normal approximation.

    forecast = forecast_spot(nominal, slopes, 3).averaged() needed = cheapest(forecast, errors, 0.21
    * forecast.nominal)  # the RMS spot grows by 10 % at most trials = monte_carlo(geo,
    needed.errors, figures, 400, generator)
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import torch
from torch import Tensor

from codesign.checks import check_finite
from codesign.errors import DomainError, ShapeError
from codesign.lens.design.tolerance import Error, Forecast

NODES = 2048  # of the sum over the characteristic function
# standard deviations from the mean that no lens reaches; the sum repeats itself after twice as many
FARTHEST = 25.0
ROUNDS = 40  # of the fixed point and of a bisection


def share_within(forecast: Forecast, increase: float, factors: Tensor) -> float:
    """Share of lenses whose figure grows by at most ``increase``, of errors with factors [P].

    Source: Davies, Numerical inversion of a characteristic function, Biometrika 60 (1973): a sum
      over the characteristic function, here of a quadratic form in its principal axes.
    """
    mean, deviation = forecast.moments(factors)
    away = float(increase - mean)
    if abs(away) >= FARTHEST * float(deviation):
        return float(away >= 0)
    size, axes = torch.linalg.eigh(factors[:, None] * forecast.square * factors)
    slope = axes.T @ (factors * forecast.linear)
    node = torch.arange(NODES, dtype=size.dtype) + 0.5
    t = node * (math.pi / FARTHEST) / deviation
    bent = 1 - 2j * t[:, None] * size
    log = (-0.5 * bent.log() - 0.5 * (t[:, None] * slope).square() / bent).sum(
        1
    ) - 1j * t * increase
    return 0.5 - float((log.exp().imag / node).sum()) / math.pi


@dataclass(frozen=True)
class Precision:
    """Tolerances that spend a budget. errors: with the deviations needed. factors: [P], of these
    over those given; one for both axes of a tolerance. shares: [P] of the budget that each error
    takes. cost: sum of 1 / factor."""

    errors: tuple[Error, ...]
    factors: Tensor
    shares: Tensor
    cost: float


def cheapest(
    forecast: Forecast,
    errors: Sequence[Error],
    budget: float,
    share: float = 0.9,
    most: float = math.inf,
) -> Precision:
    """Tolerances of the least total cost, each costing 1 over its factor, with which a share of all
    lenses keeps the figure's increase within the budget.

    Args:
      errors: those of the forecast, in its order, as from ``errors_of``. Errors that one tolerance
        of a drawing covers (x and y) get one factor.
      budget: > 0, in the unit of the figure. share: of lenses, above a half and below 1. most:
        largest factor.
    Raises: DomainError for a budget or share out of range, a tolerance that the figure does not
      grow with and ``most`` does not bound, and a budget that is not spent when all are at
      ``most``.
    """
    if not errors:
        raise DomainError("no errors were given; give at least one, as errors_of makes them.")
    for part in (forecast.linear, forecast.square):
        check_finite(part, "forecast", "look for what makes the figure NaN or infinite")
    forecast = Forecast(forecast.nominal, forecast.linear.double(), forecast.square.double())
    if forecast.linear.shape != (len(errors),):
        raise ShapeError(
            f"the forecast is of {forecast.linear.numel()} errors, but {len(errors)} were given."
        )
    if not any(bool(part.any()) for part in (forecast.linear, forecast.square)):
        raise DomainError(
            "the figure has no slope in any error; larger steps, or another figure, may show one."
        )
    if isinstance(budget, bool) or not (0 < budget < math.inf and 0.5 < share < 1 and most > 0):
        raise DomainError(
            f"budget {budget}, share {share} and largest factor {most}: the budget must be a positive "
            "increase of the figure, the share lie between 0.5 and 1, and the factor be positive."
        )
    names = list(dict.fromkeys(e.drawn for e in errors))
    member = torch.tensor([names.index(e.drawn) for e in errors])
    z = NormalDist().inv_cdf(share)
    factors = torch.ones(len(names), dtype=forecast.linear.dtype)

    def slopes():
        """Slope of mean + z deviation over the squared factor of every tolerance, [names], and of
        every error."""
        v = factors[member].square()
        deviation = forecast.moments(factors[member])[1]
        w = forecast.added + z / (2 * deviation) * (
            forecast.linear.square() + 4 * forecast.square.square() @ v
        )
        return torch.zeros_like(factors).index_add(0, member, w), w

    def normal(trial):
        mean, deviation = forecast.moments(trial)
        return bool(mean + z * deviation <= budget)

    def exact(trial):
        return share_within(forecast, budget, trial) >= share

    aim = factors
    for _ in range(ROUNDS):
        w, _ = slopes()
        if not bool((w > 0).all()) and math.isinf(most):
            flat = ", ".join(names[k] for k in (w <= 0).nonzero()[:, 0].tolist())
            raise DomainError(
                f"the figure does not grow with {flat}, so give the largest factor it may have."
            )
        aim = torch.where(w > 0, w.clamp_min(1e-300) ** (-1 / 3), 1e30)
        before = factors
        factors = (_largest(aim, member, most, normal) * before).sqrt()
        if float((factors / before - 1).abs().max()) < 1e-7:
            break
    factors = _largest(aim, member, most, exact)
    spent = slopes()[1] * factors[member].square()
    found = tuple(
        replace(e, deviation=e.deviation * f)
        for e, f in zip(errors, factors[member].tolist(), strict=True)
    )
    return Precision(found, factors[member], spent / spent.sum(), float((1 / factors).sum()))


def _largest(shape, member, most, keeps):
    """The largest factors in proportion to ``shape`` [names], none above ``most``, of which the
    budget keeps."""
    low, high = -30.0, 30.0
    if keeps((shape * math.exp(high)).clamp_max(most)[member]):
        raise DomainError(
            f"even at {most:g} times the deviations given the budget is not spent; allow larger factors, "
            "or start from larger deviations."
        )
    for _ in range(ROUNDS):
        middle = (low + high) / 2
        inside = keeps((shape * math.exp(middle)).clamp_max(most)[member])
        low, high = (middle, high) if inside else (low, middle)
    return (shape * math.exp(low)).clamp_max(most)
