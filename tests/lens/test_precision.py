"""Tolerances from a budget, against closed forms, draws of the forecast, and trials of the lens itself."""

import math
from functools import partial
from statistics import NormalDist

import pytest
import torch

from codesign import lens
from codesign.lens.design.precision import cheapest, share_within
from codesign.lens.design.tolerance import (
    Error,
    Forecast,
    Tolerances,
    compensated,
    errors_of,
    forecast_spot,
    monte_carlo,
    sensitivities,
    spot_errors,
    squared_spots,
)
from codesign.lens.solves import focus_rays

D = torch.float64
FIELDS = (0.0, 0.3)
SHARE = 0.9
Z = NormalDist().inv_cdf(SHARE)
MOUNTED = Tolerances(radius_relative=1e-3, thickness_mm=0.02, element_decentre_mm=0.01, element_tilt_deg=0.02)


def named(count):
    return [Error(f"curvature of surface {i + 1}", "curvature_per_mm", (i,), 0.5) for i in range(count)]


def plain(slopes):
    return Forecast(3.0, slopes, torch.zeros(len(slopes), len(slopes), dtype=D))


@pytest.fixture
def slopes(generator):
    return torch.rand(6, dtype=D, generator=generator) + 0.1


def test_cheapest_tolerances_of_a_linear_figure(slopes):
    """Lagrange: s^(-2/3), scaled so that the root sum of squares is budget / z."""
    found = cheapest(plain(slopes), named(6), 0.2, SHARE)
    shape = slopes ** (-2 / 3)
    wanted = shape * (0.2 / Z) / torch.linalg.vector_norm(shape * slopes)
    torch.testing.assert_close(found.factors, wanted, rtol=1e-6, atol=0)
    assert found.cost == pytest.approx(float((1 / wanted).sum()), rel=1e-6)
    # the same budget in equal parts, budget / z / sqrt(P) of a standard deviation each, costs more
    assert found.cost < float((slopes * Z * math.sqrt(6) / 0.2).sum())
    torch.testing.assert_close(found.shares.sum(), torch.ones((), dtype=D), rtol=1e-12, atol=0)
    assert [e.deviation for e in found.errors] == pytest.approx((0.5 * found.factors).tolist(), rel=1e-12)


def test_the_share_of_one_square_is_that_of_chi_squared():
    """F = x^2: P(x^2 <= y) = erf(sqrt(y / 2)); a single square has the slowest characteristic function of
    all."""
    forecast = Forecast(0.0, torch.zeros(1, dtype=D), torch.ones(1, 1, dtype=D))
    for y in (0.5, 1.0, 2.7, 6.0):
        truth = math.erf(math.sqrt(y / 2))
        # the sum leaves off after 2048 terms that fall as k^-1.5: some 1e-4
        assert share_within(forecast, y, torch.ones(1, dtype=D)) == pytest.approx(truth, abs=3e-4)


def test_the_share_of_several_squares_and_of_a_slope():
    """Ten squares: chi squared of ten degrees, 1 - exp(-y/2) sum (y/2)^k / k! over k < 5; a slope: the
    normal."""
    ten = Forecast(0.0, torch.zeros(10, dtype=D), torch.eye(10, dtype=D))
    for y in (5.0, 12.0, 25.0):
        truth = 1 - math.exp(-y / 2) * sum((y / 2) ** k / math.factorial(k) for k in range(5))
        assert share_within(ten, y, torch.ones(10, dtype=D)) == pytest.approx(truth, abs=1e-9)
    one = plain(torch.tensor([2.0], dtype=D))
    assert share_within(one, 3.0, torch.tensor([0.5], dtype=D)) == pytest.approx(
        NormalDist().cdf(3.0), abs=1e-9
    )
    assert share_within(one, 1e9, torch.ones(1, dtype=D)) == 1.0


@pytest.fixture(scope="module")
def spot():
    """Forecast of the refocused triplet's squared spot under mounted elements, with its errors and figure."""
    geo = lens.load("cooke-triplet").freeze()
    compensate = partial(focus_rays, fields_rad=FIELDS, grid=6)
    figure = spot_errors(FIELDS, grid=6)
    slopes = sensitivities(geo, MOUNTED, figure, compensate=compensate)
    forecast = forecast_spot(compensated(figure, compensate)(geo), slopes, len(FIELDS)).averaged()
    return geo, errors_of(geo, MOUNTED), forecast, figure, compensate


def test_ninety_percent_of_drawn_errors_keep_the_budget(spot, generator):
    _, errors, forecast, _, _ = spot
    budget = 0.21 * forecast.nominal
    found = cheapest(forecast, errors, budget, SHARE)
    draws = torch.randn(200_000, len(errors), generator=generator, dtype=D) * found.factors
    inside = (forecast.at(draws) - forecast.nominal <= budget).double().mean()
    # 2e5 draws know the share to 0.0007, four of which; x and y of a tolerance have one factor
    assert float(inside) == pytest.approx(SHARE, abs=0.003)
    ties = {e.drawn: f for e, f in zip(errors, found.factors.tolist(), strict=True)}
    assert [ties[e.drawn] for e in errors] == found.factors.tolist()


def test_the_cheapest_is_a_minimum(spot, generator):
    """Any other factors that keep the budget cost more."""
    _, errors, forecast, _, _ = spot
    budget = 0.21 * forecast.nominal
    names = list(dict.fromkeys(e.drawn for e in errors))
    member = torch.tensor([names.index(e.drawn) for e in errors])
    found = cheapest(forecast, errors, budget, SHARE)
    best = torch.zeros(len(names), dtype=D).index_copy(0, member, found.factors)
    for _ in range(5):
        other = best * (0.2 * torch.randn(len(names), generator=generator, dtype=D)).exp()
        low, high = 0.1, 10.0
        for _ in range(30):
            middle = math.sqrt(low * high)
            inside = share_within(forecast, budget, (other * middle)[member]) >= SHARE
            low, high = (middle, high) if inside else (low, middle)
        # at the minimum a change of 20 % costs its square; the normal approximation of the shape costs far
        # less
        assert float((1 / (other * low)).sum()) > found.cost * (1 + 1e-3)


def test_ninety_percent_of_lenses_keep_the_budget(spot):
    geo, errors, forecast, figure, compensate = spot
    found = cheapest(forecast, errors, 0.21 * forecast.nominal, SHARE)
    trials = monte_carlo(
        geo,
        found.errors,
        lambda faulty: squared_spots(figure(faulty), len(FIELDS)).mean().reshape(1),
        200,
        torch.Generator().manual_seed(0),
        compensate=compensate,
    )
    inside = (trials.figures[:, 0] <= 1.21 * trials.nominal[0]).double().mean()
    assert float(inside) == pytest.approx(SHARE, abs=4 * math.sqrt(0.09 / 200))


def test_a_tolerance_that_does_not_matter_stays_at_the_largest_factor(slopes):
    slopes[2] = 0.0
    found = cheapest(plain(slopes), named(6), 0.2, most=4.0)
    assert float(found.factors[2]) == float(found.factors.max()) == 4.0


def test_a_forecast_in_float32_is_that_in_float64(slopes):
    forecast = Forecast(3.0, slopes.float(), torch.zeros(6, 6))
    wanted = cheapest(plain(slopes.float().double()), named(6), 0.2)
    torch.testing.assert_close(cheapest(forecast, named(6), 0.2).factors, wanted.factors, rtol=1e-12, atol=0)
