"""Spot diagrams: pupil grid, gradients that follow the pupil, point images, and fields where no ray
arrives."""

import math

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError, ShapeError
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.analysis import field_rays, pupil_grid

D = torch.float64
GLASS = Glass.from_indices(1.5, 1.5, 1.5)


def test_the_pupil_grid_is_even_and_inside_the_disc():
    points = pupil_grid(32)
    assert points.shape == (812, 2)  # the number the references count
    assert float(points.norm(dim=1).max()) <= 1
    torch.testing.assert_close(points.mean(0), torch.zeros(2, dtype=D), rtol=0, atol=1e-15)
    assert float(points.square().sum(1).mean()) == pytest.approx(
        0.5, abs=0.01
    )  # a disc's; the rim is a staircase of 1/16


def test_field_rays_pass_their_pupil_points():
    geo = lens.load("cooke-triplet")
    first = geo.first_order()
    pupil = pupil_grid(6)
    origin, direction = field_rays(geo, 0.2, pupil)
    at = origin + direction * ((first.entrance_pupil_z_mm - origin[:, 2:]) / direction[:, 2:])
    torch.testing.assert_close(at[:, :2], pupil * 5.0, rtol=0, atol=1e-13)
    torch.testing.assert_close(
        direction,
        torch.tensor([0, math.sin(0.2), math.cos(0.2)], dtype=D).expand_as(direction),
        rtol=0,
        atol=0,
    )


@pytest.mark.parametrize("name", ["curvature_per_mm", "thickness_mm"])
def test_the_gradient_of_the_spot_follows_the_moving_pupil(name):
    # differences move the lens and with it the entrance pupil; a gradient that held the rays still would be
    # some per cent off
    geo = lens.load("cooke-triplet")

    def loss(value):
        return lens.rms_spot_mm(geo.replace(**{name: value}), [0.0, math.radians(14.0)], grid=8).sum()

    value = getattr(geo, name).detach()
    leaf = value.clone().requires_grad_()
    (found,) = torch.autograd.grad(loss(leaf), leaf)
    size = 1e-6 * float(value.abs().mean())
    truth = torch.tensor(
        [
            float((loss(value + size * e) - loss(value - size * e)).detach()) / (2 * size)
            for e in torch.eye(6, dtype=D)
        ],
        dtype=D,
    )
    assert (
        float((found - truth).norm() / truth.norm()) <= 1e-6
    )  # rounding of 1e-15 mm over steps of 1e-6 relative; bend 1e-9


def test_a_point_image_has_no_gradient_instead_of_nan():
    geo = lens.load("la1509")
    spot = lens.rms_spot_mm(geo, [0.0], grid=1)  # one ray
    assert spot.item() == 0
    assert not torch.autograd.grad(spot.sum(), geo.curvature_per_mm)[0].any()


def test_failed_rays_do_not_count():
    # a plano-convex lens of 5 mm radius: rays beyond 5 mm miss it, the others are those of a narrower beam
    surfaces = [Surface(5.0, 3.0, GLASS, 4.9, is_stop=True), Surface(math.inf, 8.0, None, 4.9)]
    wide = GeoLens(surfaces, 20.0)
    narrow = GeoLens(surfaces, 20.0 * 4 / 16)
    # a 16 x 16 grid over 20 mm has the spacing of a 4 x 4 one over 5 mm; those that pass lie within the
    # stop's radius
    positions, weight = lens.spots(wide, [0.0], grid=16)
    height = (pupil_grid(16) * 10.0).norm(dim=1)
    assert torch.equal(weight[0] > 0, height < 5.0)
    inner, _ = lens.spots(narrow, [0.0], grid=4)
    assert inner.shape[1] == 12
    at_same = torch.isin(
        (pupil_grid(16) * 10).round(decimals=9)[:, 0], (pupil_grid(4) * 2.5).round(decimals=9)[:, 0]
    )
    assert bool(at_same.any())
    rms = lens.rms_spot_mm(wide, [0.0], grid=16)
    kept = positions[0][height < 5.0]
    assert rms.item() == pytest.approx(
        float((kept - kept.mean(0)).square().sum(1).mean().sqrt().detach()), rel=1e-12
    )


def test_a_field_without_rays_is_named():
    with pytest.raises(DomainError, match=r"cooke-triplet: no ray arrives at field \[85.0\] degrees"):
        lens.rms_spot_mm(lens.load("cooke-triplet"), [0.0, math.radians(85.0)])


def test_tensors_that_do_not_fit_are_refused():
    geo = lens.load("la1509")
    with pytest.raises(DomainError, match="no tensor 'radius'"):
        geo.replace(radius=torch.zeros(2))
    with pytest.raises(ShapeError, match=r"thickness_mm has shape \(2,\), got \(3,\)"):
        geo.replace(thickness_mm=torch.zeros(3))
    with pytest.raises(DomainError, match="no tensor 'thicknes_mm'"):
        geo.freeze("thicknes_mm")


def test_replacing_and_freezing_leave_the_original_alone():
    geo = lens.load("la1509")
    twin = geo.replace(thickness_mm=geo.thickness_mm * 2)
    assert twin.thickness_mm.tolist() == [2 * t for t in geo.thickness_mm.tolist()]
    assert twin.curvature_per_mm is geo.curvature_per_mm
    assert {n for n, _ in geo.named_parameters()} == {
        "curvature_per_mm",
        "thickness_mm",
        "conic",
        "asphere",
        "index_offset",
        "phase",
    }
    (grad,) = torch.autograd.grad(twin.first_order().bfl_mm, geo.thickness_mm)
    assert grad[0].item() == pytest.approx(
        -2 / 1.516800035, rel=1e-9
    )  # plano-convex: the principal plane moves by t / n
    geo.freeze("conic")
    assert [n for n, p in geo.named_parameters() if not p.requires_grad] == ["conic"]


def test_afocal_lenses_and_double_stops_are_refused():
    window = GeoLens([Surface(math.inf, 5.0, GLASS, 5.0), Surface(math.inf, 5.0, None, 5.0)], 3.0)
    with pytest.raises(DomainError, match="afocal"):
        window.first_order()
    with torch.no_grad():
        window.curvature_per_mm[0] = math.nan
    with pytest.raises(DomainError, match="no finite power"):
        window.first_order()
    with pytest.raises(DomainError, match=r"surfaces \[1, 2\] are all marked as the stop"):
        GeoLens(
            [Surface(50.0, 5.0, GLASS, 5.0, is_stop=True), Surface(-50.0, 5.0, None, 5.0, is_stop=True)], 3.0
        )
    with pytest.raises(DomainError, match="at least one surface"):
        GeoLens([], 3.0)
