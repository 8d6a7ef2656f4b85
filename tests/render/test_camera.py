"""Cameras: rays against the forward trace, projection there and back, windows."""

import math

import pytest
import torch

from codesign import lens, render
from codesign.pose import look_at
from codesign.render import Camera, Film, angular_miss_rad, project
from scenes import worlds
from tests.numbers import D, close, f64, rand64, randn64
from tests.render.fitted_lenses import OPTICS as FITTED
from tests.render.fitted_lenses import PITCH_MM, SENSOR_PX, fitted

OPTICS = {
    **FITTED,
    "cooke-triplet, full size": lambda: lens.load("cooke-triplet"),
    # paraxially aimed its chief rays are 0.14 px off in the corner
    "aimed": lambda: lens.family("retrofocus-4").lens(2.5, 2.0),
}


def on_sensor(optics, **options):
    return Camera(optics, *SENSOR_PX, PITCH_MM, 1, **options)


def random_pixels(count, generator):
    last = f64(SENSOR_PX) - 1
    return last * rand64(generator, count, 2)


@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss", "la1509"])
def test_camera_rays_run_the_forward_trace_backwards(name, generator):
    camera = on_sensor(fitted(name))
    pupil = 0.4 * randn64(generator, 30, 2).clamp(-1.5, 1.5)
    film_mm = camera.film_mm(random_pixels(30, generator))
    rays = camera.lens.camera_rays(film_mm, pupil)
    passes = rays.weight > 0
    assert passes.sum() >= 20
    # camera axes: x right, y down, z towards the scene; lens axes: light along +z. Turned about x
    # by half a turn and mirrored in y: z alone flips
    flip = f64([1.0, 1.0, -1.0])
    direction = (-rays.direction * flip).detach()
    start = (rays.origin_m * 1e3 * flip).detach()
    start[:, 2] += float(camera.lens.first_order().entrance_pupil_z_mm.detach())
    start = start - direction * ((start[:, 2:] + 5.0) / direction[:, 2:])  # before the first vertex
    out = camera.lens.trace(start, direction)
    assert not out.status[passes].any()
    # the image is upside down on the film; there and back through up to eleven surfaces rounds to
    # 1e-13 mm
    close(out.position_mm[passes, :2], -film_mm[passes], atol=1e-11)


@pytest.mark.parametrize("name", OPTICS)
def test_projection_brings_points_of_chief_rays_back(name, generator):
    camera = on_sensor(OPTICS[name](), aim=name == "aimed")
    pixels = random_pixels(90, generator)
    depth_m = f64([0.5, 20.0, 1e4]).repeat(30)[:, None]
    rays = camera.chief_rays(pixels)
    ahead = (depth_m - rays.origin_m[:, 2:]) / rays.direction[:, 2:]
    found = project(camera, (rays.origin_m + rays.direction * ahead).detach())
    lit = rays.weight > 0
    assert lit.sum() >= 82  # the very corners may be vignetted
    assert (found - pixels)[lit].detach().abs().max() <= 1e-9


@pytest.mark.parametrize("weights", [(1.0, 0.0), (0.25, 0.75)])
def test_a_point_is_projected_in_the_mean_wavelength_of_the_light(weights):
    """Against the forward trace: the stop comes first, so the pupil is one for all colours."""
    glass = lens.Glass.named("SF2")
    stop = lens.Surface(math.inf, 10.0, None, 3.0, is_stop=True)
    faces = lens.Surface(60.0, 4.0, glass, 9.0), lens.Surface(-60.0, 45.0, None, 9.0)
    geo = lens.GeoLens([stop, *faces], 4.0)
    light = lens.Spectrum((0.4861327, 0.6562725), weights)
    field, mean_um = 0.2, weights[0] * 0.4861327 + weights[1] * 0.6562725
    far = torch.tensor([[0.0, 1e6 * math.tan(field), 1e6]], dtype=D)
    made = (Camera(geo, 8, 8, 0.01, 2, spectrum=s, aim=True) for s in (light, None))
    found, d_line = (project(camera, far)[0, 1] - 3.5 for camera in made)
    truth = lens.analysis.chief_ray(geo, field, mean_um).position_mm[0, 1].abs() / 0.01
    torch.testing.assert_close(found, truth, rtol=0, atol=1e-6)
    assert abs(float((d_line - truth).detach())) > 0.05


