"""Fans, distortion, field curvature, colour and encircled energy against closed forms and public programs."""

import math

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Surface, analysis
from tests.lens.systems import LINES, NAMES, PLANE, check_gradient, half_field, paraboloid, reference

D = torch.float64
# d line, 0, 0.7 and 1 of the half field: tangential and sagittal focus from the image plane, mm. Computed
# with optiland (close rays, 1e-5 of the field).
FOCUS = {
    "cooke-triplet": (
        (0.228660182693236, 0.228660182693236),
        (0.19415236713112086, -0.0681862822911111),
        (-0.32354224813157123, -0.17905795012715198),
    ),
    "double-gauss": (
        (-3.306832062183619e-05, -3.306832062183619e-05),
        (-0.15686618985106743, -0.28197385647584094),
        (-0.36734838543236165, -0.5336936959234548),
    ),
    "la1509": (
        (3.70658631802334e-07, 3.70658631802334e-07),
        (-0.10760598483822893, -0.048951262083797235),
        (-0.21949778009725324, -0.09988175268929478),
    ),
}


@pytest.mark.parametrize("name", NAMES)
# their close rays leave 1e-8 mm; numbers of up to 200 mm rounded to 6e-8 of themselves
@pytest.mark.parametrize(("dtype", "atol"), [(D, 2e-8), (torch.float32, 3e-5)])
def test_field_curvature_of_published_lenses(name, dtype, atol):
    found = analysis.focus_shift_mm(lens.load(name, dtype), [half_field(name) * h for h in (0.0, 0.7, 1.0)])
    assert found.dtype == dtype
    torch.testing.assert_close(found.double(), torch.tensor(FOCUS[name], dtype=D), rtol=0, atol=atol)


def sphere_with_stop_at_its_centre(radius=200.0):
    stop = Surface(PLANE, radius, None, 30.0, is_stop=True)
    return GeoLens([stop, Surface(-radius, radius / 2, None, 90.0, mirror=True)], 10.0)


def test_a_concentric_mirror_has_its_image_on_a_sphere():
    # every chief ray is an axis: both foci lie R / 2 from the centre, so (R / 2) (1 - cos) behind the plane,
    # unfolded; 1e-15 of 200 mm over a reach of 1e-3
    fields = [0.0, 0.1, 0.25]
    geo = sphere_with_stop_at_its_centre()
    found = analysis.focus_shift_mm(geo, fields)
    truth = torch.tensor([100.0 * (1 - math.cos(a)) for a in fields], dtype=D)
    torch.testing.assert_close(found, truth[:, None].expand(3, 2), rtol=0, atol=1e-8)
    # the plane at R / 2 from it is met at (R / 2) tan; f-theta asks for (R / 2) angle
    heights = [100 * math.tan(a) for a in fields]
    assert analysis.chief_height_mm(geo, fields).tolist() == pytest.approx(heights, abs=1e-12)
    assert analysis.distortion_percent(geo, fields).abs().max().item() <= 1e-12
    truth = [0.0, *(100 * (math.tan(a) / a - 1) for a in fields[1:])]
    assert analysis.distortion_percent(geo, fields, "f-theta").tolist() == pytest.approx(truth, abs=1e-11)


@pytest.mark.parametrize("name", NAMES)
def test_distortion_and_colour_of_published_lenses(name, shared):
    page = reference(name, shared)
    geo = lens.load(name)
    field = half_field(name)
    found = analysis.distortion_percent(geo, [field])[0].item()
    assert found == pytest.approx(page["distortion_full_field_d"]["percent"], abs=1e-9)
    chiefs = (row for row in page["rays"] if row["px"] == row["py"] == 0 and row["H"] == 1)
    height = {row["w"]: float(row["mp30"]["y"]) for row in chiefs}
    # the reference pupil is rounded to 1e-9
    found = analysis.lateral_colour_mm(geo, [field], LINES[1:])[0].tolist()
    assert found == pytest.approx([height[line] - height["d"] for line in "FC"], abs=1e-9)
    bfl = {line: page["first_order"][line]["bfl"]["own"] for line in "dFC"}
    found = analysis.chromatic_focus_shift_mm(geo, LINES[1:]).tolist()
    assert found == pytest.approx([bfl[line] - bfl["d"] for line in "FC"], abs=1e-12)


