"""Ray aiming and radiometry: rays meet the real stop; irradiance agrees with closed forms and with the area
of the image-space cone."""

import math
from dataclasses import replace

import pytest
import torch

from codesign import lens, render
from codesign.lens import GeoLens, Glass, Pinhole, Surface, ThinLens
from codesign.lens.aiming import aimed_rays
from codesign.lens.analysis import field_rays, pupil_grid
from codesign.lens.radiometry import relative_illumination
from codesign.lens.trace import trace

F64 = torch.float64
RIM = torch.stack(
    [
        torch.cos(torch.arange(720, dtype=F64) * math.pi / 360),
        torch.sin(torch.arange(720, dtype=F64) * math.pi / 360),
    ],
    1,
)
FIELDS = {"cooke-triplet": 20.0, "double-gauss": 14.0, "la1509": 2.0}


def at_stop(geo, origin, direction):
    return trace(geo.prescription().until(geo.stop_index), origin, direction).position_mm[:, :2]


@pytest.mark.parametrize("name", FIELDS)
def test_aimed_rays_meet_the_stop(name):
    geo = lens.load(name)
    pupil = pupil_grid(12)
    field = math.radians(FIELDS[name])
    origin, direction = aimed_rays(geo, field, pupil)
    wanted = pupil * geo.first_order().stop_semi_aperture_mm.detach()
    torch.testing.assert_close(at_stop(geo, origin, direction), wanted, rtol=0, atol=1e-10)
    assert (
        float((at_stop(geo, *field_rays(geo, field, pupil)) - wanted).abs().max().detach()) > 1e-3
    )  # which paraxial aim does not


def wide_angle():
    """A reversed telephoto of strong negative front elements: at 65 degrees the real entrance pupil is far
    from the paraxial one."""
    glass = Glass.named("N-SK16")
    return GeoLens(
        [
            Surface(40.0, 2.0, glass, 25.0),
            Surface(12.0, 16.0, None, 11.9),
            Surface(60.0, 6.0, glass, 9.0),
            Surface(-40.0, 6.0, None, 9.0),
            Surface(math.inf, 4.0, None, 5.0, is_stop=True),
            Surface(60.0, 4.0, glass, 9.0),
            Surface(-18.0, 30.0, None, 9.0),
        ],
        2.0,
    )


def test_wide_fields_are_reached_from_the_axis():
    geo = wide_angle()
    pupil = pupil_grid(6)
    field = math.radians(65.0)
    origin, direction = aimed_rays(geo, field, pupil)
    wanted = pupil * geo.first_order().stop_semi_aperture_mm.detach()
    torch.testing.assert_close(at_stop(geo, origin, direction), wanted, rtol=0, atol=1e-9)
    missed = at_stop(geo, *field_rays(geo, field, pupil)) - wanted
    assert float(missed.norm(dim=1).max().detach()) > 0.5 * float(
        geo.first_order().stop_semi_aperture_mm.detach()
    )


def test_rays_that_cannot_be_aimed_are_told_and_keep_their_paraxial_aim():
    geo = wide_angle()
    field = math.radians(85.0)
    pupil = pupil_grid(4)
    with pytest.warns(UserWarning, match=r"rays cannot be aimed at the stop .* keep their paraxial aim"):
        origin, direction = aimed_rays(geo, field, pupil)
    first = geo.first_order()
    wanted = pupil * first.stop_semi_aperture_mm
    lost = ((at_stop(geo, origin, direction) - wanted).norm(dim=1) > 1e-6).detach()
    assert bool(lost.any())
    crossing = origin + direction * ((first.entrance_pupil_z_mm - origin[:, 2:]) / direction[:, 2:])
    guess = pupil * first.entrance_pupil_diameter_mm / 2  # on the plane of the paraxial entrance pupil
    torch.testing.assert_close(crossing[lost, :2].detach(), guess[lost].detach(), rtol=0, atol=1e-9)


