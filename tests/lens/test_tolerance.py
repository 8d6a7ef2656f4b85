"""Tolerances against closed forms, the statistics of normal errors, and trials of the lens
itself."""

import math
from functools import partial
from statistics import NormalDist

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.grad.jacobian import by_autograd
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.design import groups, moved_element
from codesign.lens.design.precision import cheapest, share_within
from codesign.lens.design.tolerance import (
    LINEAR_FIGURES,
    Error,
    Forecast,
    Tolerances,
    compare,
    compensated,
    errors_of,
    forecast_spot,
    linear_figures,
    monte_carlo,
    perturbed,
    sensitivities,
    spot_errors,
    squared_spots,
    worst_offenders,
)
from codesign.lens.solves import focus_paraxial, focus_rays
from tests.lens.systems import PLANE, close, glass
from tests.numbers import D, f64, rand64, randn64, seeded

FIELD = math.radians(20)
FIELDS = (0.0, 0.7 * FIELD, FIELD)
ALL = Tolerances(
    radius_relative=1e-3, thickness_mm=0.02, index=5e-4, decentre_mm=0.01, tilt_deg=0.02
)


def singlet():
    return GeoLens(
        [Surface(60.0, 5.0, glass(1.5), 8.0, is_stop=True), Surface(-90.0, 70.0, None, 8.0)], 10.0
    ).freeze()


def efl(geo):
    return geo.first_order().efl_mm.reshape(1)


def test_the_errors_of_a_lens_by_name_and_size():
    """N rings mean that the sag at the edge is off by N half wavelengths."""
    sizes = {
        "radius_relative": 1e-3,
        "radius_mm": 0.1,
        "fringes": 2.0,
        "thickness_mm": 0.02,
        "index": 1e-4,
    }
    errors = errors_of(singlet(), Tolerances(**sizes, decentre_mm=0.01, tilt_deg=0.1))
    # curvatures, a thickness (the last is the focus), an index, decentres, tilts
    assert len(errors) == 2 + 1 + 1 + 4 + 4
    found = {e.name: e for e in errors}
    c = 1 / 60
    curvature = math.hypot(c * 1e-3, c * c * 0.1, 2 * 546.074e-6 / 64)
    close(found["curvature of surface 1"].deviation, curvature, 1e-12)
    thickness = "thickness behind surface 1"
    assert found[thickness] == Error(thickness, "thickness_mm", (0,), 0.02)
    tilt = found["tilt of surface 2 about y"]
    assert (tilt.at, tilt.deviation) == ((1, 1), pytest.approx(math.radians(0.1), rel=1e-15))
    bent = c + errors_of(singlet(), Tolerances(fringes=3.0))[0].deviation
    sag = [(1 - math.sqrt(1 - (k * 8) ** 2)) / k for k in (c, bent)]
    # a^2 / 2 is the first term of the sag: a^2 / R^2 = 2 % off in slope
    close(sag[1] - sag[0], 3 * 546.074e-6 / 2, 0.03)


def test_the_perturbed_lens_has_the_errors_and_nothing_else(triplet):
    errors = errors_of(triplet, ALL)
    amounts = f64([2.0 * (e.name == "decentre of surface 3 in y") for e in errors])
    faulty = perturbed(triplet, errors, amounts)
    assert faulty.decentre_mm[2].tolist() == [0.0, pytest.approx(0.02, rel=1e-14)]
    assert (faulty.decentre_mm != 0).sum() == 1
    for name in ("curvature_per_mm", "thickness_mm", "index_offset", "tilt_rad"):
        assert torch.equal(getattr(faulty, name), getattr(triplet, name))


