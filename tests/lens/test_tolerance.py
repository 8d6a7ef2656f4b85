"""Tolerances against closed forms, the statistics of normal errors, and trials of the lens itself."""

import math
from functools import partial

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError, ShapeError
from codesign.grad.jacobian import by_autograd
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.design import groups, moved_element
from codesign.lens.design.solves import focus_paraxial, focus_rays
from codesign.lens.design.tolerance import (
    LINEAR_FIGURES,
    compare,
    compensated,
    linear_figures,
    monte_carlo,
    sensitivities,
    worst_offenders,
)
from codesign.lens.design.tolerance_errors import Error, Tolerances, errors_of, perturbed
from codesign.lens.design.tolerance_spot import forecast_spot, spot_errors, squared_spots

D = torch.float64
FIELD = math.radians(20)
FIELDS = (0.0, 0.7 * FIELD, FIELD)
ALL = Tolerances(radius_relative=1e-3, thickness_mm=0.02, index=5e-4, decentre_mm=0.01, tilt_deg=0.02)


@pytest.fixture(scope="module")
def triplet():
    return lens.load("cooke-triplet").freeze()


def singlet():
    return GeoLens(
        [
            Surface(60.0, 5.0, Glass.from_indices(1.5, 1.5, 1.5), 8.0, is_stop=True),
            Surface(-90.0, 70.0, None, 8.0),
        ],
        10.0,
    ).freeze()


def test_a_surface_between_equal_glasses_can_be_wrong():
    """At the d line a buried surface bends nothing, at other wavelengths it does; a stop in air never."""
    crown = Glass.from_indices(1.52, 1.51, 1.505, "crown")
    flint = Glass.from_indices(1.53, 1.51, 1.50, "flint")
    geo = GeoLens(
        [
            Surface(50.0, 3.0, crown, 8.0),
            Surface(-40.0, 3.0, flint, 8.0),
            Surface(-90.0, 2.0, None, 8.0),
            Surface(math.inf, 50.0, None, 5.0, is_stop=True),
        ],
        8.0,
    )
    names = [e.name for e in errors_of(geo, Tolerances(radius_relative=1e-3, fringes=1.0))]
    assert names == [f"curvature of surface {i}" for i in (1, 2, 3)]


def efl(geo):
    return geo.first_order().efl_mm.reshape(1)


def test_the_errors_of_a_lens_by_name_and_size():
    found = {
        e.name: e
        for e in errors_of(
            singlet(),
            Tolerances(
                radius_relative=1e-3,
                radius_mm=0.1,
                fringes=2.0,
                thickness_mm=0.02,
                index=1e-4,
                decentre_mm=0.01,
                tilt_deg=0.1,
            ),
        )
    }
    assert (
        len(found) == 2 + 1 + 1 + 4 + 4
    )  # curvatures, a thickness (the last is the focus), an index, decentres, tilts
    c = 1 / 60
    assert found["curvature of surface 1"].deviation == pytest.approx(
        math.hypot(c * 1e-3, c * c * 0.1, 2 * 546.074e-6 / 64), rel=1e-12
    )
    assert found["thickness behind surface 1"] == Error(
        "thickness behind surface 1", "thickness_mm", (0,), 0.02
    )
    assert found["tilt of surface 2 about y"].at == (1, 1)
    assert found["tilt of surface 2 about y"].deviation == pytest.approx(math.radians(0.1), rel=1e-15)


def test_fringes_are_half_wavelengths_of_sag():
    """N rings mean that the sag at the edge is off by N half wavelengths."""
    geo = singlet()
    rings = 3.0
    error = errors_of(geo, Tolerances(fringes=rings))[0]

    def sag(curvature):
        return (1 - math.sqrt(1 - (curvature * 8) ** 2)) / curvature

    change = sag(1 / 60 + error.deviation) - sag(1 / 60)
    assert change == pytest.approx(
        rings * 546.074e-6 / 2, rel=0.03
    )  # a^2 / 2 is the first term of the sag: a^2 / R^2 = 2 % off in slope


