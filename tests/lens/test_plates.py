"""Phase plates: their polynomials and splines, rays and light through them, and plates found by
gradient."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

from codesign import lens
from codesign.lens import GeoLens, Phase, Status, Surface, analysis, pupil_grid
from codesign.lens.diffraction import GridPlate, ZernikePlate, noll, with_plate, zernike
from tests.lens.systems import PLANE, check_gradient, close, figure_of, paraboloid
from tests.numbers import D, f64, rand64, randn64, seeded


def landscape():
    """A singlet behind a stop that is a plane in air."""
    singlet = Surface(60.0, 4.0, lens.Glass.named("N-BK7"), 12.0), Surface(-70.0, 60.0, None, 12.0)
    return GeoLens([Surface(PLANE, 4.0, None, 6.0, is_stop=True), *singlet], 8.0).requires_grad_(
        False
    )


def bumpy(count=9, pitch=1.5, scale=2.0, **options):
    generator = seeded(5)
    return GridPlate(scale * randn64(generator, count, count), pitch, **options)


# --- polynomials and splines


def test_terms_are_orthonormal_over_the_disc():
    # Gauss-Legendre in r^2 and even angles integrate products up to order 2 x 8 exactly
    nodes, weights = (torch.tensor(v) for v in np.polynomial.legendre.leggauss(12))
    angle = torch.arange(40, dtype=D) * (2 * math.pi / 40)
    r = ((nodes + 1) / 2).sqrt()[:, None]
    points = torch.stack([r * angle.cos(), r * angle.sin()], -1).reshape(-1, 2)
    values, _ = zernike(range(1, 46), points)
    mean = (weights / 2 / 40).repeat_interleave(40)
    close(values.T @ (values * mean[:, None]), torch.eye(45, dtype=D), atol=1e-12)


def test_terms_are_those_of_nolls_table():
    table = ["00", "11", "1-1", "20", "2-2", "22", "3-1", "31", "3-3", "33", "40"]
    assert [noll(j) for j in range(1, 12)] == [(int(term[0]), int(term[1:])) for term in table]
    x, y = 0.3, -0.55
    r2 = x * x + y * y
    expected = {
        2: 2 * x,
        4: math.sqrt(3) * (2 * r2 - 1),
        7: math.sqrt(8) * (3 * r2 - 2) * y,
        11: math.sqrt(5) * (6 * r2 * r2 - 6 * r2 + 1),
        22: math.sqrt(7) * (20 * r2**3 - 30 * r2**2 + 12 * r2 - 1),
    }
    values, _ = zernike(tuple(expected), f64([[x, y]]))
    close(values[0], list(expected.values()), atol=1e-13)


def test_slopes_are_derivatives(generator):
    points = randn64(generator, 4, 2) * 0.6
    for plate in (ZernikePlate({j: 0.1 * j for j in range(1, 29)}, 1.3), bumpy()):
        at = points.clone().requires_grad_()
        phase, slope, _ = plate.look(at)
        close(slope, torch.autograd.grad(phase.sum(), at)[0], 1e-12, atol=1e-12)
        assert torch.autograd.gradcheck(lambda p, plate=plate: plate.look(p)[:2], at)


def test_a_grid_is_the_natural_spline_through_its_points(generator):
    plate = bumpy()
    x = ((torch.arange(9, dtype=D) - 4) * 1.5).numpy()
    points = rand64(generator, 50, 2) * 12 - 6
    phase, _, reaches = plate.look(points)
    rows = CubicSpline(x, plate.phase_rad.detach().numpy(), axis=1, bc_type="natural")
    truth = [float(CubicSpline(x, rows(px), bc_type="natural")(py)) for px, py in points.tolist()]
    close(phase, truth, atol=1e-12)
    assert reaches.all()
    assert not bool(plate.look(f64([[6.01, 0.0]]))[2])


# --- rays


@pytest.mark.parametrize("where", ["before the stop", "behind the stop", "behind the last surface"])
@pytest.mark.parametrize("wavelength_um", [0.5875618, 0.48])
def test_a_round_plate_is_a_diffractive_surface(where, wavelength_um):
    # the kernel's own phase a r^2 + b r^4 on a plane of its own, against a plate of the same phase
    geo = landscape()
    a, b, radius = -0.9, 0.02, 5.0
    c11 = b * radius**4 / (6 * math.sqrt(5))
    c4 = (a * radius**2 + 6 * math.sqrt(5) * c11) / (2 * math.sqrt(3))
    c1 = math.sqrt(3) * c4 - math.sqrt(5) * c11
    plate = ZernikePlate({1: c1, 4: c4, 11: c11}, radius, diffractive=True)
    stop, front, back = geo.surfaces

    def at(thickness):
        return Surface(PLANE, thickness, None, 12.0, phase=Phase((a, b)))

    surfaces, z, surface, origin = {
        "before the stop": ([at(1.5), stop, front, back], -1.5, None, 1.5),
        "behind the stop": ([replace(stop, thickness_mm=1.0), at(3.0), front, back], 1.0, 0, 0.0),
        "behind the last surface": (
            [stop, front, replace(back, thickness_mm=20.0), at(40.0)],
            20.0,
            -1,
            0.0,
        ),
    }[where]
    start, direction = analysis.field_rays(geo, 0.08, pupil_grid(12))
    found = with_plate(geo, plate, surface, z).trace(start, direction, wavelength_um)
    shifted = start + f64([0, 0, origin])
    expected = GeoLens(surfaces, 8.0).trace(shifted, direction, wavelength_um)
    for name in ("position_mm", "direction", "optical_path_mm", "weight"):
        close(getattr(found, name), getattr(expected, name), atol=2e-13)
    bare = geo.trace(start, direction, wavelength_um)
    assert (found.position_mm - bare.position_mm).abs().max() > 0.005


@pytest.mark.parametrize("where", [{"z_mm": 1.0}, {"surface": -1, "z_mm": 5.0}])
@pytest.mark.parametrize("aim", [False, True])
@torch.no_grad()
def test_rays_of_the_camera_go_the_same_way_back(where, aim):
    geo = lens.load("cooke-triplet").replace()
    film = f64([[1.0, 2.0], [0.3, -4.0], [5.0, 0.0]])
    pupil = f64([[0.3, 0.2], [-0.4, 0.6], [0.0, 0.0]])
    flip = f64([1.0, 1.0, -1.0])
    plated = with_plate(geo, bumpy(15, 1.0), **where)
    rays = plated.camera_rays(film, pupil, aim=aim)
    start = (rays.origin_m + rays.direction) * 1e3 * flip
    start[:, 2] += geo.first_order().entrance_pupil_z_mm
    out = plated.trace(start, -rays.direction * flip)
    close(-out.position_mm[:, :2], film, atol=1e-8)
    assert (rays.direction - geo.camera_rays(film, pupil, aim=aim).direction).norm(
        dim=1
    ).min() > 1e-6


def test_copies_own_their_plate_and_replacements_share_it():
    plate = ZernikePlate({4: 1.0}, 4.0)
    plated = with_plate(landscape(), plate, z_mm=1.0)
    assert plated.replace().plate is plate
    assert with_plate(plated, None).scaled(0.5).plate is None
    assert [name for name, _ in plated.named_parameters()] == ["plate.coefficients_rad"]
    twin = copy.deepcopy(plated)
    with torch.no_grad():
        twin.plate.coefficients_rad.fill_(9.0)
    assert plate.coefficients_rad.tolist() == [1.0]
    plated.load_state_dict(twin.state_dict())
    assert plate.coefficients_rad.tolist() == [9.0]


@pytest.mark.parametrize("plate", [ZernikePlate({4: 1.0}, 4.0), GridPlate(torch.ones(6, 6), 2.0)])
def test_loading_and_converting_a_replacement_leave_the_plate_alone(plate):
    plated = with_plate(landscape(), plate, z_mm=1.0)
    (first,) = plate.parameters()
    twin = plated.replace()
    state = twin.state_dict()
    twin.load_state_dict(
        state | {name: v * 0 for name, v in state.items() if "extra_state" not in name}
    )
    assert next(twin.plate.parameters()).detach().abs().max() == 0
    for other in (plated.replace(), plated):
        assert next(other.float().plate.parameters()).dtype == torch.float32
    assert next(plate.parameters()) is first
    assert first.dtype == D
    assert first.detach().min() == 1.0


def test_what_a_plate_stops_is_said():
    geo = landscape()
    start = f64([[0.0, 0.0, -5.0], [3.5, 0.0, -5.0], [7.0, 0.0, -5.0]])
    ahead = f64([[0.0, 0.0, 1.0]] * 3)
    # reaches 3 mm
    out = with_plate(geo, GridPlate(torch.zeros(5, 5, dtype=D), 1.5), z_mm=1.0).trace(start, ahead)
    assert out.status.tolist() == [Status.OK, Status.MISS, Status.MISS]
    assert out.failed_surface.tolist() == [-1, 0, 0]
    assert (out.weight > 0).tolist() == [True, False, False]
    out = with_plate(geo, ZernikePlate({4: 1e5}, 4.0), z_mm=1.0).trace(start[:2], ahead[:2])
    assert out.status.tolist() == [Status.OK, Status.TOTAL_REFLECTION]
    assert out.deficit[1] > 0
    # the hard mask of a surface behind the plate
    later = GeoLens([*geo.surfaces[:2], Surface(-70.0, 60.0, None, 2.0)], 8.0, soft_edge_mm=0.0)
    out = with_plate(later, bumpy(), z_mm=1.0).trace(start[:2], ahead[:2])
    assert out.inside.tolist() == [True, False]


@pytest.mark.parametrize("where", [{"z_mm": -1.5}, {"z_mm": 1.0}, {"surface": -1, "z_mm": 20.0}])
def test_gradients_of_rays_reach_the_plate_and_the_lens(where):
    geo = landscape()
    rays = [v.detach() for v in analysis.field_rays(geo, 0.05, pupil_grid(4))]
    film = f64([[1.0, 2.0], [0.3, -4.0]])
    pupil = f64([[0.3, 0.2], [-0.4, 0.6]])
    plate = ZernikePlate({4: 0.0, 7: 0.0, 11: 0.0}, 5.0)

    def rays_of(plated):
        out, back = plated.trace(*rays), plated.camera_rays(film, pupil, aim=True)
        there = (out.position_mm + out.direction).square().sum() + out.optical_path_mm.sum()
        return there + (back.direction[:, :2] / back.direction[:, 2:]).sum() + back.origin_m.sum()

    def loss(coefficients, curvature):
        plated = with_plate(geo.replace(curvature_per_mm=curvature), plate, **where)
        return figure_of(plated, rays_of, [plate.coefficients_rad])(coefficients)

    check_gradient(loss, f64([3.0, -2.0, 1.0]), geo.curvature_per_mm)


# --- light


def test_a_plate_in_the_pupil_adds_its_phase_to_the_wavefront():
    # to first order the path of the bare rays; the second is that of the turn, slope^2 f / 2 w =
    # 5e-6 waves
    geo = landscape()
    radius = float(geo.first_order().stop_semi_aperture_mm)
    bare = analysis.wavefront(geo, 0.0, grid=16)
    # the stop is the entrance pupil; the chief ray, unturned, passes the centre
    at = torch.cat([bare.pupil * radius, torch.zeros(1, 2, dtype=D)])
    for scale in (1.0, 0.25):
        plate = ZernikePlate({4: 0.01 * scale, 5: 0.02 * scale, 11: -0.01 * scale}, radius)
        path = plate.look(at)[0].detach() * plate.mm_per_rad(0.5875618)
        found = analysis.wavefront(with_plate(geo, plate), 0.0, grid=16)
        away = found.opd_mm - bare.opd_mm + (path[:-1] - path[-1])
        assert away.abs().max() < 1e-5 * scale**2 * 0.5875618e-3


def before_film(pupil, distance_mm, pixel, count):
    """Places [count] and field [count, count] about the axis on a plane before the film: each plane
    wave of the pupil taken back by its own path, and summed."""
    x, y = pupil.cosines()
    axial = (1 - x.square() - y[:, None].square()).sqrt()
    back = torch.polar(
        torch.ones_like(axial), -2 * math.pi / pupil.wavelength_mm * distance_mm * axial
    )
    places = (torch.arange(count, dtype=D) - count // 2) * pixel
    return places, replace(pupil, field=pupil.field * back).amplitude(places)


def onward(field, distance_mm, pixel, wide=3):
    """The field on its own grid further on: its plane waves, on a grid padded to ``wide`` times its
    size, by their paths. Source: Goodman, Introduction to Fourier Optics, ch. 3."""
    count = len(field)
    cosine = torch.fft.fftfreq(wide * count, dtype=D) * (0.5875618e-3 / pixel)
    axial = (1 - cosine.square() - cosine[:, None].square()).clamp_min(0).sqrt()
    paths = torch.polar(torch.ones_like(axial), 2 * math.pi / 0.5875618e-3 * distance_mm * axial)
    return torch.fft.ifft2(torch.fft.fft2(field, s=paths.shape) * paths)[:count, :count]


def test_light_behind_the_last_surface_is_that_between_plane_waves():
    # a plate in the converging light of an f/12.5: its phase on rays of the bare lens, against a
    # thin element in the field, whose rim diffracts on the way to the plate: that differs as 1 /
    # Fresnel number of the plate
    geo = paraboloid(4.0, 50.0).requires_grad_(False)
    pixel = 0.002

    def difference(before_mm, count):
        plate = ZernikePlate({5: 0.4, 7: 0.5, 11: 0.3}, 0.04 * before_mm).requires_grad_(False)
        psf = analysis.psf_on_pixels(
            with_plate(geo, plate, -1, 50 - before_mm), 0.0, pixel, 48, grid=256
        )
        x, field = before_film(analysis.pupil_function(geo, 0.0, grid=320), before_mm, pixel, count)
        # of an Airy pattern
        beyond = 2 / (math.pi * 2 * math.pi / 0.5875618e-3 * 0.04 * pixel * count / 2)
        energy = float(field.abs().square().sum()) * pixel**2
        close(energy, 1 - beyond, atol=2e-3)
        points = torch.stack(torch.meshgrid(x, x, indexing="xy"), -1).reshape(-1, 2)
        phase = plate.look(points)[0].reshape(count, count)
        film = onward(field * torch.polar(torch.ones_like(phase), phase), before_mm, pixel)
        # about the chief ray, which the plate turns
        shift = psf.reference_mm / pixel
        f = torch.fft.fftfreq(count, dtype=D)
        turn = torch.exp(2j * math.pi * (f * shift[0] + f[:, None] * shift[1]))
        at = torch.fft.ifft2(torch.fft.fft2(film) * turn).abs().square() * pixel**2
        middle = slice(count // 2 - 24, count // 2 + 24)
        return float((psf.energy - at[middle, middle]).abs().max() / psf.energy.max())

    far, near = difference(12.0, 640), difference(6.0, 384)  # Fresnel numbers 33 and 16
    assert far < 1.5 / 33
    assert near > 1.6 * far  # it is that difference and no other


@pytest.mark.parametrize(
    "plate",
    [ZernikePlate({4: 0.0, 9: 0.0}, 4.0), GridPlate(torch.zeros(6, 6), 2.0)],
    ids=["zernike", "grid"],
)
def test_gradients_of_light_reach_the_plate(plate, generator):
    picture = rand64(generator, 16, 16)
    (parameter,) = plate.parameters()
    values = rand64(generator, parameter.shape) + 0.5

    def light(plated):
        found = analysis.psf_on_pixels(plated, 0.03, 0.004, 16, (0.55, 0.6), grid=192, at_m=1.5)
        return (found.energy * picture).sum()

    plated = with_plate(landscape(), plate, z_mm=1.0)
    check_gradient(figure_of(plated, light, [parameter]), values, step=1e-4)


def test_phase_follows_wavelength_as_its_kind_says():
    relief = ZernikePlate({4: 1.0}, 4.0, wavelength_um=0.55)
    grating = ZernikePlate({4: 1.0}, 4.0, wavelength_um=0.55, diffractive=True)
    assert (
        relief.mm_per_rad(0.45) == relief.mm_per_rad(0.65) == pytest.approx(0.55e-3 / (2 * math.pi))
    )
    close(grating.mm_per_rad(0.65) / grating.mm_per_rad(0.55), 0.65 / 0.55, 1e-06)


# --- refusals
