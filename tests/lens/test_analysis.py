"""Spot diagrams: pupil grid, gradients that follow the pupil, point images, and rays that fail."""

import math
from dataclasses import replace

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Surface, analysis
from codesign.lens.analysis import (
    Wavefront,
    peak_to_valley_waves,
    pupil_grid,
    remove_fit,
    rms_waves,
    strehl_direct,
    strehl_marechal,
    wavefront,
)
from codesign.lens.paraxial import cardinal_points
from tests.lens.systems import LINES, PLANE, close, glass, half_field, paraboloid
from tests.numbers import D, f64


def test_the_pupil_grid_is_even_and_inside_the_disc():
    points = pupil_grid(32)
    # the number the references count
    assert points.shape == (812, 2)
    assert points.norm(dim=1).max() <= 1
    close(points.mean(0), torch.zeros(2, dtype=D), atol=1e-15)
    # a disc's; the rim is a staircase of 1/16
    close(points.square().sum(1).mean(), 0.5, atol=0.01)


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
    truth = (kept - kept.mean(0)).square().sum(1).mean().sqrt()
    close(lens.rms_spot_mm(geo, [0.0], grid=16), truth, 1e-12)


def sphere_with_stop_at_its_centre(radius=200.0):
    stop = Surface(PLANE, radius, None, 30.0, is_stop=True)
    return GeoLens([stop, Surface(-radius, radius / 2, None, 90.0, mirror=True)], 10.0)


def test_a_concentric_mirror_has_its_image_on_a_sphere():
    # every chief ray is an axis: both foci lie R / 2 from the centre, so (R / 2) (1 - cos) behind
    # the plane, unfolded; 1e-15 of 200 mm over a reach of 1e-3
    fields = [0.0, 0.1, 0.25]
    geo = sphere_with_stop_at_its_centre()
    found = analysis.focus_shift_mm(geo, fields)
    truth = f64([100.0 * (1 - math.cos(a)) for a in fields])
    close(found, truth[:, None].expand(3, 2), atol=1e-8)
    # the plane at R / 2 from it is met at (R / 2) tan; f-theta asks for (R / 2) angle
    heights = [100 * math.tan(a) for a in fields]
    close(analysis.chief_height_mm(geo, fields), heights, atol=1e-12)
    assert analysis.distortion_percent(geo, fields).abs().max().item() <= 1e-12
    truth = [0.0, *(100 * (math.tan(a) / a - 1) for a in fields[1:])]
    close(analysis.distortion_percent(geo, fields, "f-theta"), truth, atol=1e-11)


@pytest.mark.parametrize("wavelength_um", LINES)
def test_distortion_goes_with_the_square_of_the_field_on_a_film_out_of_focus(wavelength_um):
    # the third order: S_V of the field's cube over the height
    geo, fields = lens.load("la1509").focus_at(1.0).freeze(), (1e-3, 1e-2, 0.1)
    for at_m in (0.3, math.inf):
        found = analysis.distortion_percent(geo, fields, wavelength_um=wavelength_um, at_m=at_m)
        close(found / f64(fields).square(), found[1].expand(3) / fields[1] ** 2, 0.1)


def test_fans_show_lateral_colour_about_a_common_point():
    geo = lens.load("cooke-triplet")
    field = half_field("cooke-triplet")
    fan = analysis.ray_fan(
        geo, field, LINES[1], reference_mm=analysis.chief_ray(geo, field).position_mm[0]
    )
    colour = analysis.lateral_colour_mm(geo, [field], [LINES[1]])[0, 0]
    close(fan.tangential_mm[16], colour, atol=1e-14)
    assert fan.pupil[16].item() == 0


