"""System matrix, cardinal points, paraxial rays and defocus against closed forms."""

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Surface
from codesign.lens.paraxial import (
    cardinal_points,
    first_order,
    paraxial_rays,
    system_matrix,
)
from tests.lens.systems import NAMES, glass

D = torch.float64


def thick(radius_a=60.0, radius_b=-90.0, thickness=8.0, n=1.6):
    surfaces = Surface(radius_a, thickness, glass(n), 9.0, is_stop=True), Surface(radius_b, 50.0, None, 9.0)
    return GeoLens(surfaces, 10.0)


def test_matrix_of_a_thick_lens():
    n = 1.6
    t = 8.0
    a = (n - 1) / 60.0
    b = (1 - n) / -90.0
    # Gullstrand
    truth = torch.tensor([[1 - a * t / n, t / n], [-(a + b - a * b * t / n), 1 - b * t / n]], dtype=D)
    torch.testing.assert_close(system_matrix(thick()).detach(), truth, rtol=1e-14, atol=1e-16)


@pytest.mark.parametrize("name", NAMES)
@torch.no_grad()
def test_the_matrix_keeps_the_invariant(name):
    geo = lens.load(name)
    assert torch.linalg.det(system_matrix(geo)).item() == pytest.approx(1, abs=1e-13)
    first = geo.first_order()
    assert cardinal_points(geo).rear_focal_z_mm.item() == pytest.approx(first.bfl_mm.item(), rel=1e-13)
    rays = paraxial_rays(geo, 0.2)
    y, y_bar = rays.marginal_height_mm, rays.chief_height_mm
    behind = geo.index()[1:] * (rays.chief_angle[1:] * y - rays.marginal_angle[1:] * y_bar)
    torch.testing.assert_close(behind, rays.invariant_mm.expand_as(behind), rtol=1e-12, atol=0)
    assert y_bar[geo.stop_index].abs().item() <= 1e-12
    stop = first.stop_semi_aperture_mm.item()
    assert y[geo.stop_index].abs().item() == pytest.approx(stop, rel=1e-12)


def test_cardinal_points_of_a_ball_in_air():
    # both principal and both nodal points of a ball lie in its centre; f = n R / 2 (n - 1)
    R, n = 10.0, 1.5
    points = cardinal_points(thick(R, -R, 2 * R, n))
    found = values(points, "front_principal_z_mm front_nodal_z_mm rear_principal_z_mm rear_nodal_z_mm")
    assert found == pytest.approx([R, R, -R, -R], rel=1e-13)
    assert points.rear_focal_length_mm.item() == pytest.approx(n * R / (2 * (n - 1)), rel=1e-13)


def test_an_eye_has_its_nodal_points_apart_from_its_principal_points():
    # one refracting surface into n': principal points on it, nodal points in its centre, focal lengths R /
    # (n' - 1) and n' R / (n' - 1)
    R, n = 5.55, 4 / 3
    points = cardinal_points(GeoLens([Surface(R, 22.2, glass(n), 3.0, is_stop=True)], 3.0))
    names = "front_principal_z_mm rear_principal_z_mm front_nodal_z_mm rear_nodal_z_mm"
    assert values(points, names) == pytest.approx([0, 0, R, R], rel=1e-12, abs=1e-13)
    found = values(points, "front_focal_length_mm rear_focal_z_mm front_focal_z_mm")
    assert found == pytest.approx([R / (n - 1), n * R / (n - 1), -R / (n - 1)], rel=1e-13)


@pytest.mark.parametrize("before", [1.0, 4 / 3])
def test_pupils_of_a_stop_between_two_surfaces_by_gauss(before):
    # n' / s' - n / s = power at each surface, s and s' of the stop and its image from the vertex; the image
    # is n s' / (n' s) times as large
    n = 1.6
    after = 1.2
    front, back = 6.0, 9.0
    powers = [(n - before) / 40.0, (after - n) / -25.0]
    entrance = before / (n / front - powers[0])
    exit_z = after / (powers[1] - n / back)
    found = first_order(
        torch.tensor([powers[0], 0.0, powers[1]], dtype=D),
        torch.tensor([front, back, 50.0], dtype=D),
        torch.tensor([before, n, n, after], dtype=D),
        1,
        10.0,
    )
    stop = 5.0 / abs(n * entrance / (before * front))
    assert float(found.entrance_pupil_z_mm) == pytest.approx(entrance, rel=1e-13)
    assert float(found.stop_semi_aperture_mm) == pytest.approx(stop, rel=1e-13)
    assert float(found.exit_pupil_z_mm) == pytest.approx(exit_z, rel=1e-13)
    size = abs(n * exit_z / (after * back))
    assert float(found.exit_pupil_diameter_mm) == pytest.approx(2 * stop * size, rel=1e-13)


def test_gradients_of_paraxial_figures():
    start = thick().freeze()

    def figures(curvature, thickness):
        geo = start.replace(curvature_per_mm=curvature, thickness_mm=thickness)
        rays = paraxial_rays(geo, 0.2)
        lengths = cardinal_points(geo).front_nodal_z_mm, geo.thin().image_distance_mm
        return system_matrix(geo), rays.chief_angle, rays.marginal_height_mm, *lengths

    leaves = [v.clone().requires_grad_() for v in (start.curvature_per_mm, start.thickness_mm)]
    assert torch.autograd.gradcheck(figures, leaves, eps=1e-7, atol=1e-5, rtol=1e-5)


def values(points, names):
    return [getattr(points, name).item() for name in names.split()]
