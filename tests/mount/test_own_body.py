"""The share of the picture that a robot's body covers, against areas, counted rays and
differences."""

import pytest
import torch

from codesign import lens, render
from codesign.mount import Body, Mount, OwnBody, judge, penalty
from codesign.mount.triangles import first_crossings
from tests.numbers import D, f64


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


def test_gradient_is_that_of_the_area():
    """Nearer by dx the sheet at 2 m grows by 2 dx / 2 m of its area, through a lens longer by df by
    2 df / 8 mm; to the side it stays."""
    required = OwnBody(sheet((-0.05, -0.1), (0.061, 0.1)), 0.5)
    pose, focal_mm = at((0.0, 0.0, 0.0)).requires_grad_(), f64(8.0).requires_grad_()
    camera = render.Camera(lens.Pinhole(focal_mm), 16, 16, 0.1, 64)
    slope, zoom = torch.autograd.grad(required.slack(pose, camera).sum(), (pose, focal_mm))
    area = 0.111 * 0.2 / 0.16
    assert -float(zoom) == pytest.approx(2 * area / 8.0, rel=0.03)
    # silhouettes are sampled 2.5 times a pixel length: four edges, about 80 points
    assert -float(slope[0, 3]) == pytest.approx(area, rel=0.03)
    assert abs(slope[1, 3]) < 0.03 * area
    # pushed half out of the picture to the left, only its right edge moves: 0.2 m of height per
    # metre
    beside = at((0.0, -0.2, 0.0)).requires_grad_()
    (slope,) = torch.autograd.grad(required.slack(beside, camera).sum(), beside)
    assert float(slope[1, 3]) == pytest.approx(-0.2 / 0.16, rel=0.03)


def test_the_share_covered_is_told_by_window():
    """A sheet over the upper half of the view of four windows: chief rays that meet it, window by
    window."""
    film = render.Film(64, 64, 16, 16, 0.1, ((0, 0), (48, 0), (0, 24), (24, 48)))
    camera = render.Camera(lens.Pinhole(8.0), 16, 16, 0.1, 16, 0, film)
    tilt = torch.tensor(0.05, dtype=D, requires_grad=True)
    level = Mount((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    numbers = torch.stack([*torch.zeros(3, dtype=D), tilt, *torch.zeros(2, dtype=D)])
    required = OwnBody(sheet((-9, 0), (9, 9)), 0.5)
    covered = required.covered(level(numbers), camera)
    shift_px = 8.0 / 0.1 * torch.tan(tilt.detach())
    middle = (
        torch.tensor([8.0, 8.0, 32.0, 56.0]) - 32 - shift_px
    ) / 16  # of windows, below the edge, in their sides
    exact = (0.5 - middle).clamp(0, 1)
    assert torch.allclose(covered.detach().double(), exact.double(), atol=0.02)
    (slope,) = torch.autograd.grad(covered[2], tilt)
    assert float(slope) == pytest.approx(8.0 / 0.1 / 16, rel=0.03)
    # one pixel of each, about its middle: the upper two windows
    assert required.met(level(), camera, 40).sum() == 2


def test_hits_are_those_of_the_triangles(rover):
    camera = render.Camera(lens.Pinhole(2.0), 24, 18, 0.15, 4)
    for pose in (at((0.1, 0.05, 0.5), pitch_rad=1.2), at((-0.1, 0.0, 0.6), pitch_rad=0.6)):
        rays = camera.chief_rays(camera.film.pixels())
        origin = pose[:3, 3] + rays.origin_m @ pose[:3, :3].T
        crossings = first_crossings(origin, rays.direction @ pose[:3, :3].T, rover.triangles)
        counted = crossings.isfinite().double().mean()
        assert 0.1 < counted < 0.9
        # float32 geometry may decide a ray at an edge otherwise
        assert 1 - float(OwnBody(rover, 1.0).exact(pose, camera)) == pytest.approx(
            float(counted), abs=1.01 / 432
        )


def test_it_is_a_requirement_like_any_other(rover):
    camera = render.Camera(lens.Pinhole(2.5), 16, 12, 0.2, 4)
    required = OwnBody(rover, 0.05)
    poses = torch.stack([at((0.2, 0.0, 0.5), pitch_rad=p) for p in (-0.5, 1.4)])
    clear, covered = required.exact(poses, camera)[:, 0].tolist()
    assert clear == 0.05
    assert covered < 0
    verdict = judge([required], poses[1], camera)[0]
    assert str(verdict).startswith("own body in view: missed by 0.")
    spare = judge([required], poses[0], camera)[0]
    assert str(spare) == "own body in view: kept with 0.05 of the film to spare"
    assert penalty([required], poses[0], camera) == 0


def test_a_body_in_dark_corners_is_in_the_way_too():
    wide = render.Camera(lens.ThinLens(3.0, 1.0), 16, 16, 0.4, 4, falloff=True)
    everywhere = OwnBody(sheet((-9.0, -9.0), (9.0, 9.0)), 0.7)
    for found in (everywhere.slack, everywhere.exact):
        assert float(found(at((0.0, 0.0, 0.0)), wide)) == pytest.approx(-0.3, abs=1e-6)