def test_sensitivities_of_the_focal_length_by_the_lens_makers_equation():
    geo = singlet()
    t = Tolerances(radius_relative=1e-3, thickness_mm=0.02, index=5e-4)
    found = sensitivities(geo, t, efl, by_autograd)[0].tolist()
    r1, r2, d, n = (torch.tensor(v, dtype=D, requires_grad=True) for v in (60.0, -90.0, 5.0, 1.5))
    f = 1 / ((n - 1) * (1 / r1 - 1 / r2 + (n - 1) * d / (n * r1 * r2)))
    by_r1, by_r2, by_d, by_n = (float(v) for v in torch.autograd.grad(f, (r1, r2, d, n)))
    # an error adds a share of |curvature| to the curvature: the front gets stronger, the back,
    # which is negative, weaker
    truth = {
        "curvature of surface 1": -by_r1 * 60 * 1e-3,
        "thickness behind surface 1": by_d * 0.02,
        "index behind surface 1": by_n * 5e-4,
        "curvature of surface 2": -by_r2 * 90 * 1e-3,
    }
    names = [e.name for e in errors_of(geo, t)]
    assert dict(zip(names, found, strict=True)) == pytest.approx(truth, rel=1e-12)


def test_analytic_sensitivities_agree_with_differences(triplet):
    figures = linear_figures(FIELD)
    exact = sensitivities(triplet, ALL, figures, by_autograd)
    close = sensitivities(triplet, ALL, figures)
    # central differences of a tenth of a deviation: changes bend by 1e-4 of themselves per
    # deviation, squared
    assert ((exact - close).abs().amax(1) <= 1e-6 * exact.abs().amax(1)).all()
    assert len(LINEAR_FIGURES) == exact.shape[0]


def test_a_decentred_thin_element_shifts_the_image_by_the_prism_it_makes():
    """Both surfaces of a thin lens shifted by s shift its axial image by s, whatever the lens."""
    thin = Surface(100.0, 1e-6, glass(1.5), 8.0, is_stop=True), Surface(-100.0, 100.0, None, 8.0)
    geo = GeoLens(thin, 2.0).freeze()
    t = Tolerances(decentre_mm=0.01)
    shifts = sensitivities(geo, t, linear_figures(0.05))[3:]
    pair = [e.name.endswith("in x") for e in errors_of(geo, t)]
    # aberration of an f/50 lens: (y / R)^2 = 1e-4 and its kin
    close(shifts[0, pair].sum(), 0.01, 2e-3)
    assert shifts[1, pair].abs().max() <= 1e-12


def test_linear_forecast_and_trials_agree(triplet):
    figures = linear_figures(FIELD)
    slopes = sensitivities(triplet, ALL, figures)
    trials = monte_carlo(triplet, ALL, figures, 400, seeded(0))
    found = compare(slopes, trials)
    assert trials.failed == 0
    # 400 trials know a standard deviation to 1 / sqrt(800) = 3.5 %: four such errors
    close(found.forecast / found.simulated, torch.ones(5, dtype=D), atol=0.14)
    # errors of a thousandth bend their effect by about as much
    assert found.correlation.min() >= 0.9999
    assert found.bias.abs().max() <= 4 / 400**0.5
    # a forecast of nothing has nothing to do with what trials change
    assert compare(0 * slopes, trials).correlation.tolist() == [0.0] * 5
    median = trials.figures.quantile(0.5, dim=0)
    close(trials.quantiles((0.5,))[0], median, 1e-12)


def test_a_refocus_takes_the_shift_of_the_image_plane_out(triplet):
    """With the image plane at the paraxial focus the back focal length still varies, but no error
    of the last thickness does."""
    t = Tolerances(radius_relative=1e-3)
    size = {}
    for compensate in (None, focus_paraxial):
        figures = sensitivities(triplet, t, linear_figures(FIELD), compensate=compensate)[:2]
        errors = sensitivities(triplet, t, spot_errors((0.0,)), compensate=compensate)
        size[compensate] = figures, errors.square().sum().item()
    close(size[None][0], size[focus_paraxial][0], 1e-9, atol=1e-12)
    # defocus is most of what radii do to an axial spot
    assert size[focus_paraxial][1] < 0.05 * size[None][1]


