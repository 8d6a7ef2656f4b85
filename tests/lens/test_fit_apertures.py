"""Semi-apertures that follow the rays, against straight rays in air and what the trace itself clips."""

import math

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError, ShapeError
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.design import fit_apertures
from codesign.lens.design.hits import rim_rays

INF = math.inf
D = torch.float64


def planes(gap_mm=20.0, pupil_mm=6.0):
    """A stop in air, a plane behind it, and a lens far behind that only makes it a lens."""
    return GeoLens(
        [
            Surface(INF, gap_mm, None, 50.0, is_stop=True),
            Surface(INF, 1.0, None, 50.0),
            Surface(80.0, 1.0, Glass.named("N-BK7"), 50.0),
            Surface(-80.0, 70.0, None, 50.0),
        ],
        pupil_mm,
    ).freeze()


def test_parallel_light_widens_by_the_field_alone():
    found = fit_apertures(planes(), (0.0, 0.3), margin=0.1).semi_aperture_mm
    assert float(found[0]) == pytest.approx(3.0 * 1.1, rel=1e-12)
    assert float(found[1]) == pytest.approx((3.0 + 20.0 * math.tan(0.3)) * 1.1, rel=1e-12)


def test_light_of_a_near_point_widens_by_its_own_cone():
    found = fit_apertures(planes(), (0.0,), at_m=(INF, 0.1), margin=0.0).semi_aperture_mm
    assert float(found[1]) == pytest.approx(3.0 * (1 + 20.0 / 100.0), rel=1e-12)


@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss"])
def test_the_full_pupil_passes_and_nothing_more(name):
    geo = lens.load(name).freeze()
    fields = (0.0, 0.1, 0.2)
    rays = rim_rays(geo, fields)
    fitted = fit_apertures(geo, fields, margin=1e-6)
    assert bool(fitted.trace(*rays).inside.all())
    for surface in range(len(geo.surfaces)):
        less = fitted.semi_aperture_mm.clone()
        less[surface] *= 1 - 1e-5
        assert not bool(geo.replace(semi_aperture_mm=less).trace(*rays).inside.all())


def test_semi_apertures_are_differentiable(generator):
    geo = lens.load("cooke-triplet").freeze()
    weights = torch.randn(6, dtype=D, generator=generator)

    def total(c, t):
        fitted = fit_apertures(geo.replace(curvature_per_mm=c, thickness_mm=t), (0.0, 0.3))
        return (fitted.semi_aperture_mm * weights).sum()

    c, t = (v.clone().requires_grad_() for v in (geo.curvature_per_mm, geo.thickness_mm))
    found = torch.cat(torch.autograd.grad(total(c, t), (c, t)))
    start = torch.cat([c, t]).detach()
    step = torch.cat([torch.full((6,), 1e-6, dtype=D), torch.full((6,), 1e-4, dtype=D)])
    for i in range(12):
        by = torch.zeros(12, dtype=D)
        by[i] = step[i]
        ahead, behind = (total(*(start + s * by).split(6)) for s in (1, -1))
        # second differences of heights: 1e-8 of the slope; rounding 1e-15 over the step
        truth = float((ahead - behind) / (2 * step[i]))
        assert float(found[i]) == pytest.approx(truth, rel=1e-6, abs=1e-8)


def test_a_sphere_ends_at_its_radius():
    ball = GeoLens(
        [
            Surface(5.0, 10.0, Glass.from_indices(1.2, 1.2, 1.2), 4.0, is_stop=True),
            Surface(-5.0, 5.0, None, 4.0),
        ],
        9.8,
    ).freeze()
    fitted = fit_apertures(ball, (0.0,), margin=0.05)
    assert float(fitted.semi_aperture_mm[0]) == pytest.approx(5.0, rel=1e-8)
    assert float(fitted.semi_aperture_mm[0]) < 5.0
    assert GeoLens(fitted.to_surfaces(), 9.8).surfaces[0].semi_aperture_mm == float(
        fitted.semi_aperture_mm[0]
    )


def test_fitted_apertures_go_into_files_and_scaled_lenses(tmp_path):
    fitted = fit_apertures(lens.load("cooke-triplet").freeze(), (0.0, 0.3))
    lens.save(fitted, tmp_path / "fitted.json")
    assert torch.equal(lens.load(tmp_path / "fitted.json").semi_aperture_mm, fitted.semi_aperture_mm)
    torch.testing.assert_close(fitted.scaled(2.0).semi_aperture_mm, 2 * fitted.semi_aperture_mm)


def test_rays_that_fail_and_wrong_shapes_are_refused():
    geo = lens.load("cooke-triplet").freeze()
    with pytest.raises(DomainError, match="rim rays fail, so its apertures cannot be sized"):
        fit_apertures(geo, (1.2,))
    for margin in (-2.0, math.nan, INF):
        with pytest.raises(DomainError, match="give a finite number of at least 0"):
            fit_apertures(geo, (0.1,), margin=margin)
    with pytest.raises(ShapeError, match="semi_aperture_mm has shape"):
        geo.replace(semi_aperture_mm=torch.ones(3, dtype=D))