def test_the_gradient_of_aimed_rays_is_that_of_the_implicit_function():
    geo = lens.load("cooke-triplet")
    pupil = pupil_grid(4)

    def merit(curvature):
        changed = geo.replace(curvature_per_mm=curvature)
        origin, direction = aimed_rays(changed, 0.3, pupil)
        return changed.trace(origin, direction).position_mm[:, 1].square().sum()

    start = geo.curvature_per_mm.detach().clone().requires_grad_(True)
    (gradient,) = torch.autograd.grad(merit(start), start)
    for i in range(6):
        step = torch.zeros(6, dtype=F64)
        step[i] = 1e-6
        difference = (merit(start + step) - merit(start - step)).item() / 2e-6
        assert gradient[i].item() == pytest.approx(
            difference, rel=1e-6, abs=1e-6 * gradient.abs().max().item()
        )


def cone_area(geo, field):
    """Area of the image-space cone of a field in direction cosines, by its rim (shoelace)."""
    out = geo.trace(*aimed_rays(geo, field, RIM))
    x = out.direction.detach()[:, 0]
    y = out.direction.detach()[:, 1]
    return 0.5 * float((x * y.roll(-1) - x.roll(-1) * y).sum().abs())


@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss"])
def test_illumination_is_the_area_of_the_image_space_cone(name):
    """Without vignetting. The grid of pupil points integrates a smooth function over a disc of stairs: 0.3 %.

    The cone is that of one object direction; the image point of the chief ray collects the same but for
    aberrations, whose share is as small.
    """
    geo = lens.load(name)
    open_lens = GeoLens(
        [
            s
            if s.is_stop
            else Surface(
                s.radius_mm, s.thickness_mm, s.medium, 0.99 * min(abs(s.radius_mm), 60.0), is_stop=s.is_stop
            )
            for s in geo.surfaces
        ],
        geo.entrance_pupil_diameter_mm,
    )
    fields = [math.radians(FIELDS[name] * share) for share in (0.5, 0.8)]
    found = relative_illumination(open_lens, fields, grid=40).detach()
    for field, value in zip(fields, found.tolist(), strict=True):
        assert value == pytest.approx(cone_area(open_lens, field) / cone_area(open_lens, 0.0), rel=6e-3)


def test_vignetting_takes_the_share_of_rays_that_the_hard_apertures_stop():
    """The two samplings of the pupil differ by its distortion: below 1 % of the light."""
    published = lens.load("double-gauss")
    field = math.radians(14.0)
    geo = GeoLens(published.surfaces, published.entrance_pupil_diameter_mm, soft_edge_mm=0.02)
    wide = GeoLens(
        [
            replace(s, semi_aperture_mm=min(1.4 * s.semi_aperture_mm, 0.99 * abs(s.radius_mm)))
            for s in published.surfaces
        ],
        published.entrance_pupil_diameter_mm,
    )
    inside = geo.trace(*aimed_rays(geo, field, pupil_grid(40))).inside.double().mean().item()
    assert 0.9 < inside < 0.97
    taken = (
        relative_illumination(geo, [field], grid=40) / relative_illumination(wide, [field], grid=40)
    ).item()
    assert taken == pytest.approx(inside, abs=0.01)
    assert relative_illumination(geo, [0.0]).item() == pytest.approx(1.0, abs=1e-12)


class UniformWorld:
    """Radiance 1 from everywhere."""

    def frame(self, camera):
        rays = camera.rays()
        return rays.weight.reshape(*camera.film.shape, camera.samples_per_pixel).mean(-1)


def disc_irradiance(tangent, pupil_tangent):
    """Irradiance of a plane by a parallel uniform disc of unit radiance seen off its axis, over pi (Foote
    1915): exact for any aperture."""
    t2 = tangent**2
    a2 = pupil_tangent**2
    return 0.5 * (1 - (1 + t2 - a2) / math.sqrt(t2**2 + 2 * t2 * (1 - a2) + (1 + a2) ** 2))


@pytest.mark.parametrize("diameter", [0.0, 4.0, 20.0])
def test_a_uniform_world_falls_off_as_an_ideal_lens_makes_it(diameter):
    """Sensor of 29 x 1 mm behind 20 mm of air: cos^4 for the pinhole, the disc formula for wide pupils. 256
    samples integrate to 3e-3."""
    camera = render.Camera(
        Pinhole(20.0) if diameter == 0 else ThinLens(20.0, diameter), 29, 1, 1.0, 256, falloff=True
    )
    image = UniformWorld().frame(camera)[0]
    for column in (0, 7, 14):
        tangent = abs(column - 14) / 20.0
        if diameter == 0:
            expected = math.cos(math.atan(tangent)) ** 4
        else:
            expected = disc_irradiance(tangent, diameter / 40) / (diameter / 40) ** 2
        assert float(image[column]) == pytest.approx(expected, rel=3e-3)
    flat = UniformWorld().frame(render.Camera(Pinhole(20.0), 29, 1, 1.0, 4))
    torch.testing.assert_close(flat, torch.ones_like(flat))