@pytest.mark.parametrize("refocus", [False, True])
def test_the_quadratic_forecast_of_the_spot_agrees_with_trials(triplet, refocus):
    compensate = partial(focus_rays, fields_rad=FIELDS, grid=8) if refocus else None
    figure = spot_errors(FIELDS, grid=8)
    slopes = sensitivities(triplet, ALL, figure, compensate=compensate)
    forecast = forecast_spot(compensated(figure, compensate)(triplet), slopes, 3)
    generator = seeded(1)

    def spots(faulty):
        return squared_spots(figure(faulty), 3)

    trials = monte_carlo(triplet, ALL, spots, 200, generator, compensate=compensate)
    predicted = forecast.at(trials.amounts)
    # lens by lens: what is left out is the bend of the rays, some 1 % of the spot here
    close(predicted.mean(0), trials.figures.mean(0), 0.02)
    for pair in zip(predicted.T, trials.figures.T, strict=True):
        assert torch.corrcoef(torch.stack(pair))[0, 1] >= 0.999
    # the slope alone forecasts much less than what happens to the axial spot, and says nothing of
    # the mean
    linear = trials.amounts @ forecast.linear.T
    if not refocus:
        assert linear[:, 0].std() < 0.6 * trials.figures[:, 0].std()
    assert forecast.nominal[0] < 0.95 * trials.figures[:, 0].mean()


def test_mean_and_deviation_of_the_quadratic_form_against_draws(triplet):
    figure = spot_errors(FIELDS, grid=8)
    forecast = forecast_spot(figure(triplet), sensitivities(triplet, ALL, figure), 3)
    drawn = forecast.at(randn64(seeded(0), 100_000, forecast.added.shape[1]))
    # 1e5 draws know the mean to 0.3 % of a deviation, and the deviation of a heavy-tailed square to
    # about 1 %
    added, deviation = forecast.moments()
    close(drawn.mean(0), forecast.nominal + added, 0.015)
    close(drawn.std(0), deviation, 0.04)
    close((drawn - forecast.nominal).mean(0), forecast.added.sum(1), 0.03)


def test_worst_offenders_share_the_whole_variance(triplet):
    slopes = sensitivities(triplet, ALL, linear_figures(FIELD))
    every = worst_offenders(triplet, ALL, slopes, 0, most=100)
    sizes = [abs(change) for _, change, _ in every]
    close(sum(share for *_, share in every), 1.0, 1e-12)
    assert sizes == sorted(sizes, reverse=True)
    # a lens of strong surfaces: the steepest radii lead, and decentres do not change the focal
    # length at first order
    assert every[0][0].startswith("curvature of surface")
    assert all(abs(change) <= 1e-12 for name, change, _ in every if "decentre" in name)


@pytest.mark.bits
def test_trials_repeat_and_failures_are_counted(triplet):
    def make(seed):
        return monte_carlo(triplet, ALL, efl, 5, seeded(seed))

    assert torch.equal(make(3).figures, make(3).figures)
    assert not torch.equal(make(3).figures, make(4).figures)
    calls = []

    def sometimes(geo):
        calls.append(geo)
        if len(calls) == 3:  # the nominal lens comes first
            raise DomainError("no ray arrives")
        return efl(geo)

    trials = monte_carlo(triplet, ALL, sometimes, 5, seeded(0))
    assert trials.failed == 1
    assert trials.figures.isnan().any(1).tolist() == [False, True, False, False, False]
    # of four: places 0.15, 1.5 and 2.85 among them
    good = trials.figures[[0, 2, 3, 4], 0].sort().values
    lower, upper = good[[0, 1, 2]], good[[1, 2, 3]]
    share = torch.tensor([0.15, 0.5, 0.85], dtype=good.dtype)
    close(trials.quantiles()[:, 0], lower + share * (upper - lower), 1e-14)


