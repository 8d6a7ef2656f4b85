"""Fans, distortion, field curvature, colour and encircled energy against closed forms and public programs."""

import json
import math

import pytest
import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.lens import GeoLens, Surface, analysis

D = torch.float64
FILES = {"cooke-triplet": "cooke_triplet", "double-gauss": "double_gauss", "la1509": "la1509"}
LINES = (0.5875618, 0.4861327, 0.6562725)
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


def half_field(name):
    return math.radians(lens.half_field_deg(name))


@pytest.mark.parametrize("name", FOCUS)
def test_field_curvature_of_published_lenses(name):
    fields = [half_field(name) * h for h in (0.0, 0.7, 1.0)]
    found = analysis.focus_shift_mm(lens.load(name), fields).detach()
    torch.testing.assert_close(
        found, torch.tensor(FOCUS[name], dtype=D), rtol=0, atol=2e-8
    )  # their close rays leave 1e-8 mm


@pytest.mark.parametrize("name", FOCUS)
def test_field_curvature_of_a_float32_lens(name):
    fields = [half_field(name) * h for h in (0.0, 0.7, 1.0)]
    found = analysis.focus_shift_mm(lens.load(name).float(), fields).detach()
    assert found.dtype == torch.float32
    # numbers of up to 200 mm rounded to 6e-8 of themselves
    torch.testing.assert_close(found.double(), torch.tensor(FOCUS[name], dtype=D), rtol=0, atol=3e-5)


def sphere_with_stop_at_its_centre(radius=200.0):
    return GeoLens(
        [
            Surface(math.inf, radius, None, 30.0, is_stop=True),
            Surface(-radius, radius / 2, None, 90.0, mirror=True),
        ],
        10.0,
    )


def test_a_concentric_mirror_has_its_image_on_a_sphere():
    # every chief ray is an axis: both foci lie R / 2 from the centre, so (R / 2) (1 - cos) behind the plane,
    # unfolded
    fields = [0.0, 0.1, 0.25]
    found = analysis.focus_shift_mm(sphere_with_stop_at_its_centre(), fields).detach()
    truth = torch.tensor([100.0 * (1 - math.cos(a)) for a in fields], dtype=D)
    torch.testing.assert_close(
        found, truth[:, None].expand(3, 2), rtol=0, atol=1e-8
    )  # 1e-15 of 200 mm over a reach of 1e-3


def test_distortion_and_its_two_mappings():
    # through the centre of a concentric mirror: the plane at R / 2 from it is met at (R / 2) tan; f-theta
    # asks for (R / 2) angle
    fields = [0.0, 0.1, 0.25]
    geo = sphere_with_stop_at_its_centre()
    assert analysis.chief_height_mm(geo, fields).tolist() == pytest.approx(
        [100 * math.tan(a) for a in fields], abs=1e-12
    )
    assert analysis.distortion_percent(geo, fields).abs().max().item() <= 1e-12
    truth = [0.0, *(100 * (math.tan(a) / a - 1) for a in fields[1:])]
    assert analysis.distortion_percent(geo, fields, "f-theta").tolist() == pytest.approx(truth, abs=1e-11)
    with pytest.raises(DomainError, match="mapping 'fisheye' is not known; known mappings: f-tan, f-theta"):
        analysis.distortion_percent(geo, fields, "fisheye")


@pytest.mark.parametrize("name", FILES)
def test_distortion_and_lateral_colour_of_published_lenses(name, shared):
    page = json.loads(shared(f"refs/lens/{FILES[name]}.json").read_text())
    geo = lens.load(name)
    field = half_field(name)
    assert analysis.distortion_percent(geo, [field])[0].item() == pytest.approx(
        page["distortion_full_field_d"]["percent"], abs=1e-9
    )
    chief = {}
    for row in page["rays"]:
        if row["px"] == row["py"] == 0 and row["H"] == 1:
            chief[row["w"]] = float(row["mp30"]["y"])
    truth = [chief["F"] - chief["d"], chief["C"] - chief["d"]]
    assert analysis.lateral_colour_mm(geo, [field], [LINES[1], LINES[2]])[0].tolist() == pytest.approx(
        truth, abs=1e-9
    )  # the reference pupil is rounded to 1e-9
    focus = [
        page["first_order"][line]["bfl"]["own"] - page["first_order"]["d"]["bfl"]["own"]
        for line in ("F", "C")
    ]
    assert analysis.chromatic_focus_shift_mm(geo, [LINES[1], LINES[2]]).tolist() == pytest.approx(
        focus, abs=1e-12
    )


def test_fans_are_the_derivative_of_the_path_difference():
    # transverse aberration = sphere radius / pupil height x dW / dp, to the accuracy of (y / f)^2 for a slow
    # lens (Welford, eq. 7.11)
    geo = GeoLens(lens.load("la1509").surfaces, 4.0)
    fan = analysis.ray_fan(geo, 0.02, count=201)
    for waves, away in ((fan.tangential_waves, fan.tangential_mm), (fan.sagittal_waves, fan.sagittal_mm)):
        slope = (waves[2:] - waves[:-2]).detach() / (fan.pupil[2:] - fan.pupil[:-2]) * 0.5875618e-3
        expected = -slope / (2.0 / 99.65)  # light from above goes down
        torch.testing.assert_close(away[1:-1].detach(), expected, rtol=2e-3, atol=1e-7)
    assert fan.tangential_mm[100].item() == pytest.approx(0, abs=1e-15)  # the chief ray's own, up to rounding
    assert fan.tangential_waves[100].item() == pytest.approx(0, abs=1e-9)