def test_a_stop_in_air_and_a_plane_have_no_radius_to_get_wrong():
    geo = GeoLens(
        [
            Surface(math.inf, 2.0, None, 5.0, is_stop=True),
            Surface(math.inf, 4.0, Glass.named("N-BK7"), 8.0),
            Surface(-40.0, 70.0, None, 8.0),
        ],
        8.0,
    ).freeze()
    assert [e.name for e in errors_of(geo, Tolerances(radius_relative=1e-3))] == ["curvature of surface 3"]
    assert [e.name for e in errors_of(geo, Tolerances(fringes=1.0))] == [
        "curvature of surface 2",
        "curvature of surface 3",
    ]
    assert {e.at[0] for e in errors_of(geo, Tolerances(decentre_mm=0.1))} == {1, 2}


def test_the_perturbed_lens_has_the_errors_and_nothing_else(triplet):
    errors = errors_of(triplet, ALL)
    amounts = torch.zeros(len(errors), dtype=D)
    at = next(k for k, e in enumerate(errors) if e.name == "decentre of surface 3 in y")
    amounts[at] = 2.0
    faulty = perturbed(triplet, errors, amounts)
    assert float(faulty.decentre_mm[2, 1]) == pytest.approx(0.02, rel=1e-14)
    assert int((faulty.decentre_mm != 0).sum()) == 1
    for name in ("curvature_per_mm", "thickness_mm", "index_offset", "tilt_rad"):
        assert torch.equal(getattr(faulty, name), getattr(triplet, name))
    with pytest.raises(ShapeError, match="38 errors"):
        perturbed(triplet, errors, amounts[:-1])


def test_sensitivities_of_the_focal_length_by_the_lens_makers_equation():
    geo = singlet()
    t = Tolerances(radius_relative=1e-3, thickness_mm=0.02, index=5e-4)
    found = sensitivities(geo, t, efl, by_autograd)[0]

    def f(r1, r2, d, n):
        return 1 / ((n - 1) * (1 / r1 - 1 / r2 + (n - 1) * d / (n * r1 * r2)))

    step = 1e-4  # central differences of the formula: bend 1e-8, rounding 1e-11

    def change(**by):
        return f(**{k: v + by.get(k, 0.0) for k, v in (("r1", 60.0), ("r2", -90.0), ("d", 5.0), ("n", 1.5))})

    def slope(key):
        return (change(**{key: step}) - change(**{key: -step})) / (2 * step)

    # an error adds a share of |curvature| to the curvature: the front gets stronger, the back, which is
    # negative, weaker
    truth = {
        "curvature of surface 1": -slope("r1") * 60 * 1e-3,
        "thickness behind surface 1": slope("d") * 0.02,
        "index behind surface 1": slope("n") * 5e-4,
        "curvature of surface 2": -slope("r2") * 90 * 1e-3,
    }
    assert dict(zip((e.name for e in errors_of(geo, t)), found.tolist(), strict=True)) == {
        name: pytest.approx(value, rel=1e-6) for name, value in truth.items()
    }


def test_analytic_sensitivities_agree_with_differences(triplet):
    figures = linear_figures(FIELD)
    exact = sensitivities(triplet, ALL, figures, by_autograd)
    close = sensitivities(triplet, ALL, figures)
    # central differences of a tenth of a deviation: changes bend by 1e-4 of themselves per deviation, squared
    assert bool(((exact - close).abs().amax(1) <= 1e-6 * exact.abs().amax(1)).all())
    assert len(LINEAR_FIGURES) == exact.shape[0]


def test_a_decentred_thin_element_shifts_the_image_by_the_prism_it_makes():
    """Both surfaces of a thin lens shifted by s shift its axial image by s, whatever the lens."""
    geo = GeoLens(
        [
            Surface(100.0, 1e-6, Glass.from_indices(1.5, 1.5, 1.5), 8.0, is_stop=True),
            Surface(-100.0, 100.0, None, 8.0),
        ],
        2.0,
    ).freeze()
    t = Tolerances(decentre_mm=0.01)
    slopes = sensitivities(geo, t, linear_figures(0.05))
    names = [e.name for e in errors_of(geo, t)]
    pair = [names.index(f"decentre of surface {i} in x") for i in (1, 2)]
    assert float(slopes[3, pair].sum()) == pytest.approx(
        0.01, rel=2e-3
    )  # aberration of an f/50 lens: (y / R)^2 = 1e-4 and its kin
    assert float(slopes[4, pair].abs().max()) <= 1e-12