def test_colours_share_the_samples_of_a_pixel():
    from codesign.lens.spectrum import Spectrum

    geo = lens.load("cooke-triplet")
    spectrum = Spectrum((0.4861327, 0.6562725), (0.25, 0.75))
    rays = render.Camera(geo, 3, 2, 0.5, 8, spectrum=spectrum).rays()
    torch.testing.assert_close(rays.weight.reshape(6, 8).mean(1), torch.ones(6, dtype=F64))
    torch.testing.assert_close(
        rays.weight.reshape(6, 8)[:, [0, 7]], torch.tensor([[0.5, 1.5]], dtype=F64).expand(6, 2)
    )
    red = render.Camera(geo, 3, 2, 0.5, 8, spectrum=Spectrum((0.6562725,), (1.0,))).rays()
    torch.testing.assert_close(
        rays.direction.reshape(6, 8, 3)[:, 4:], red.direction.reshape(6, 8, 3)[:, 4:], rtol=0, atol=0
    )
    with pytest.raises(Exception, match="cannot be shared equally by 2 wavelengths"):
        render.Camera(geo, 3, 2, 0.5, 7, spectrum=spectrum)


def by_differences(function, start, step):
    """Central differences of a scalar function of a vector; the second derivative leaves about step^2."""
    moved = torch.eye(len(start), dtype=F64) * step
    return torch.stack([(function(start + by) - function(start - by)) / (2 * step) for by in moved]).detach()


@pytest.mark.parametrize("name", ["curvature_per_mm", "thickness_mm"])
def test_the_gradient_of_irradiance_counts_the_motion_of_the_aimed_rays(name):
    geo = lens.load("cooke-triplet").freeze()
    pupil = pupil_grid(4)
    film = torch.tensor([[0.0, 10.0]], dtype=F64).expand(len(pupil), 2)

    def irradiance(value):
        rays = geo.replace(**{name: value}).camera_rays(film, pupil, aim=True)
        return rays.irradiance.mean()

    def illumination(value):
        return relative_illumination(geo.replace(**{name: value}), [0.2], grid=8)[0]

    start = getattr(geo, name).detach()
    for figure in (irradiance, illumination):
        at = start.clone().requires_grad_()
        (found,) = torch.autograd.grad(figure(at), at)
        truth = by_differences(figure, start, 1e-6 if name == "curvature_per_mm" else 1e-4)
        # the derivative at the stop is a difference of rays, 1e-6 of it
        torch.testing.assert_close(found, truth, rtol=0, atol=1e-5 * float(truth.abs().max()))


@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss"])
@pytest.mark.filterwarnings("error")
def test_a_float32_lens_is_aimed_and_lit_as_in_float64(name):
    geo = lens.load(name).freeze()
    single = lens.load(name).float().freeze()
    # its numbers are rounded to 6e-8 of themselves
    torch.testing.assert_close(
        relative_illumination(single, [0.1, 0.2], grid=8),
        relative_illumination(geo, [0.1, 0.2], grid=8).float(),
        rtol=0,
        atol=1e-5,
    )
    pupil = pupil_grid(4)
    origin, direction = aimed_rays(single, 0.2, pupil.float())
    assert origin.dtype == direction.dtype == torch.float32
    torch.testing.assert_close(origin, aimed_rays(geo, 0.2, pupil)[0].float(), rtol=0, atol=2e-5)
    film = torch.tensor([[0.0, 5.0]], dtype=F64).expand(len(pupil), 2)
    close = single.camera_rays(film.float(), pupil.float(), aim=True)
    truth = geo.camera_rays(film, pupil, aim=True)
    assert close.irradiance.dtype == torch.float32
    torch.testing.assert_close(close.irradiance, truth.irradiance.float(), rtol=1e-5, atol=0)