def test_fans_show_lateral_colour_about_a_common_point():
    geo = lens.load("cooke-triplet")
    field = half_field("cooke-triplet")
    reference = analysis.chief_ray(geo, field).position_mm[0]
    fan = analysis.ray_fan(geo, field, LINES[1], reference_mm=reference)
    colour = analysis.lateral_colour_mm(geo, [field], [LINES[1]])[0, 0]
    assert fan.tangential_mm[16].item() == pytest.approx(colour.item(), abs=1e-14)
    assert fan.pupil[16].item() == 0


def test_encircled_energy_of_a_defocused_point_is_that_of_a_disc():
    # rays evenly over the pupil stay even over the disc (up to (y / 2 f)^2): the share inside r is (r / a)^2
    geo = GeoLens([Surface(-200.0, 100.0, None, 30.0, conic=-1.0, is_stop=True, mirror=True)], 5.0)
    a = 0.5 * 2.5 / 100
    radii = [0.25 * a, 0.5 * a, 0.75 * a, 1.01 * a]
    assert analysis.encircled_energy(geo, 0.0, radii, grid=128, defocus_mm=0.5).tolist() == pytest.approx(
        [1 / 16, 1 / 4, 9 / 16, 1], abs=3e-3
    )  # a grid of 128
    assert analysis.encircled_radius_mm(geo, 0.0, 0.64, grid=128, defocus_mm=0.5).item() == pytest.approx(
        0.8 * a, rel=5e-3
    )
    with pytest.raises(DomainError, match=r"share 1.2 of encircled energy must lie in \(0, 1\]"):
        analysis.encircled_radius_mm(geo, 0.0, 1.2)


def test_a_polychromatic_spot_adds_the_spread_of_its_means():
    # the parallel axis theorem: mean square of all = mean of the squares within each wavelength + spread of
    # their centres
    geo = lens.load("cooke-triplet")
    field = half_field("cooke-triplet")
    positions, weight = analysis.polychromatic_spot(geo, field, LINES)
    assert weight.sum().item() == pytest.approx(1, abs=1e-14)
    within = torch.stack([lens.rms_spot_mm(geo, [field], w)[0] for w in LINES]).square().mean()
    centres = positions.mean(1)
    between = (centres - centres.mean(0)).square().sum(1).mean()
    assert analysis.spot_radius_mm(positions, weight).item() == pytest.approx(
        float((within + between).sqrt().detach()), rel=1e-12
    )


def test_vignetting_narrows_the_spot_to_the_rays_that_pass():
    open_ = GeoLens(lens.load("la1509").surfaces, 20.0)
    narrow = GeoLens(
        [Surface(math.inf, 5.0, None, 4.0), *lens.load("la1509").surfaces], 20.0, soft_edge_mm=0.0
    )
    positions, weight = analysis.polychromatic_spot(open_, 0.0, LINES[0], 64)
    kept = analysis.pupil_grid(64).norm(dim=1) * 10 < 4.0
    clipped, clipped_weight = analysis.polychromatic_spot(narrow, 0.0, LINES[0], 64, vignetting=True)
    assert torch.equal(clipped_weight[0] > 0, kept)
    expected = analysis.spot_radius_mm(positions[:, kept], weight[:, kept])
    assert analysis.spot_radius_mm(clipped, clipped_weight).item() == pytest.approx(expected.item(), rel=1e-9)


@pytest.mark.parametrize("what", ["focus", "distortion", "fan", "radius"])
def test_gradients(what):
    geo = lens.load("cooke-triplet")
    field = half_field("cooke-triplet")
    ask = {
        "focus": lambda g: analysis.focus_shift_mm(g, [field]).sum(),
        "distortion": lambda g: analysis.distortion_percent(g, [field])[0],
        "fan": lambda g: analysis.ray_fan(g, field, count=5).tangential_waves.square().sum(),
        "radius": lambda g: analysis.spot_radius_mm(*analysis.polychromatic_spot(g, field, LINES, 8)),
    }[what]
    value = geo.curvature_per_mm.detach()
    leaf = value.clone().requires_grad_()
    (found,) = torch.autograd.grad(ask(geo.replace(curvature_per_mm=leaf)), leaf)
    direction = torch.tensor([1.0, -0.5, 0.7, 0.4, -0.8, 0.6], dtype=D) * value.abs()
    step = 2e-5
    near, far = (
        float(
            (
                ask(geo.replace(curvature_per_mm=value + k * step * direction))
                - ask(geo.replace(curvature_per_mm=value - k * step * direction))
            ).detach()
        )
        for k in (1, 2)
    )
    assert float(found @ direction) == pytest.approx((8 * near - far) / (12 * step), rel=1e-6)