def test_tolerances_of_elements_move_them_as_bodies():
    geo = lens.load("double-gauss").freeze()
    errors = errors_of(
        geo, Tolerances(element_decentre_mm=0.01, element_tilt_deg=0.02, element_wedge_deg=0.03)
    )
    assert len(errors) == 6 * len(groups(geo)) == 24
    drawn = {
        "decentre of element 3-5 in x": 2.0,
        "tilt of element 3-5 about y": -1.0,
        "wedge of element 7-9 about x": 3.0,
    }
    assert drawn.keys() < {e.name for e in errors}
    found = perturbed(geo, errors, f64([drawn.get(e.name, 0.0) for e in errors]))
    wanted = moved_element(geo, (2, 4), [0.02, 0.0], [0.0, -math.radians(0.02)])
    wanted = moved_element(wanted, (6, 8), wedge_rad=[3 * math.radians(0.03), 0.0])
    for tensor in ("decentre_mm", "tilt_rad", "thickness_mm"):
        close(getattr(found, tensor), getattr(wanted, tensor), 1e-12, atol=1e-16)


@pytest.mark.parametrize(
    ("t", "first", "bent"),
    [
        # a plane keeps its radius but not its fringes; a stop in air has none of it
        (Tolerances(radius_relative=1e-3), "curvature", (2, 3, 4)),
        (Tolerances(fringes=1.0), "curvature", (1, 2, 3, 4)),
        (Tolerances(decentre_mm=0.1), "decentre", (1, 2, 3, 4)),
    ],
)
def test_stops_and_planes_have_less_to_get_wrong(t, first, bent):
    """At the d line a buried surface bends nothing, at other wavelengths it does; a stop in air
    never."""
    crown = Glass.from_indices(1.52, 1.51, 1.505, "crown")
    flint = Glass.from_indices(1.53, 1.51, 1.50, "flint")
    faces = (PLANE, 3.0, crown), (-40.0, 3.0, flint), (-90.0, 2.0, crown), (-80.0, 50.0, None)
    stop = Surface(PLANE, 5.0, None, 5.0, is_stop=True)
    geo = GeoLens([stop, *(Surface(*face, 8.0) for face in faces)], 8.0)
    found = errors_of(geo, t)
    assert {e.name.split()[0] for e in found} == {first}
    assert {e.at[0] for e in found} == set(bent)


TWO_FIELDS = (0.0, 0.3)
SHARE = 0.9
Z = NormalDist().inv_cdf(SHARE)
MOUNTED = Tolerances(
    radius_relative=1e-3, thickness_mm=0.02, element_decentre_mm=0.01, element_tilt_deg=0.02
)


def named(count):
    return [
        Error(f"curvature of surface {i + 1}", "curvature_per_mm", (i,), 0.5) for i in range(count)
    ]


def plain(slopes):
    return Forecast(3.0, slopes, torch.zeros(len(slopes), len(slopes), dtype=D))


@pytest.fixture
def slopes(generator):
    return rand64(generator, 6) + 0.1


def test_cheapest_tolerances_of_a_linear_figure(slopes):
    """Lagrange: s^(-2/3), scaled so that the root sum of squares is budget / z."""
    found = cheapest(plain(slopes), named(6), 0.2, SHARE)
    shape = slopes ** (-2 / 3)
    wanted = shape * (0.2 / Z) / torch.linalg.vector_norm(shape * slopes)
    close(found.factors, wanted, 1e-6)
    close(found.cost, (1 / wanted).sum(), 1e-6)
    # the same budget in equal parts, budget / z / sqrt(P) of a standard deviation each, costs more
    assert found.cost < (slopes * Z * math.sqrt(6) / 0.2).sum()
    close(found.shares.sum(), 1.0, 1e-12)
    close([e.deviation for e in found.errors], 0.5 * found.factors, 1e-12)


def test_the_share_of_one_square_is_that_of_chi_squared():
    """F = x^2: P(x^2 <= y) = erf(sqrt(y / 2)); a single square has the slowest characteristic
    function of all."""
    forecast = Forecast(0.0, torch.zeros(1, dtype=D), torch.ones(1, 1, dtype=D))
    for y in (0.5, 1.0, 2.7, 6.0):
        truth = math.erf(math.sqrt(y / 2))
        # the sum leaves off after 2048 terms that fall as k^-1.5: some 1e-4
        close(share_within(forecast, y, torch.ones(1, dtype=D)), truth, atol=3e-4)