def test_encircled_energy_of_a_defocused_point_is_that_of_a_disc():
    # rays evenly over the pupil stay even over the disc (up to (y / 2 f)^2): the share inside r is
    # (r / a)^2
    a = 0.5 * 2.5 / 100
    radii = [0.25 * a, 0.5 * a, 0.75 * a, 1.01 * a]
    found = analysis.encircled_energy(paraboloid(defocus_mm=0.5), 0.0, radii, grid=128)
    close(found, [1 / 16, 1 / 4, 9 / 16, 1], atol=3e-3)
    radius = analysis.encircled_radius_mm(paraboloid(defocus_mm=0.5), 0.0, 0.64, grid=128)
    close(radius, 0.8 * a, 5e-3)


def test_a_polychromatic_spot_adds_the_spread_of_its_means():
    # the parallel axis theorem: mean square of all = mean of the squares within each wavelength +
    # spread of their centres
    geo = lens.load("cooke-triplet").freeze()
    field = half_field("cooke-triplet")
    positions, weight = analysis.polychromatic_spot(geo, field, LINES)
    close(weight.sum(), 1, atol=1e-14)
    within = torch.stack([lens.rms_spot_mm(geo, [field], w)[0] for w in LINES]).square().mean()
    centres = positions.mean(1)
    between = (centres - centres.mean(0)).square().sum(1).mean()
    found = analysis.spot_radius_mm(positions, weight)
    close(found, (within + between).sqrt(), 1e-12)


def test_vignetting_narrows_spot_and_wavefront_to_the_rays_that_pass():
    surfaces = lens.load("la1509").surfaces
    narrow = GeoLens([Surface(PLANE, 5.0, None, 4.0), *surfaces], 20.0, soft_edge_mm=0.0).freeze()
    positions, weight = analysis.polychromatic_spot(GeoLens(surfaces, 20.0), 0.0, LINES[0], 64)
    clipped, clipped_weight = analysis.polychromatic_spot(
        narrow, 0.0, LINES[0], 64, vignetting=True
    )
    kept = analysis.pupil_grid(64).norm(dim=1) * 10 < 4.0
    assert torch.equal(clipped_weight[0] > 0, kept)
    expected = analysis.spot_radius_mm(positions[:, kept], weight[:, kept])
    close(analysis.spot_radius_mm(clipped, clipped_weight), expected, 1e-9)
    whole, front = (wavefront(narrow, 0.0, grid=64, vignetting=v) for v in (False, True))
    assert torch.equal(front.weight > 0, kept)
    expected = (whole.waves[kept] - whole.waves[kept].mean()).square().mean().sqrt()
    close(rms_waves(front), expected, 1e-12)


def test_a_paraboloid_is_perfect_on_its_axis():
    mirror = paraboloid(40.0).freeze()
    front = wavefront(mirror, 0.0)
    # roundings of paths of 200 mm
    assert front.opd_mm.abs().max().item() <= 1e-12
    close(strehl_direct(front), 1, atol=1e-12)

    def rms(curvature):
        return rms_waves(wavefront(mirror.replace(curvature_per_mm=curvature), 0.0))

    leaf = torch.tensor([-1 / 200.0], dtype=D, requires_grad=True)
    (gradient,) = torch.autograd.grad(rms(leaf), leaf)
    # the rms has a kink here, k |c - c0|: any slope between -k and k is one
    assert abs(gradient) <= 1.01 * rms(leaf.detach() + 1e-9).item() / 1e-9


def disc(waves, count=200):
    pupil = pupil_grid(count)
    r2 = pupil.square().sum(1)
    opd = waves(pupil, r2) * 0.5875618e-3
    return Wavefront(
        pupil, opd, torch.ones_like(r2), torch.zeros_like(pupil), 0.5875618, torch.zeros(2, dtype=D)
    )


