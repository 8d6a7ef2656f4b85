"""Ray aiming and radiometry: rays meet the real stop; irradiance agrees with closed forms and with
the area of the image-space cone."""

import math
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch

from codesign import lens, render
from codesign.errors import searching
from codesign.lens import GeoLens, Glass, Pinhole, Spectrum, Surface, ThinLens
from codesign.lens.aiming import aimed_rays
from codesign.lens.analysis import field_rays, pupil_grid
from codesign.lens.analysis.field_curves import relative_illumination
from codesign.lens.trace import trace
from tests.lens.systems import NAMES, PLANE, close, half_field
from tests.numbers import D, f64

TURN = torch.arange(720, dtype=D) * math.pi / 360
RIM = torch.stack([TURN.cos(), TURN.sin()], 1)


def at_stop(geo, rays):
    return trace(geo.prescription().until(geo.stop_index), *rays).position_mm[:, :2].detach()


def wide_angle():
    """A reversed telephoto of strong negative front elements: at 65 degrees the real entrance pupil
    is far from the paraxial one."""
    glass = Glass.named("N-SK16")
    surfaces = [
        Surface(40.0, 2.0, glass, 25.0),
        Surface(12.0, 16.0, None, 11.9),
        Surface(60.0, 6.0, glass, 9.0),
        Surface(-40.0, 6.0, None, 9.0),
        Surface(PLANE, 4.0, None, 5.0, is_stop=True),
        Surface(60.0, 4.0, glass, 9.0),
        Surface(-18.0, 30.0, None, 9.0),
    ]
    return GeoLens(surfaces, 2.0)


@pytest.mark.parametrize("name", [*NAMES, "wide"])
def test_aimed_rays_meet_the_stop(name):
    geo = wide_angle() if name == "wide" else lens.load(name)
    field = math.radians(65.0) if name == "wide" else half_field(name)
    pupil = pupil_grid(12)
    stop_mm = geo.first_order().stop_semi_aperture_mm.detach()
    wanted = pupil * stop_mm
    close(at_stop(geo, aimed_rays(geo, field, pupil)), wanted, atol=1e-9)
    # which paraxial aim does not
    missed = (at_stop(geo, field_rays(geo, field, pupil)) - wanted).abs().max()
    assert missed > (0.4 * stop_mm if name == "wide" else 1e-3)


@pytest.mark.parametrize("um", [0.4861327, 0.5875618, 0.6562725])
def test_rays_are_aimed_at_the_stop_where_it_is_and_at_one_opening_in_all_colours(um):
    """A flat stop, 1 mm up and turned by 20 degrees about y, behind a lens that disperses."""
    geo = GeoLens(
        [
            Surface(60.0, 4.0, Glass.named("SF2"), 9.0),
            Surface(-200.0, 8.0, None, 9.0),
            Surface(PLANE, 45.0, None, 5.0, is_stop=True, decentre_mm=(0.0, 1.0), tilt_deg=(0, 20)),
        ],
        6.0,
    )
    pupil, first = pupil_grid(8), geo.first_order()
    wanted = pupil * first.stop_semi_aperture_mm.detach() * f64([math.cos(math.radians(20)), 1.0])
    film_mm = f64([[1.0, -4.0]]).expand(len(pupil), 2)
    back = geo.camera_rays(film_mm, pupil, um, aim=True)
    flip = f64([1.0, 1.0, -1.0])
    start = back.origin_m * 1e3 * flip + f64([0, 0, 1.0]) * first.entrance_pupil_z_mm
    forwards = -back.direction * flip
    start = start - forwards * ((start[:, 2:] + 5.0) / forwards[:, 2:])
    for rays in (aimed_rays(geo, 0.1, pupil, um), (start, forwards)):
        met = trace(geo.prescription(um).until(2), *rays).position_mm.detach()
        close(met[:, :2], wanted + f64([0.0, 1.0]), atol=1e-9)


def test_rays_that_cannot_be_aimed_are_told_and_keep_their_paraxial_aim():
    geo = wide_angle()
    pupil = pupil_grid(4)
    with pytest.warns(
        UserWarning, match=r"rays cannot be aimed at the stop .* keep their paraxial aim"
    ):
        origin, direction = (v.detach() for v in aimed_rays(geo, math.radians(85.0), pupil))
    first = geo.first_order()
    wanted = pupil * first.stop_semi_aperture_mm.detach()
    lost = (at_stop(geo, (origin, direction)) - wanted).norm(dim=1) > 1e-6
    assert lost.any()
    crossing = origin + direction * (
        (first.entrance_pupil_z_mm.detach() - origin[:, 2:]) / direction[:, 2:]
    )
    guess = pupil * first.entrance_pupil_diameter_mm.detach() / 2
    close(crossing[lost, :2], guess[lost], atol=1e-9)


