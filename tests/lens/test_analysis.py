"""Spot diagrams: pupil grid, gradients that follow the pupil, point images, and rays that fail."""

import math

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Surface
from codesign.lens.analysis import field_rays, pupil_grid
from tests.lens.systems import PLANE, check_gradient, glass

D = torch.float64


def test_the_pupil_grid_is_even_and_inside_the_disc():
    points = pupil_grid(32)
    # the number the references count
    assert points.shape == (812, 2)
    assert float(points.norm(dim=1).max()) <= 1
    torch.testing.assert_close(points.mean(0), torch.zeros(2, dtype=D), rtol=0, atol=1e-15)
    # a disc's; the rim is a staircase of 1/16
    assert float(points.square().sum(1).mean()) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("at_m", [0.4, math.inf])
@torch.no_grad()
def test_rays_come_from_one_point_and_cross_the_pupil_where_asked(at_m):
    geo = lens.load("double-gauss")
    pupil = pupil_grid(8)
    figures = geo.first_order()
    start, direction = field_rays(geo, 0.15, pupil, at_m=at_m)

    def crossing(z):
        return (start + direction * ((z - start[:, 2:]) / direction[:, 2:]))[:, :2]

    wanted = pupil * figures.entrance_pupil_diameter_mm / 2
    torch.testing.assert_close(crossing(figures.entrance_pupil_z_mm), wanted, rtol=0, atol=1e-13)
    if math.isinf(at_m):
        towards = torch.tensor([0, math.sin(0.15), math.cos(0.15)], dtype=D).expand_as(direction)
        assert torch.equal(direction, towards)
    else:
        # seen under the field angle
        point = torch.tensor([0.0, -400 * math.tan(0.15)], dtype=D).expand(len(pupil), 2)
        torch.testing.assert_close(crossing(figures.entrance_pupil_z_mm - 400.0), point, rtol=0, atol=1e-11)


def test_the_gradient_of_the_spot_follows_the_moving_pupil():
    # a gradient that held the rays still would be some per cent off
    geo = lens.load("cooke-triplet")
    fields = [0.0, math.radians(14.0)]
    check_gradient(
        lambda c, t: lens.rms_spot_mm(geo.replace(curvature_per_mm=c, thickness_mm=t), fields, grid=8).sum(),
        geo.curvature_per_mm,
        geo.thickness_mm,
        step=1e-5,
    )


def test_a_point_image_has_no_gradient_instead_of_nan():
    geo = lens.load("la1509")
    # one ray
    spot = lens.rms_spot_mm(geo, [0.0], grid=1)
    assert spot.item() == 0
    assert not torch.autograd.grad(spot.sum(), geo.curvature_per_mm)[0].any()


def test_failed_rays_do_not_count():
    # a plano-convex lens of 5 mm radius: rays beyond 5 mm miss it
    geo = GeoLens(
        [Surface(5.0, 3.0, glass(1.5), 4.9, is_stop=True), Surface(PLANE, 8.0, None, 4.9)], 20.0
    ).freeze()
    positions, weight = lens.spots(geo, [0.0], grid=16)
    height = (pupil_grid(16) * 10.0).norm(dim=1)
    assert torch.equal(weight[0] > 0, height < 5.0)
    kept = positions[0][height < 5.0]
    truth = (kept - kept.mean(0)).square().sum(1).mean().sqrt().item()
    assert lens.rms_spot_mm(geo, [0.0], grid=16).item() == pytest.approx(truth, rel=1e-12)


def test_replacing_and_freezing_leave_the_original_alone():
    geo = lens.load("la1509")
    twin = geo.replace(thickness_mm=geo.thickness_mm * 2)
    assert twin.thickness_mm.tolist() == [2 * t for t in geo.thickness_mm.tolist()]
    assert twin.curvature_per_mm is geo.curvature_per_mm
    assert [n for n, _ in geo.named_parameters()] == list(geo.parameter_names)
    (grad,) = torch.autograd.grad(twin.first_order().bfl_mm, geo.thickness_mm)
    # plano-convex: the principal plane moves by t / n
    assert grad[0].item() == pytest.approx(-2 / 1.516800035, rel=1e-9)
    geo.freeze("conic")
    assert [n for n, p in geo.named_parameters() if not p.requires_grad] == ["conic"]