def test_linear_forecast_and_trials_agree(triplet):
    figures = linear_figures(FIELD)
    slopes = sensitivities(triplet, ALL, figures)
    trials = monte_carlo(triplet, ALL, figures, 400, torch.Generator().manual_seed(0))
    found = compare(slopes, trials)
    assert trials.failed == 0
    # 400 trials know a standard deviation to 1 / sqrt(800) = 3.5 %: four such errors
    torch.testing.assert_close(found.forecast / found.simulated, torch.ones(5, dtype=D), rtol=0, atol=0.14)
    # errors of a thousandth bend their effect by about as much
    assert float(found.correlation.min()) >= 0.9999
    assert float(found.bias.abs().max()) <= 4 / 400**0.5
    quantiles = trials.quantiles((0.5,))[0]
    torch.testing.assert_close(quantiles, trials.figures.median(0).values, rtol=0.01, atol=1e-3)


def test_a_refocus_takes_the_shift_of_the_image_plane_out(triplet):
    """With the image plane at the paraxial focus the back focal length still varies, but no error of the last
    thickness does."""
    figures = linear_figures(FIELD)
    t = Tolerances(radius_relative=1e-3)
    plain = sensitivities(triplet, t, figures)
    solved = sensitivities(triplet, t, figures, compensate=focus_paraxial)
    torch.testing.assert_close(plain[:2], solved[:2], rtol=1e-9, atol=1e-12)
    fixed, refocused = (
        squared_spots(
            sensitivities(triplet, t, spot_errors((0.0,)), compensate=c).square().sum(1).sqrt(), 1
        ).item()
        for c in (None, focus_paraxial)
    )
    assert refocused < 0.05 * fixed  # defocus is most of what radii do to an axial spot


@pytest.mark.parametrize("refocus", [False, True])
def test_the_quadratic_forecast_of_the_spot_agrees_with_trials(triplet, refocus):
    compensate = partial(focus_rays, fields_rad=FIELDS, grid=8) if refocus else None
    figure = spot_errors(FIELDS, grid=8)
    nominal = compensated(figure, compensate)(triplet)
    forecast = forecast_spot(nominal, sensitivities(triplet, ALL, figure, compensate=compensate), 3)
    trials = monte_carlo(
        triplet,
        ALL,
        lambda faulty: squared_spots(figure(faulty), 3),
        200,
        torch.Generator().manual_seed(1),
        compensate=compensate,
    )
    predicted = forecast.at(trials.amounts)
    # lens by lens: what is left out is the bend of the rays, some 1 % of the spot here
    torch.testing.assert_close(predicted.mean(0), trials.figures.mean(0), rtol=0.02, atol=0)
    for f in range(3):
        assert float(torch.corrcoef(torch.stack([predicted[:, f], trials.figures[:, f]]))[0, 1]) >= 0.999
    # the slope alone forecasts much less than what happens to the axial spot, and says nothing of the mean
    linear = trials.amounts @ forecast.linear.T
    if not refocus:
        assert float(linear[:, 0].std()) < 0.6 * float(trials.figures[:, 0].std())
    assert float(forecast.nominal[0]) < 0.95 * float(trials.figures[:, 0].mean())


def test_mean_and_deviation_of_the_quadratic_form_against_draws(triplet):
    figure = spot_errors(FIELDS, grid=8)
    forecast = forecast_spot(figure(triplet), sensitivities(triplet, ALL, figure), 3)
    drawn = forecast.at(
        torch.randn(100_000, forecast.added.shape[1], generator=torch.Generator().manual_seed(0), dtype=D)
    )
    # 1e5 draws know the mean to 0.3 % of a deviation, and the deviation of a heavy-tailed square to about 1 %
    torch.testing.assert_close(drawn.mean(0), forecast.mean, rtol=0.015, atol=0)
    torch.testing.assert_close(drawn.std(0), forecast.deviation, rtol=0.04, atol=0)
    torch.testing.assert_close((drawn - forecast.nominal).mean(0), forecast.added.sum(1), rtol=0.03, atol=0)