def test_a_search_is_not_told_of_lost_rays_and_other_threads_still_are():
    geo, angle, pupil = wide_angle(), math.radians(85.0), pupil_grid(4)
    with warnings.catch_warnings(record=True) as told, ThreadPoolExecutor(1) as others:
        warnings.simplefilter("always")
        with searching():
            aimed_rays(geo, angle, pupil)
            assert not told
            others.submit(aimed_rays, geo, angle, pupil).result()
        assert len(told) == 1
        aimed_rays(geo, angle, pupil)
    assert len(told) == 2


def cone_area(geo, field):
    """Area of the image-space cone of a field in direction cosines, by its rim (shoelace)."""
    x, y, _ = geo.trace(*aimed_rays(geo, field, RIM)).direction.detach().unbind(1)
    return 0.5 * float((x * y.roll(-1) - x.roll(-1) * y).sum().abs())


def opened(geo, factor):
    """The lens with apertures that many times as wide, within their spheres."""
    wide = (
        factor * s.semi_aperture_mm if not s.is_stop else s.semi_aperture_mm for s in geo.surfaces
    )
    surfaces = [
        replace(s, semi_aperture_mm=min(a, 0.99 * abs(s.radius_mm)))
        for s, a in zip(geo.surfaces, wide, strict=True)
    ]
    return GeoLens(surfaces, geo.entrance_pupil_diameter_mm)


@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss"])
def test_illumination_is_the_area_of_the_image_space_cone(name):
    """Without vignetting. The grid of pupil points integrates a smooth function over a disc of
    stairs: 0.3 %.

    The cone is that of one object direction; the image point of the chief ray collects the same but
    for aberrations, whose share is as small.
    """
    geo = opened(lens.load(name), 10.0)
    fields = [half_field(name) * share for share in (0.5, 0.8)]
    found = relative_illumination(geo, fields, grid=40)
    close(found, [cone_area(geo, f) / cone_area(geo, 0.0) for f in fields], 6e-3)


def test_vignetting_takes_the_share_of_rays_that_the_hard_apertures_stop():
    """The two samplings of the pupil differ by its distortion: below 1 % of the light."""
    published = lens.load("double-gauss")
    field = math.radians(14.0)
    geo = GeoLens(published.surfaces, published.entrance_pupil_diameter_mm, soft_edge_mm=0.02)
    inside = geo.trace(*aimed_rays(geo, field, pupil_grid(40))).inside.double().mean().item()
    assert 0.9 < inside < 0.97
    lit, open_ = (
        relative_illumination(g, [field], grid=40).item() for g in (geo, opened(published, 1.4))
    )
    close(lit / open_, inside, atol=0.01)
    close(relative_illumination(geo, [0.0]), 1.0, atol=1e-12)


def disc_irradiance(tangent, pupil_tangent):
    """Irradiance of a plane by a parallel uniform disc of unit radiance seen off its axis, over pi
    (Foote 1915): exact for any aperture."""
    t2, a2 = tangent**2, pupil_tangent**2
    return 0.5 * (1 - (1 + t2 - a2) / math.sqrt(t2**2 + 2 * t2 * (1 - a2) + (1 + a2) ** 2))


def uniform_world(camera):
    """The picture of radiance 1 from everywhere."""
    return camera.rays().weight.reshape(*camera.film.shape, camera.samples_per_pixel).mean(-1)


@pytest.mark.parametrize("diameter", [0.0, 4.0, 20.0])
def test_a_uniform_world_falls_off_as_an_ideal_lens_makes_it(diameter):
    """Sensor of 29 x 1 mm behind 20 mm of air: cos^4 for the pinhole, the disc formula for wide
    pupils. 256 samples integrate to 3e-3."""
    ideal = ThinLens(20.0, diameter) if diameter else Pinhole(20.0)
    image = uniform_world(render.Camera(ideal, 29, 1, 1.0, 256, falloff=True))[0]
    for column in (0, 7, 14):
        tangent = abs(column - 14) / 20.0
        expected = math.cos(math.atan(tangent)) ** 4
        if diameter:
            expected = disc_irradiance(tangent, diameter / 40) / (diameter / 40) ** 2
        close(image[column], expected, 3e-3)
    flat = uniform_world(render.Camera(Pinhole(20.0), 29, 1, 1.0, 4))
    torch.testing.assert_close(flat, torch.ones_like(flat))


def test_colours_share_the_samples_of_a_pixel():
    geo = lens.load("cooke-triplet")
    spectrum = Spectrum((0.4861327, 0.6562725), (0.25, 0.75))
    rays = render.Camera(geo, 3, 2, 0.5, 8, spectrum=spectrum).rays()
    shares = f64([0.5] * 4 + [1.5] * 4)
    torch.testing.assert_close(rays.weight.reshape(6, 8), shares.expand(6, 8))
    red = render.Camera(geo, 3, 2, 0.5, 8, spectrum=Spectrum((0.6562725,), (1.0,))).rays()
    assert torch.equal(
        rays.direction.reshape(6, 8, 3)[:, 4:], red.direction.reshape(6, 8, 3)[:, 4:]
    )