@pytest.mark.parametrize("size", [0.1, 0.25, 1.0])
def test_rms_and_strehl_of_defocus_and_spherical_aberration(size):
    # W r^2: RMS W / sqrt 12, Strehl sinc^2 W; W r^4: RMS 2 W / sqrt 45 (Mahajan, Optical Imaging
    # and Aberrations, ch. 8); the rim is a staircase of 1 / 100
    defocus = disc(lambda p, r2: size * r2)
    close(rms_waves(defocus), size / math.sqrt(12), 5e-4)
    close(peak_to_valley_waves(defocus), size, 1e-3)
    sinc = math.sin(math.pi * size) / (math.pi * size)
    close(strehl_direct(defocus), sinc**2, atol=3e-4)
    spherical = disc(lambda p, r2: size * r2**2)
    close(rms_waves(spherical), 2 * size / math.sqrt(45), 1e-3)


def test_strehl_of_a_twentieth_of_a_wave_by_marechal():
    marechal = math.exp(-((2 * math.pi * 0.05) ** 2) / 12)
    close(strehl_marechal(disc(lambda p, r2: 0.05 * r2)), marechal, 1e-4)


def test_fits_take_away_what_they_fit():
    tilted = disc(lambda p, r2: 3 + 0.4 * p[:, 0] - 1.1 * p[:, 1] + 0.7 * r2, 40)
    assert rms_waves(remove_fit(tilted, focus=True)) <= 1e-12
    close(remove_fit(tilted, tilt=False).waves.mean(), 0, atol=1e-12)
    # focus balances r^4: sqrt(4 / 45) falls to 1 / (6 sqrt 5) (Mahajan)
    balanced = float(rms_waves(remove_fit(disc(lambda p, r2: r2**2), focus=True)))
    close(balanced, 1 / (6 * math.sqrt(5)), 1e-3)
    # what no light passes does not count
    dark = tilted.pupil[:, 0] > 0.5
    blocked = replace(tilted, opd_mm=torch.where(dark, 7.0, tilted.opd_mm), weight=(~dark).double())
    assert rms_waves(remove_fit(blocked, focus=True)) <= 1e-12


def test_a_telecentric_lens_has_a_plane_for_a_reference_sphere():
    # a stop in the front focal plane: the wavefront differs from one with a very far pupil by no
    # more than the pupil's distance tells
    surfaces = lens.load("la1509").surfaces
    front = -float(cardinal_points(lens.load("la1509")).front_focal_z_mm.detach())
    found = []
    for shift in (0.0, 1e-4):
        stop = Surface(math.inf, front + shift, None, 12.7, is_stop=True)
        geo = GeoLens(
            [stop, *(Surface(s.radius_mm, s.thickness_mm, s.medium, 12.7) for s in surfaces)], 10.0
        )
        found.append(wavefront(geo, 0.02, grid=16).waves.detach())
    # moved 1e-4 mm: slopes of the wavefront by 1e-6 of 10 waves
    close(found[0], found[1], atol=1e-4)


def test_spots_behind_apertures_are_of_the_rays_that_pass():
    """At 20 degrees half of the light of a double Gauss is cut off, the worse half."""
    geo, field = lens.load("double-gauss").freeze(), math.radians(20)
    passed = analysis.polychromatic_spot(geo, field, 0.5875618, 32, True)
    found = lens.rms_spot_mm(geo, [field], vignetting=True)[0]
    close(found, analysis.spot_radius_mm(*passed), 1e-9)
    assert found < 0.8 * lens.rms_spot_mm(geo, [field])[0]


@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss"])
def test_fans_of_a_lens_in_single_precision_are_those_of_its_numbers(name):
    """A wave is 1e-5 of the paths: in single precision their differences would be noise."""
    geo = lens.load(name)
    fan, single = (analysis.ray_fan(each, 0.12, count=9) for each in (geo, geo.float()))
    assert single.tangential_waves.dtype == torch.float32
    close(single.tangential_waves.double(), fan.tangential_waves, atol=2e-3)
    colours = [
        analysis.lateral_colour_mm(each, [0.12], [LINES[1]]).item() for each in (geo, geo.float())
    ]
    assert colours[1] == pytest.approx(colours[0], rel=1e-3)