def test_fans_are_the_derivative_of_the_path_difference():
    # transverse aberration = sphere radius / pupil height x dW / dp, to the accuracy of (y / f)^2 for a slow
    # lens (Welford, eq. 7.11)
    geo = GeoLens(lens.load("la1509").surfaces, 4.0).freeze()
    fan = analysis.ray_fan(geo, 0.02, count=201)
    for waves, away in ((fan.tangential_waves, fan.tangential_mm), (fan.sagittal_waves, fan.sagittal_mm)):
        slope = (waves[2:] - waves[:-2]) / (fan.pupil[2:] - fan.pupil[:-2]) * 0.5875618e-3
        # light from above goes down
        torch.testing.assert_close(away[1:-1], -slope / (2.0 / 99.65), rtol=2e-3, atol=1e-7)
    # the chief ray's own, up to rounding
    assert fan.tangential_mm[100].item() == pytest.approx(0, abs=1e-15)
    assert fan.tangential_waves[100].item() == pytest.approx(0, abs=1e-9)


def test_fans_show_lateral_colour_about_a_common_point():
    geo = lens.load("cooke-triplet")
    field = half_field("cooke-triplet")
    fan = analysis.ray_fan(geo, field, LINES[1], reference_mm=analysis.chief_ray(geo, field).position_mm[0])
    colour = analysis.lateral_colour_mm(geo, [field], [LINES[1]])[0, 0]
    assert fan.tangential_mm[16].item() == pytest.approx(colour.item(), abs=1e-14)
    assert fan.pupil[16].item() == 0


def test_encircled_energy_of_a_defocused_point_is_that_of_a_disc():
    # rays evenly over the pupil stay even over the disc (up to (y / 2 f)^2): the share inside r is (r / a)^2
    a = 0.5 * 2.5 / 100
    radii = [0.25 * a, 0.5 * a, 0.75 * a, 1.01 * a]
    found = analysis.encircled_energy(paraboloid(defocus_mm=0.5), 0.0, radii, grid=128).tolist()
    assert found == pytest.approx([1 / 16, 1 / 4, 9 / 16, 1], abs=3e-3)
    radius = analysis.encircled_radius_mm(paraboloid(defocus_mm=0.5), 0.0, 0.64, grid=128).item()
    assert radius == pytest.approx(0.8 * a, rel=5e-3)


def test_a_polychromatic_spot_adds_the_spread_of_its_means():
    # the parallel axis theorem: mean square of all = mean of the squares within each wavelength + spread of
    # their centres
    geo = lens.load("cooke-triplet").freeze()
    field = half_field("cooke-triplet")
    positions, weight = analysis.polychromatic_spot(geo, field, LINES)
    assert weight.sum().item() == pytest.approx(1, abs=1e-14)
    within = torch.stack([lens.rms_spot_mm(geo, [field], w)[0] for w in LINES]).square().mean()
    centres = positions.mean(1)
    between = (centres - centres.mean(0)).square().sum(1).mean()
    found = analysis.spot_radius_mm(positions, weight).item()
    assert found == pytest.approx((within + between).sqrt().item(), rel=1e-12)


def test_vignetting_narrows_the_spot_to_the_rays_that_pass():
    surfaces = lens.load("la1509").surfaces
    narrow = GeoLens([Surface(PLANE, 5.0, None, 4.0), *surfaces], 20.0, soft_edge_mm=0.0)
    positions, weight = analysis.polychromatic_spot(GeoLens(surfaces, 20.0), 0.0, LINES[0], 64)
    clipped, clipped_weight = analysis.polychromatic_spot(narrow, 0.0, LINES[0], 64, vignetting=True)
    kept = analysis.pupil_grid(64).norm(dim=1) * 10 < 4.0
    assert torch.equal(clipped_weight[0] > 0, kept)
    expected = analysis.spot_radius_mm(positions[:, kept], weight[:, kept]).item()
    assert analysis.spot_radius_mm(clipped, clipped_weight).item() == pytest.approx(expected, rel=1e-9)


FIELD = half_field("cooke-triplet")


@pytest.mark.parametrize(
    "figure",
    [
        lambda geo: analysis.focus_shift_mm(geo, [FIELD]).sum(),
        lambda geo: analysis.distortion_percent(geo, [FIELD])[0],
        lambda geo: analysis.ray_fan(geo, FIELD, count=5).tangential_waves.square().sum(),
        lambda geo: analysis.spot_radius_mm(*analysis.polychromatic_spot(geo, FIELD, LINES, 8)),
    ],
)
def test_gradients(figure):
    geo = lens.load("cooke-triplet")
    check_gradient(lambda c: figure(geo.replace(curvature_per_mm=c)), geo.curvature_per_mm, step=2e-5)
