"""Cameras: rays against the forward trace, blur against the defocus formula, projection there and back,
windows."""

import math

import pytest
import torch
from scipy.special import j1

from codesign import lens, render
from codesign.pose import look_at
from codesign.render import Camera, Film, TexturedPlane, angular_miss_rad, project
from scenes import worlds
from tests.render.differences import assert_gradients
from tests.render.fitted_lenses import OPTICS as FITTED
from tests.render.fitted_lenses import PITCH_MM, SENSOR_PX, fitted

D = torch.float64
NAMES = ["cooke-triplet", "double-gauss", "la1509"]


OPTICS = {**FITTED, "cooke-triplet, full size": lambda: lens.load("cooke-triplet")}


def random_pixels(count, generator):
    return torch.rand(count, 2, generator=generator, dtype=D) * torch.tensor(
        [SENSOR_PX[0] - 1, SENSOR_PX[1] - 1], dtype=D
    )


@pytest.mark.parametrize("name", NAMES)
def test_camera_rays_run_the_forward_trace_backwards(name, generator):
    camera = Camera(fitted(name), *SENSOR_PX, PITCH_MM, 1)
    pixels = random_pixels(30, generator)
    pupil = 0.4 * torch.randn(30, 2, generator=generator, dtype=D).clamp(-1.5, 1.5)
    geo = camera.lens
    film_mm = camera.film_mm(pixels)
    rays = geo.camera_rays(film_mm, pupil)
    passes = rays.weight > 0
    assert int(passes.sum()) >= 20
    # camera axes: x right, y down, z towards the scene; lens axes: light along +z. Turned about x by half a
    # turn and mirrored in y: z alone flips
    flip = torch.tensor([1.0, 1.0, -1.0], dtype=D)
    pupil_z = geo.first_order().entrance_pupil_z_mm
    origin = rays.origin_m * 1e3 * flip + pupil_z * torch.tensor([0.0, 0, 1], dtype=D)
    direction = -rays.direction * flip
    start = origin - direction * ((origin[:, 2:] + 5.0) / direction[:, 2:])  # before the first vertex
    out = geo.trace(start.detach(), direction.detach())
    assert not out.status[passes].any()
    # the image is upside down on the film; there and back through up to eleven surfaces rounds to 1e-13 mm
    torch.testing.assert_close(out.position_mm[passes, :2], -film_mm[passes], rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", OPTICS)
@pytest.mark.parametrize("depth_m", [0.5, 20.0, 1e4])
def test_projection_brings_points_of_chief_rays_back(name, depth_m, generator):
    camera = Camera(OPTICS[name](), *SENSOR_PX, PITCH_MM, 1)
    pixels = random_pixels(60, generator)
    rays = camera.chief_rays(pixels)
    points = (
        rays.origin_m + rays.direction * ((depth_m - rays.origin_m[:, 2:]) / rays.direction[:, 2:])
    ).detach()
    found = project(camera, points)
    lit = rays.weight > 0
    assert int(lit.sum()) >= 55  # the very corners may be vignetted
    assert float((found - pixels)[lit].detach().abs().max()) <= 1e-9


def test_points_outside_the_field_are_nan_and_leave_the_others_alone():
    camera = Camera(fitted("cooke-triplet"), *SENSOR_PX, PITCH_MM, 1)
    inside = torch.tensor([[0.0, 0.0, 1.0], [0.2, -0.1, 1.0]], dtype=D)
    outside = torch.tensor([[3.0, 0.0, 1.0], [0.0, -50.0, 1.0], [1e6, 1e6, 1.0]], dtype=D)
    geo = camera.lens
    both = project(camera, torch.cat([outside, inside]))
    assert both[:3].isnan().all()
    torch.testing.assert_close(
        both[3:], project(camera, inside), rtol=0, atol=1e-11
    )  # they may take a Newton step more
    assert project(camera, outside).isnan().all()
    (mixed,) = torch.autograd.grad(both[3:].sum(), geo.curvature_per_mm)
    (alone,) = torch.autograd.grad(project(camera, inside).sum(), geo.curvature_per_mm)
    torch.testing.assert_close(
        mixed, alone, rtol=1e-9, atol=0
    )  # the Jacobian is that of the last step but one
    assert project(camera, inside[:0]).shape == (0, 2)


@pytest.mark.parametrize("semi_aperture_mm", [0.02, 0.2])
def test_points_behind_the_edge_of_an_aperture_are_nan(semi_aperture_mm):
    """The stop is seen through a plane 3 mm behind it, in glass of 1.5: the exit pupil lies 2 mm before the plane.
    So the chief ray of a film point at height h crosses the plane, 95 mm before the film, at 2 h / 97; what passes
    its aperture is hidden, however little or far it is beyond the edge (the solver comes back into the field by
    another number of steps for each of these)."""
    glass = lens.Glass.from_indices(1.5, 1.5, 1.5)

    def camera(semi_aperture_mm):
        front = lens.Surface(50.0, 3.0, glass, 9.0, is_stop=True)
        last = lens.Surface(math.inf, 95.0, None, semi_aperture_mm)
        return Camera(lens.GeoLens([front, last], 4.0, soft_edge_mm=1e-6), 400, 400, 0.1, 1)

    height_px = semi_aperture_mm * 97 / 2 / 0.1
    share = torch.tensor([0.2, 0.9, 0.999, 1.001, 1.02, 1.05, 1.1, 1.15, 1.3, 1.85, 2.5], dtype=D)
    turn = torch.arange(len(share), dtype=D)
    place = share[:, None] * height_px * torch.stack([turn.cos(), turn.sin()], 1)
    pixels = camera(9.0).film.middle_px + place
    rays = camera(9.0).chief_rays(pixels)
    points = (rays.origin_m + 2.0 * rays.direction).detach()
    torch.testing.assert_close(project(camera(9.0), points), pixels, rtol=0, atol=1e-6)
    found = project(camera(semi_aperture_mm), points)
    assert found.isnan().any(1).tolist() == (share > 1).tolist()
    torch.testing.assert_close(found[share < 1], pixels[share < 1], rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["pinhole", "cooke-triplet"])
def test_angular_miss_is_the_angle_between_ray_and_point(name, generator):
    camera = Camera(OPTICS[name](), *SENSOR_PX, PITCH_MM, 1)
    pixels = random_pixels(10, generator)
    rays = camera.chief_rays(pixels)
    points = (rays.origin_m + 3 * rays.direction).detach()
    assert float(angular_miss_rad(camera, pixels, points).detach().max()) <= 1.01e-6  # the smooth floor
    side = torch.nn.functional.normalize(
        torch.linalg.cross(rays.direction, torch.tensor([0.3, 1.0, 0.2], dtype=D).expand(10, 3)), dim=1
    ).detach()
    found = angular_miss_rad(camera, pixels, points + 0.03 * side)  # at right angles to the ray: tan = 0.01
    torch.testing.assert_close(
        found.detach(), torch.full((10,), 2 * math.sin(math.atan(0.01) / 2), dtype=D), rtol=1e-7, atol=0
    )  # the chord; the floor adds 5e-9


# ---- blur


@pytest.mark.parametrize("optics", ["thin", "traced"])
def test_defocus_takes_contrast_away_as_a_blur_disc_does(optics):
    # a faint grating: contrast falls by 2 J1(x) / x of the disc (x = pi frequency diameter) and sinc of the
    # pixel (Goodman, 6.4)
    triplet = fitted("cooke-triplet")
    stopped = lens.GeoLens(
        triplet.to_surfaces(), triplet.entrance_pupil_diameter_mm / 8
    )  # f/40: spherical aberration is 1 % of this defocus
    focused = stopped.replace(
        thickness_mm=torch.cat([stopped.thickness_mm[:-1], stopped.first_order().bfl_mm.reshape(1) + 0.6])
    )
    optic = focused.thin() if optics == "thin" else focused
    f = float(focused.first_order().efl_mm.detach())
    image = f + 0.6
    z = 3.0
    pitch_mm = 0.004
    diameter_m = (
        1e-3 * focused.entrance_pupil_diameter_mm * abs(1 - z * 1e3 * (1 / f - 1 / image))
    )  # of the disc at the object
    pixel_m = pitch_mm / image * z
    frequency = 0.7 / diameter_m  # x = 2.2: contrast 0.5
    plane = TexturedPlane([[frequency, 0.0]], [1e-3], [0.0], dtype=D)
    away = look_at((0, 0, z), (0, 0, 0), down=(0, 1, 0))
    camera = Camera(optic, 64, 1, pitch_mm, 256)
    with torch.no_grad():
        row = render.frames(camera, plane, away[None])[0, 0]
    x = (torch.arange(64, dtype=D) - 31.5) * pixel_m
    design = torch.stack(
        [torch.ones_like(x), (2 * math.pi * frequency * x).cos(), (2 * math.pi * frequency * x).sin()], 1
    )
    mean, cosine, sine = torch.linalg.lstsq(design, row[:, None]).solution[:, 0].tolist()
    contrast = math.hypot(cosine, sine) / mean / 1e-3
    disc = math.pi * frequency * diameter_m
    box = math.pi * frequency * pixel_m
    truth = 2 * j1(disc) / disc * math.sin(box) / box
    # the formula's slope is -1.2 at x = 2.2: 1 % in the disc is 2 % in contrast; 256 samples add 1 %
    assert abs(contrast / truth - 1) <= (0.01 if optics == "thin" else 0.03)
    assert truth < 0.6


# ---- films


@pytest.mark.bits
def test_windows_equal_the_crops_of_the_full_frame():
    corners = ((0, 0), (17, 5), (40, 30))
    whole = Film(64, 48, 64, 48, 0.1)
    windows = Film(64, 48, 12, 9, 0.1, corners)
    plane = worlds.smooth_plane(4)
    pose = look_at((0.3, 0.1, 2.0), (0, 0, 0), down=(0, 1, 0))[None]
    geo = fitted("cooke-triplet")
    full, part = (
        render.frames(Camera(geo, 0 + f.width_px, f.height_px, 0.1, 4, film=f), plane, pose)
        for f in (whole, windows)
    )
    assert part.shape == (1, 3, 9, 12)
    for k, (left, top) in enumerate(corners):
        assert torch.equal(part[0, k], full[0, top : top + 9, left : left + 12])


def test_pixels_are_in_image_order_with_the_axis_in_the_middle():
    film = Film(6, 4, 2, 3, 0.1, ((1, 0), (4, 1)))
    assert film.pixels()[:3].tolist() == [[1, 0], [2, 0], [1, 1]]
    assert film.pixels()[6:8].tolist() == [[4, 1], [5, 1]]
    camera = Camera(lens.Pinhole(5.0), 6, 4, 0.1, 1)
    assert camera.film_mm(torch.tensor([[2.5, 1.5], [3.5, 1.5]], dtype=D)).tolist() == [
        [0, 0],
        [pytest.approx(0.1), 0],
    ]


def test_single_precision_lenses_make_single_precision_rays_and_double_truth():
    double, single = (
        Camera(lens.load("cooke-triplet", dtype), 16, 12, 0.1, 4) for dtype in (D, torch.float32)
    )
    a = double.rays()
    b = single.rays()
    assert (b.origin_m.dtype, b.direction.dtype) == (torch.float32, torch.float32)
    # float32 rounding through six surfaces: 1e-7 of 10 mm or so
    torch.testing.assert_close(b.direction.double(), a.direction, rtol=0, atol=2e-6)
    torch.testing.assert_close(b.origin_m.double(), a.origin_m, rtol=0, atol=2e-8)
    point = torch.tensor([[0.1, 0.05, 1.0]], dtype=D)
    found = project(single, point)
    assert found.dtype == D
    # curvatures rounded to float32 (6e-8) move the image of a 50 mm lens by 6e-8 * 50 pixels or so
    torch.testing.assert_close(found, project(double, point), rtol=0, atol=2e-5)


def test_gradients_of_projection_to_points_and_lens(generator):
    geo = fitted("cooke-triplet")
    aside = 0.15 * torch.randn(5, 2, generator=generator, dtype=D)
    points = torch.cat([aside, 1 + torch.rand(5, 1, generator=generator, dtype=D)], 1)
    weights = torch.randn(5, 2, generator=generator, dtype=D)

    def loss(points, curvature, thickness):
        optics = geo.replace(curvature_per_mm=curvature, thickness_mm=thickness)
        return (project(Camera(optics, *SENSOR_PX, PITCH_MM, 1), points) * weights).sum()

    # differences bend by 1e-7; the solver's own Jacobian (forward step of 1e-4 mm) is as good
    at = (points, geo.curvature_per_mm.detach(), geo.thickness_mm.detach())
    assert_gradients(loss, at, (1e-4, 1e-6, 1e-4), 1e-6)


def test_the_blur_disc_of_a_thin_lens_has_the_diameter_of_the_defocus_formula():
    # Focused at s: 1/s = 1/f - 1/s'. An object at z has a blur disc of diameter A s' |1/s - 1/z| on the film.
    f = 8.0
    aperture = 2.5
    image = 8.05
    z = 0.6
    camera = Camera(lens.ThinLens(f, aperture, image), 9, 9, 0.02, 64)
    diameter_mm = aperture * image * abs((1 / f - 1 / image) - 1 / (z * 1e3))
    angle = torch.linspace(0, 2 * math.pi, 13, dtype=D)[:-1]
    rim = torch.stack([angle.cos(), angle.sin()], 1)
    rays = camera.lens.camera_rays(torch.zeros(12, 2, dtype=D), rim)
    at = rays.origin_m + rays.direction * ((z - rays.origin_m[:, 2:]) / rays.direction[:, 2:])
    on_film = at[:, :2] / z * image  # millimetres, by the central ray
    torch.testing.assert_close(
        2 * on_film.norm(dim=1), torch.full((12,), diameter_mm, dtype=D), rtol=1e-12, atol=0
    )