def test_the_nominal_spot_is_the_traced_one(triplet):
    figure = spot_errors(FIELDS, grid=32)
    truth = lens.rms_spot_mm(triplet, FIELDS, grid=32).square()
    torch.testing.assert_close(squared_spots(figure(triplet), 3), truth, rtol=1e-12, atol=0)


def test_worst_offenders_share_the_whole_variance(triplet):
    slopes = sensitivities(triplet, ALL, linear_figures(FIELD))
    every = worst_offenders(triplet, ALL, slopes, 0, most=100)
    assert sum(share for *_, share in every) == pytest.approx(1.0, rel=1e-12)
    assert [abs(change) for _, change, _ in every] == sorted(
        (abs(change) for _, change, _ in every), reverse=True
    )
    # a lens of strong surfaces: the steepest radii lead, and decentres do not change the focal length at
    # first order
    assert every[0][0].startswith("curvature of surface")
    assert all(abs(change) <= 1e-12 for name, change, _ in every if "decentre" in name)


@pytest.mark.bits
def test_trials_repeat_and_failures_are_counted(triplet):
    def make(seed):
        return monte_carlo(triplet, ALL, efl, 5, torch.Generator().manual_seed(seed))

    assert torch.equal(make(3).figures, make(3).figures)
    assert not torch.equal(make(3).figures, make(4).figures)
    calls = []

    def sometimes(geo):
        calls.append(geo)
        if len(calls) == 3:  # the nominal lens comes first
            raise DomainError("no ray arrives")
        return efl(geo)

    trials = monte_carlo(triplet, ALL, sometimes, 5, torch.Generator().manual_seed(0))
    assert trials.failed == 1
    assert trials.figures.isnan().any(1).tolist() == [False, True, False, False, False]
    assert bool(trials.quantiles().isfinite().all())


def test_wrong_input_is_refused(triplet):
    with pytest.raises(DomainError, match="index is -1"):
        Tolerances(index=-1.0)
    with pytest.raises(DomainError, match="nothing varies"):
        Tolerances()
    with pytest.raises(DomainError, match="at least 1"):
        monte_carlo(triplet, ALL, efl, 0, torch.Generator())
    with pytest.raises(DomainError, match="too few"):
        compare(
            torch.zeros(1, 38, dtype=D), monte_carlo(triplet, ALL, efl, 2, torch.Generator().manual_seed(0))
        )


def test_tolerances_of_elements_move_them_as_bodies():
    geo = lens.load("double-gauss").freeze()
    t = Tolerances(element_decentre_mm=0.01, element_tilt_deg=0.02, element_wedge_deg=0.03)
    errors = errors_of(geo, t)
    assert [e.name for e in errors[:6]] == [
        "decentre of element 1-2 in x",
        "decentre of element 1-2 in y",
        "tilt of element 1-2 about x",
        "tilt of element 1-2 about y",
        "wedge of element 1-2 about x",
        "wedge of element 1-2 about y",
    ]
    assert len(errors) == 6 * len(groups(geo)) == 24
    amounts = torch.zeros(24, dtype=D)
    amounts[[6, 9, 16]] = torch.tensor([2.0, -1.0, 3.0], dtype=D)
    assert [errors[k].name for k in (6, 9, 16)] == [
        "decentre of element 3-5 in x",
        "tilt of element 3-5 about y",
        "wedge of element 7-9 about x",
    ]
    wanted = moved_element(
        geo, (2, 4), torch.tensor([0.02, 0.0], dtype=D), torch.tensor([0.0, -math.radians(0.02)], dtype=D)
    )
    wanted = moved_element(wanted, (6, 8), wedge_rad=torch.tensor([3 * math.radians(0.03), 0.0], dtype=D))
    found = perturbed(geo, errors, amounts)
    for tensor in ("decentre_mm", "tilt_rad", "thickness_mm"):
        torch.testing.assert_close(getattr(found, tensor), getattr(wanted, tensor), rtol=1e-12, atol=1e-16)