def test_points_outside_the_field_are_nan_and_leave_the_others_alone():
    camera = on_sensor(fitted("cooke-triplet"))
    curvature = camera.lens.curvature_per_mm
    inside = f64([[0.0, 0.0, 1.0], [0.2, -0.1, 1.0]])
    outside = f64([[3.0, 0.0, 1.0], [0.0, -50.0, 1.0], [1e6, 1e6, 1.0]])
    mixed, alone = project(camera, torch.cat([outside, inside])), project(camera, inside)
    assert mixed[:3].isnan().all()
    # they may take a Newton step more, and the Jacobian is that of the last step but one
    close(mixed[3:], alone, atol=1e-11)
    slopes = [torch.autograd.grad(at.sum(), curvature)[0] for at in (mixed[3:], alone)]
    close(*slopes, rtol=1e-9)
    assert project(camera, inside[:0]).shape == (0, 2)


def test_a_search_that_finds_no_light_says_nothing():
    camera = Camera(lens.load("cooke-triplet").scaled(0.22), 24, 24, 8 / 24, 1, aim=True)
    found = project(camera, f64([[1.0, 0.0, 1.0], [0.0, 0.0, 1.0]]))  # warnings are errors here
    assert found[0].isnan().all()
    close(found[1], f64([11.5, 11.5]), atol=1e-9)  # on the axis: the middle of the film


@pytest.mark.parametrize("semi_aperture_mm", [0.02, 0.2])
def test_points_behind_the_edge_of_an_aperture_are_nan(semi_aperture_mm):
    """The stop is seen through a plane 3 mm behind it, in glass of 1.5: the exit pupil lies 2 mm
    before the plane. So the chief ray of a film point at height h crosses the plane, 95 mm before
    the film, at 2 h / 97; what passes its aperture is hidden, however little or far it is beyond
    the edge (the solver comes back into the field by another number of steps for each of these)."""
    glass = lens.Glass.from_indices(1.5, 1.5, 1.5)

    def camera(semi_aperture_mm):
        front = lens.Surface(50.0, 3.0, glass, 9.0, is_stop=True)
        last = lens.Surface(math.inf, 95.0, None, semi_aperture_mm)
        return Camera(lens.GeoLens([front, last], 4.0, soft_edge_mm=1e-6), 400, 400, 0.1, 1)

    height_px = semi_aperture_mm * 97 / 2 / 0.1
    share = f64([0.2, 0.9, 0.999, 1.001, 1.02, 1.05, 1.1, 1.15, 1.3, 1.85, 2.5])
    turn = torch.arange(len(share), dtype=D)
    place = share[:, None] * height_px * torch.stack([turn.cos(), turn.sin()], 1)
    pixels = camera(9.0).film.middle_px + place
    rays = camera(9.0).chief_rays(pixels)
    points = (rays.origin_m + 2.0 * rays.direction).detach()
    close(project(camera(9.0), points), pixels, atol=1e-6)
    found = project(camera(semi_aperture_mm), points)
    passes = camera(semi_aperture_mm).chief_rays(pixels).weight > 0
    assert passes.tolist() == (share < 1).tolist()
    assert found.isnan().any(1).tolist() == (share > 1).tolist()
    close(found[share < 1], pixels[share < 1], atol=1e-6)


