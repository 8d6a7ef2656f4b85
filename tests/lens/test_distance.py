"""Objects at a distance: where their rays start, several at once, the limit of parallel light, gradients, focus."""

import math

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError, ShapeError
from codesign.lens.analysis import field_rays, pupil_grid
from codesign.lens.design import focus_paraxial, focus_rays

D = torch.float64
FIELDS = (0.0, 0.15)


@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss", "la1509"])
@torch.no_grad()
def test_rays_come_from_one_point_and_cross_the_pupil_where_asked(name):
    geo = lens.load(name)
    pupil = pupil_grid(8)
    figures = geo.first_order()
    start, direction = field_rays(geo, 0.15, pupil, at_m=0.4)
    at_pupil = start + direction * ((figures.entrance_pupil_z_mm - start[:, 2:]) / direction[:, 2:])
    wanted = pupil * figures.entrance_pupil_diameter_mm / 2
    torch.testing.assert_close(at_pupil[:, :2], wanted, rtol=0, atol=1e-13)
    back = start + direction * ((figures.entrance_pupil_z_mm - 400.0 - start[:, 2:]) / direction[:, 2:])
    point = torch.tensor([0.0, -400 * math.tan(0.15)], dtype=D)  # seen under the field angle
    torch.testing.assert_close(back[:, :2], point.expand(len(pupil), 2), rtol=0, atol=1e-11)


@torch.no_grad()
def test_several_distances_are_one_trace_and_equal_each_alone(monkeypatch):
    geo = lens.load("double-gauss").focus_at(0.7)
    distances = (0.3, 0.7, math.inf)
    alone = torch.stack([lens.rms_spot_mm(geo, FIELDS, at_m=d) for d in distances])
    traces = []
    trace = lens.GeoLens.trace
    monkeypatch.setattr(lens.GeoLens, "trace", lambda *of: traces.append(of) or trace(*of))
    together = lens.rms_spot_mm(geo, FIELDS, at_m=distances)
    assert len(traces) == 1
    torch.testing.assert_close(together, alone, rtol=1e-12, atol=0)
    torch.testing.assert_close(lens.rms_spot_mm(geo, FIELDS), alone[-1], rtol=1e-12, atol=0)


@torch.no_grad()
def test_parallel_light_is_the_limit():
    geo = lens.load("cooke-triplet")
    parallel, *far = lens.spots(geo, FIELDS, at_m=[math.inf, 1e6, 1e7])[0]
    errors = [float((p - parallel).abs().max()) for p in far]
    assert errors[1] < 1e-5
    assert errors[0] == pytest.approx(10 * errors[1], rel=1e-3)  # an error goes as 1 / distance


def test_gradient_to_the_distance_is_that_of_differences():
    geo = lens.load("cooke-triplet")
    at_m = torch.tensor([0.5, 2.0], dtype=D, requires_grad=True)
    lens.rms_spot_mm(geo, FIELDS, at_m=at_m).sum().backward()
    step = 1e-5
    with torch.no_grad():
        up, down = (lens.rms_spot_mm(geo, FIELDS, at_m=at_m + s).sum(1) for s in (step, -step))
    torch.testing.assert_close(at_m.grad, (up - down) / (2 * step), rtol=1e-8, atol=0)


def test_solves_at_a_distance():
    geo = lens.load("cooke-triplet")
    for at_m in (0.5, 3.0, math.inf):
        paraxial = focus_paraxial(geo, at_m=at_m).thickness_mm[-1]
        assert float(paraxial.detach()) == pytest.approx(
            float(geo.focus_at(at_m).thickness_mm[-1].detach()), rel=1e-14
        )
        sharp = focus_rays(geo, (0.0,), at_m=at_m).thickness_mm[-1]
        assert float(sharp.detach()) == pytest.approx(
            float(geo.focus_at(at_m, spot_grid=16).thickness_mm[-1].detach()), rel=1e-12
        )
    distances = (0.5, 0.6)
    shared = focus_rays(geo, FIELDS, at_m=distances)

    def mean_square(shift):
        moved = shared.replace(
            thickness_mm=shared.thickness_mm + shift * torch.eye(len(geo.surfaces), dtype=D)[-1]
        )
        return float(lens.rms_spot_mm(moved, FIELDS, grid=16, at_m=distances).detach().square().mean())

    here, less, more = map(mean_square, (0.0, -0.01, 0.01))
    assert here < min(less, more)
    assert less == pytest.approx(more, rel=1e-9)  # a parabola about its least


@pytest.mark.parametrize("bad", [-1.0, 0.0, math.nan, 0.004, (1.0, -2.0), -math.inf])
def test_distances_that_cannot_be_get_a_sentence(bad):
    geo = lens.load("cooke-triplet")
    for call in (
        lambda: lens.rms_spot_mm(geo, FIELDS, at_m=bad),
        lambda: focus_rays(geo, FIELDS, at_m=bad),
    ):
        with pytest.raises(DomainError, match=r"not lie before the lens; give distances above 0\.01"):
            call()
    with pytest.raises(ShapeError, match="one number or a list"):
        lens.spots(geo, FIELDS, at_m=[[1.0]])