def test_the_share_of_several_squares_and_of_a_slope():
    """Ten squares: chi squared of ten degrees, 1 - exp(-y/2) sum (y/2)^k / k! over k < 5; a slope:
    the normal."""
    ten = Forecast(0.0, torch.zeros(10, dtype=D), torch.eye(10, dtype=D))
    for y in (5.0, 12.0, 25.0):
        truth = 1 - math.exp(-y / 2) * sum((y / 2) ** k / math.factorial(k) for k in range(5))
        close(share_within(ten, y, torch.ones(10, dtype=D)), truth, atol=1e-9)
    one = plain(f64([2.0]))
    close(share_within(one, 3.0, f64([0.5])), NormalDist().cdf(3.0), atol=1e-9)
    assert share_within(one, 1e9, torch.ones(1, dtype=D)) == 1.0


@pytest.fixture(scope="module")
def spot():
    """Forecast of the refocused triplet's squared spot under mounted elements, and its errors."""
    geo = lens.load("cooke-triplet").freeze()
    compensate = partial(focus_rays, fields_rad=TWO_FIELDS, grid=6)
    figure = spot_errors(TWO_FIELDS, grid=6)
    slopes = sensitivities(geo, MOUNTED, figure, compensate=compensate)
    forecast = forecast_spot(
        compensated(figure, compensate)(geo), slopes, len(TWO_FIELDS)
    ).averaged()
    return errors_of(geo, MOUNTED), forecast


def test_ninety_percent_of_drawn_errors_keep_the_budget(spot, generator):
    errors, forecast = spot
    budget = 0.21 * forecast.nominal
    found = cheapest(forecast, errors, budget, SHARE)
    draws = randn64(generator, 200_000, len(errors)) * found.factors
    inside = (forecast.at(draws) - forecast.nominal <= budget).double().mean()
    # 2e5 draws know the share to 0.0007, four of which; x and y of a tolerance have one factor
    close(inside, SHARE, atol=0.003)
    ties = {e.drawn: f for e, f in zip(errors, found.factors.tolist(), strict=True)}
    assert [ties[e.drawn] for e in errors] == found.factors.tolist()


def test_the_cheapest_is_a_minimum(spot, generator):
    """Any other factors that keep the budget cost more."""
    errors, forecast = spot
    budget = 0.21 * forecast.nominal
    names = list(dict.fromkeys(e.drawn for e in errors))
    member = torch.tensor([names.index(e.drawn) for e in errors])
    found = cheapest(forecast, errors, budget, SHARE)
    best = torch.zeros(len(names), dtype=D).index_copy(0, member, found.factors)
    for _ in range(5):
        other = best * (0.2 * randn64(generator, len(names))).exp()
        low, high = 0.1, 10.0
        for _ in range(30):
            middle = math.sqrt(low * high)
            inside = share_within(forecast, budget, (other * middle)[member]) >= SHARE
            low, high = (middle, high) if inside else (low, middle)
        # at the minimum a change of 20 % costs its square; the normal approximation of the shape
        # costs far less
        assert (1 / (other * low)).sum() > found.cost * (1 + 1e-3)


def test_a_tolerance_that_does_not_matter_stays_at_the_largest_factor(slopes):
    slopes[2] = 0.0
    found = cheapest(plain(slopes), named(6), 0.2, most=4.0)
    assert found.factors[2] == found.factors.max() == 4.0


def test_a_forecast_in_float32_is_that_in_float64(slopes):
    forecast = Forecast(3.0, slopes.float(), torch.zeros(6, 6))
    wanted = cheapest(plain(slopes.float().double()), named(6), 0.2)
    close(cheapest(forecast, named(6), 0.2).factors, wanted.factors, 1e-12)