@pytest.mark.parametrize("name", ["pinhole", "cooke-triplet"])
def test_angular_miss_is_the_angle_between_ray_and_point(name, generator):
    camera = on_sensor(OPTICS[name]())
    pixels = random_pixels(10, generator)
    rays = camera.chief_rays(pixels)
    points = (rays.origin_m + 3 * rays.direction).detach()
    across = torch.linalg.cross(rays.direction, f64([[0.3, 1.0, 0.2]]).expand(10, 3))
    # at right angles to the ray: tan = 0.01
    side = torch.nn.functional.normalize(across, dim=1).detach()
    # the smooth floor
    assert angular_miss_rad(camera, pixels, points).detach().max() <= 1.01e-6
    found = angular_miss_rad(camera, pixels, points + 0.03 * side).detach()
    chord = torch.full((10,), 2 * math.sin(math.atan(0.01) / 2), dtype=D)
    close(found, chord, rtol=1e-7)  # the floor adds 5e-9


# ---- films


@pytest.mark.bits
def test_windows_equal_the_crops_of_the_full_frame():
    corners = ((0, 0), (17, 5), (40, 30))
    pose = look_at((0.3, 0.1, 2.0), (0, 0, 0), down=(0, 1, 0))[None]
    geo, plane = fitted("cooke-triplet"), worlds.smooth_plane(4)
    full, part = (
        Camera(geo, film.width_px, film.height_px, 0.1, 4, film=film)
        for film in (Film(64, 48, 64, 48, 0.1), Film(64, 48, 12, 9, 0.1, corners))
    )
    path = torch.cat([pose, look_at((0.32, 0.1, 2.0), (0, 0, 0.1), down=(0, 1, 0))[None]])
    for tell in (
        lambda camera: render.frames(camera, plane, pose)[0],
        lambda camera: render.true_flow(camera, plane, path)[0][0],
    ):
        whole = tell(full)
        crops = [whole[..., top : top + 9, left : left + 12] for left, top in corners]
        close(tell(part), torch.stack(crops, -3), atol=1e-10)


def test_pixels_are_in_image_order_with_the_axis_in_the_middle():
    film = Film(6, 4, 2, 3, 0.1, ((1, 0), (4, 1)))
    assert film.pixels()[[0, 1, 2, 6, 7]].tolist() == [[1, 0], [2, 0], [1, 1], [4, 1], [5, 1]]
    at = Camera(lens.Pinhole(5.0), 6, 4, 0.1, 1).film_mm(f64([[2.5, 1.5], [3.5, 1.5]]))
    assert at.tolist() == [[0, 0], [pytest.approx(0.1), 0]]


@pytest.mark.parametrize("dtype", [torch.int64, torch.float32])
def test_whole_and_single_numbers_mean_what_double_ones_do(dtype):
    camera = Camera(lens.Pinhole(torch.tensor(8)), 8, 8, 0.5, 1)
    pixels = torch.tensor([[0, 3], [4, 7]], dtype=dtype)
    for rays in (camera.chief_rays(pixels), camera.rays_through(pixels, 0 * pixels)):
        slope = (pixels.to(D) - 3.5) * 0.5 / 8
        torch.testing.assert_close(rays.direction[:, :2] / rays.direction[:, 2:], slope)


def test_single_precision_lenses_make_single_precision_rays_and_double_truth():
    double, single = (
        Camera(lens.load("cooke-triplet", dtype), 16, 12, 0.1, 4) for dtype in (D, torch.float32)
    )
    # float32 rounding through six surfaces: 1e-7 of 10 mm or so
    for name, tolerance in (("direction", 2e-6), ("origin_m", 2e-8)):
        found, truth = (getattr(camera.rays(), name) for camera in (single, double))
        assert found.dtype == torch.float32
        close(found.double(), truth, atol=tolerance)
    point = f64([[0.1, 0.05, 1.0]])
    # curvatures rounded to float32 (6e-8) move the image of a 50 mm lens by 6e-8 * 50 pixels or so
    close(project(single, point), project(double, point), atol=2e-5)
