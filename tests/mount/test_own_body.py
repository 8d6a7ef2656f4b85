"""The share of the picture that a robot's body covers, against areas, counted rays and
differences."""

import pytest
import torch

from codesign import lens, render
from codesign.mount import Body, Mount, OwnBody, judge, penalty
from codesign.mount.triangles import first_crossings

D = torch.float64


def sheet(low, high, at_m=2.0):
    (y, z), (far_y, far_z) = low, high
    corners = [(at_m, y, z), (at_m, far_y, z), (at_m, far_y, far_z), (at_m, y, far_z)]
    return Body([(corners, [(0, 1, 2), (0, 2, 3)])])


@pytest.fixture(scope="module")
def camera():
    """16 x 16 pixels of 1 / 80 of the distance: 0.4 m wide at 2 m."""
    return render.Camera(lens.Pinhole(8.0), 16, 16, 0.1, 64)


def at(position, **angles):
    return Mount(position, (0.0, 0.0, 0.0), **angles)().detach()


def test_a_sheet_covers_its_area(camera):
    # 0.111 by 0.2 m before a picture of 0.4 by 0.4 m
    required = OwnBody(sheet((-0.05, -0.1), (0.061, 0.1)), 0.5)
    share = 0.5 - float(required.slack(at((0.0, 0.0, 0.0)), camera))
    # an edge is met within one of 64 samples of a pixel: 0.02 px of its length, four edges of 4 to
    # 8 px
    assert share == pytest.approx(0.111 * 0.2 / 0.16, abs=0.003)
    # chief rays: 4 or 5 columns of 8 rows of 256
    assert round(256 * (0.5 - float(required.exact(at((0.0, 0.0, 0.0)), camera)))) in (32, 40)


def test_gradient_is_that_of_the_area(camera):
    """Nearer by dx the sheet at 2 m grows by 2 dx / 2 m of its area; to the side it stays."""
    required = OwnBody(sheet((-0.05, -0.1), (0.061, 0.1)), 0.5)
    pose = at((0.0, 0.0, 0.0)).requires_grad_()
    (slope,) = torch.autograd.grad(required.slack(pose, camera).sum(), pose)
    area = 0.111 * 0.2 / 0.16
    # silhouettes are sampled 2.5 times a pixel length: four edges, about 80 points
    assert -float(slope[0, 3]) == pytest.approx(area, rel=0.03)
    assert abs(float(slope[1, 3])) < 0.03 * area
    # pushed half out of the picture to the left, only its right edge moves: 0.2 m of height per
    # metre
    beside = at((0.0, -0.2, 0.0)).requires_grad_()
    (slope,) = torch.autograd.grad(required.slack(beside, camera).sum(), beside)
    assert float(slope[1, 3]) == pytest.approx(-0.2 / 0.16, rel=0.03)


def test_hits_are_those_of_the_triangles(rover):
    camera = render.Camera(lens.Pinhole(2.0), 24, 18, 0.15, 4)
    for pose in (at((0.1, 0.05, 0.5), pitch_rad=1.2), at((-0.1, 0.0, 0.6), pitch_rad=0.6)):
        rays = camera.chief_rays(camera.film.pixels())
        origin = pose[:3, 3] + rays.origin_m @ pose[:3, :3].T
        crossings = first_crossings(origin, rays.direction @ pose[:3, :3].T, rover.triangles)
        counted = crossings.isfinite().double().mean()
        assert 0.1 < float(counted) < 0.9
        # float32 geometry may decide a ray at an edge otherwise
        assert 1 - float(OwnBody(rover, 1.0).exact(pose, camera)) == pytest.approx(
            float(counted), abs=1.01 / 432
        )


def test_gradient_before_the_rover_is_that_of_differences(rover):
    """To the mount and to the focal length, against differences of a picture with many samples."""
    required = OwnBody(rover, 0.3)
    mount = Mount((-0.05, 0.02, 0.55), (0.1, 0.1, 0.1), pitch_rad=0.7)
    focal = torch.tensor(2.5, dtype=D)
    weight = torch.tensor([0.3, -0.4, 1.0, 0.5, 0.7, -0.2], dtype=D)

    def slack(numbers, efl_mm, samples, seed):
        camera = render.Camera(lens.Pinhole(efl_mm), 16, 12, 0.2, samples, seed)
        return required.slack(mount(numbers), camera).sum()

    numbers = torch.zeros(6, dtype=D, requires_grad=True)
    focal.requires_grad_()
    slopes = [
        torch.autograd.grad(slack(numbers, focal, 64, seed), (numbers, focal)) for seed in range(4)
    ]
    along = float(sum((slope[0] @ weight) for slope in slopes) / 4)
    zoom = float(sum(slope[1] for slope in slopes) / 4)
    with torch.no_grad():
        step = 0.02
        moved = [slack(sign * step * weight, focal, 4096, 7) for sign in (1, -1)]
        zoomed = [slack(0 * weight, focal + sign * step, 4096, 7) for sign in (1, -1)]
    # noise of the gradient 1.6 % a seed; the differences move by 0.2 % from this step to half of it
    assert along == pytest.approx(float(moved[0] - moved[1]) / (2 * step), rel=0.03)
    assert zoom == pytest.approx(float(zoomed[0] - zoomed[1]) / (2 * step), rel=0.03)


def test_it_is_a_requirement_like_any_other(rover):
    camera = render.Camera(lens.Pinhole(2.5), 16, 12, 0.2, 4)
    required = OwnBody(rover, 0.05)
    poses = torch.stack([at((0.2, 0.0, 0.5), pitch_rad=p) for p in (-0.5, 1.4)])
    clear, covered = required.exact(poses, camera)[:, 0].tolist()
    assert clear == 0.05
    assert covered < 0
    verdict = judge([required], poses[1], camera)[0]
    assert str(verdict).startswith("own body in view: missed by 0.")
    assert float(penalty([required], poses[0], camera)) == 0


def test_a_body_in_dark_corners_is_in_the_way_too():
    wide = render.Camera(lens.ThinLens(3.0, 1.0), 16, 16, 0.4, 4, falloff=True)
    everywhere = OwnBody(sheet((-9.0, -9.0), (9.0, 9.0)), 0.7)
    for found in (everywhere.slack, everywhere.exact):
        assert float(found(at((0.0, 0.0, 0.0)), wide)) == pytest.approx(-0.3, abs=1e-6)
