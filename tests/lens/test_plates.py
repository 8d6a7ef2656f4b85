"""Phase plates: their polynomials and splines, rays and light through them, and plates found by gradient."""

import copy
import math

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

from codesign import lens
from codesign.errors import DomainError, ShapeError
from codesign.lens import GeoLens, Phase, Surface, analysis, pupil_grid, wave
from codesign.lens.plates import GridPlate, ZernikePlate, noll, with_plate, zernike

D = torch.float64
PLANE = float("inf")


def mirror(diameter=4.0, focal=50.0):
    """Paraboloid with its stop, free of aberration on the axis."""
    surface = Surface(-2 * focal, focal, None, 12.0, conic=-1.0, is_stop=True, mirror=True)
    return GeoLens([surface], diameter).requires_grad_(False)


def landscape():
    """A singlet behind a stop that is a plane in air."""
    glass = lens.Glass.named("N-BK7")
    return GeoLens(
        [
            Surface(PLANE, 4.0, None, 6.0, is_stop=True),
            Surface(60.0, 4.0, glass, 12.0),
            Surface(-70.0, 60.0, None, 12.0),
        ],
        8.0,
    ).requires_grad_(False)


def bumpy(count=9, pitch=1.5, scale=2.0, **options):
    generator = torch.Generator().manual_seed(5)
    return GridPlate(scale * torch.randn(count, count, dtype=D, generator=generator), pitch, **options)


# --- polynomials and splines


def test_terms_are_orthonormal_over_the_disc():
    # Gauss-Legendre in r^2 and even angles integrate products up to order 2 x 8 exactly
    nodes, weights = (torch.tensor(v) for v in np.polynomial.legendre.leggauss(12))
    angle = torch.arange(40, dtype=D) * (2 * math.pi / 40)
    r = ((nodes + 1) / 2).sqrt()[:, None]
    points = torch.stack([r * angle.cos(), r * angle.sin()], -1).reshape(-1, 2)
    values, _ = zernike(range(1, 46), points)
    mean = (weights / 2 / 40).repeat_interleave(40)
    torch.testing.assert_close(
        values.T @ (values * mean[:, None]), torch.eye(45, dtype=D), rtol=0, atol=1e-12
    )


def test_terms_are_those_of_nolls_table():
    assert [noll(j) for j in range(1, 12)] == [
        (0, 0),
        (1, 1),
        (1, -1),
        (2, 0),
        (2, -2),
        (2, 2),
        (3, -1),
        (3, 1),
        (3, -3),
        (3, 3),
        (4, 0),
    ]
    x, y = 0.3, -0.55
    r2 = x * x + y * y
    expected = {
        2: 2 * x,
        4: math.sqrt(3) * (2 * r2 - 1),
        5: math.sqrt(6) * 2 * x * y,
        7: math.sqrt(8) * (3 * r2 - 2) * y,
        9: math.sqrt(8) * (3 * x * x * y - y**3),
        11: math.sqrt(5) * (6 * r2 * r2 - 6 * r2 + 1),
        22: math.sqrt(7) * (20 * r2**3 - 30 * r2**2 + 12 * r2 - 1),
    }
    values, _ = zernike(tuple(expected), torch.tensor([[x, y]], dtype=D))
    torch.testing.assert_close(values[0], torch.tensor(list(expected.values()), dtype=D), rtol=0, atol=1e-13)


def test_slopes_are_derivatives():
    points = torch.randn(30, 2, dtype=D, generator=torch.Generator().manual_seed(2)) * 0.6
    for plate in (ZernikePlate({j: 0.1 * j for j in range(1, 29)}, 1.3), bumpy()):
        at = points.clone().requires_grad_()
        phase, slope, _ = plate.look(at)
        (found,) = torch.autograd.grad(phase.sum(), at)
        torch.testing.assert_close(slope, found, rtol=1e-12, atol=1e-12)
        few = points[:4].clone().requires_grad_()
        assert torch.autograd.gradcheck(lambda p, plate=plate: plate.look(p)[:2], few)


def test_a_grid_is_the_natural_spline_through_its_points():
    plate = bumpy()
    x = (torch.arange(9, dtype=D) - 4) * 1.5
    points = torch.rand(50, 2, dtype=D, generator=torch.Generator().manual_seed(1)) * 12 - 6
    phase, _, reaches = plate.look(points)
    rows = CubicSpline(x.numpy(), plate.phase_rad.detach().numpy(), axis=1, bc_type="natural")
    truth = []
    for px, py in points.tolist():
        truth.append(float(CubicSpline(x.numpy(), rows(px), bc_type="natural")(py)))
    torch.testing.assert_close(phase, torch.tensor(truth, dtype=D), rtol=0, atol=1e-12)
    assert bool(reaches.all())
    assert not bool(plate.look(torch.tensor([[6.01, 0.0]], dtype=D))[2])


# --- rays


@pytest.mark.parametrize("place", ["before the stop", "behind the stop", "behind the last surface"])
@pytest.mark.parametrize("wavelength_um", [0.5875618, 0.48])
def test_a_round_plate_is_a_diffractive_surface(place, wavelength_um):
    # the kernel's own phase a r^2 + b r^4 on a plane of its own, against a plate of the same phase
    geo = landscape()
    a, b, radius = -0.9, 0.02, 5.0
    c11 = b * radius**4 / (6 * math.sqrt(5))
    c4 = (a * radius**2 + 6 * math.sqrt(5) * c11) / (2 * math.sqrt(3))
    c1 = math.sqrt(3) * c4 - math.sqrt(5) * c11
    plate = ZernikePlate({1: c1, 4: c4, 11: c11}, radius, diffractive=True)
    stop, front, back = geo.surfaces

    def gap(surface, thickness):
        return Surface(
            surface.radius_mm, thickness, surface.medium, surface.semi_aperture_mm, is_stop=surface.is_stop
        )

    def at(thickness):
        return Surface(PLANE, thickness, None, 12.0, phase=Phase((a, b)))

    surfaces, z, surface, origin = {
        "before the stop": ([at(1.5), stop, front, back], -1.5, None, 1.5),
        "behind the stop": ([gap(stop, 1.0), at(3.0), front, back], 1.0, 0, 0.0),
        "behind the last surface": ([stop, front, gap(back, 20.0), at(40.0)], 20.0, -1, 0.0),
    }[place]
    plated = with_plate(geo, plate, surface, z)
    truth = GeoLens(surfaces, 8.0)
    start, direction = analysis.field_rays(geo, 0.08, pupil_grid(12))
    found = plated.trace(start, direction, wavelength_um)
    expected = truth.trace(start + torch.tensor([0, 0, origin], dtype=D), direction, wavelength_um)
    for name in ("position_mm", "direction", "optical_path_mm", "weight"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=0, atol=2e-13)
    bare = geo.trace(start, direction, wavelength_um)
    assert bool((found.position_mm - bare.position_mm).abs().max() > 0.005)


def test_rays_of_the_camera_go_the_same_way_back():
    geo = lens.load("cooke-triplet").replace()
    film = torch.tensor([[1.0, 2.0], [0.3, -4.0], [5.0, 0.0]], dtype=D)
    pupil = torch.tensor([[0.3, 0.2], [-0.4, 0.6], [0.0, 0.0]], dtype=D)
    flip = torch.tensor([1.0, 1.0, -1.0], dtype=D)
    for surface, z_mm in ((None, 1.0), (-1, 5.0)):
        plated = with_plate(geo, bumpy(15, 1.0), surface, z_mm)
        for aim in (False, True):
            rays = plated.camera_rays(film, pupil, aim=aim)
            start = (rays.origin_m + rays.direction) * 1e3 * flip
            start[:, 2] += geo.first_order().entrance_pupil_z_mm.detach()
            out = plated.trace(start.detach(), -rays.direction.detach() * flip)
            torch.testing.assert_close(-out.position_mm[:, :2], film, rtol=0, atol=1e-8)
            assert (rays.direction - geo.camera_rays(film, pupil, aim=aim).direction).norm(dim=1).min() > 1e-6


def test_gradients_of_the_cameras_rays_reach_the_plate():
    geo = landscape()
    film = torch.tensor([[1.0, 2.0], [0.3, -4.0]], dtype=D)
    pupil = torch.tensor([[0.3, 0.2], [-0.4, 0.6]], dtype=D)
    for surface, z_mm in ((None, 1.0), (-1, 20.0)):
        plate = ZernikePlate({7: 2.0, 11: 1.0}, 5.0)
        plated = with_plate(geo, plate, surface, z_mm)

        def slope(plated=plated):
            rays = plated.camera_rays(film, pupil, aim=True)
            return (rays.direction[:, :2] / rays.direction[:, 2:]).sum() + rays.origin_m.sum()

        (found,) = torch.autograd.grad(slope(), plate.coefficients_rad)
        for i in range(2):
            values = []
            for step in (1e-3, -2e-3, 1e-3):
                plate.coefficients_rad.data[i] += step
                values.append(float(slope().detach()))
            assert float(found[i]) == pytest.approx((values[0] - values[1]) / 2e-3, rel=1e-6)


def test_copies_own_their_plate_and_replacements_share_it():
    plate = ZernikePlate({4: 1.0}, 4.0)
    plated = with_plate(landscape(), plate, z_mm=1.0)
    assert plated.replace().plate is plate
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
    twin.load_state_dict(state | {name: v * 0 for name, v in state.items() if "extra_state" not in name})
    assert float(next(twin.plate.parameters()).detach().abs().max()) == 0
    for other in (plated.replace(), plated):
        assert next(other.float().plate.parameters()).dtype == torch.float32
    assert next(plate.parameters()) is first
    assert first.dtype == D
    assert float(first.detach().min()) == 1.0


def test_what_a_plate_stops_is_said():
    geo = landscape()
    start = torch.tensor([[0.0, 0.0, -5.0], [3.5, 0.0, -5.0], [7.0, 0.0, -5.0]], dtype=D)
    ahead = torch.tensor([0.0, 0.0, 1.0], dtype=D).expand(3, 3)
    small = GridPlate(torch.zeros(5, 5, dtype=D), 1.5)  # reaches 3 mm
    out = with_plate(geo, small, z_mm=1.0).trace(start, ahead)
    assert out.status.tolist() == [0, int(lens.Status.MISS), int(lens.Status.MISS)]
    assert out.failed_surface.tolist() == [-1, 0, 0]
    assert (out.weight > 0).tolist() == [True, False, False]
    steep = ZernikePlate({4: 1e5}, 4.0)
    out = with_plate(geo, steep, z_mm=1.0).trace(start[:2], ahead[:2])
    assert out.status.tolist() == [0, int(lens.Status.TOTAL_REFLECTION)]
    assert bool(out.deficit[1] > 0)
    later = GeoLens([*geo.surfaces[:2], Surface(-70.0, 60.0, None, 2.0)], 8.0, soft_edge_mm=0.0)
    out = with_plate(later, bumpy(), z_mm=1.0).trace(start[:2], ahead[:2])
    assert out.inside.tolist() == [True, False]  # the hard mask of a surface behind the plate


class Traced(torch.nn.Module):
    """Rays of a lens as the forward pass, for torch.func."""

    def __init__(self, inner):
        super().__init__()
        self.inner = inner

    def forward(self, *rays):
        out = self.inner.trace(*rays)
        return out.position_mm, out.direction, out.optical_path_mm


@pytest.mark.parametrize("where", [{"z_mm": -1.5}, {"z_mm": 1.0}, {"surface": -1, "z_mm": 20.0}])
def test_gradients_of_rays_reach_the_plate_and_the_lens(where):
    geo = landscape()
    rays = [v.detach() for v in analysis.field_rays(geo, 0.05, pupil_grid(4))]

    def trace(coefficients, curvature):
        plate = ZernikePlate({4: 0.0, 7: 0.0, 11: 0.0}, 5.0)
        twin = Traced(with_plate(geo.replace(curvature_per_mm=curvature), plate, **where))
        return torch.func.functional_call(twin, {"inner.plate.coefficients_rad": coefficients}, tuple(rays))

    values = torch.tensor([3.0, -2.0, 1.0], dtype=D, requires_grad=True)
    curvature = geo.curvature_per_mm.detach().requires_grad_()
    assert torch.autograd.gradcheck(trace, (values, curvature), atol=1e-6)


# --- light


def test_a_plate_in_the_pupil_adds_its_phase_to_the_wavefront():
    # to first order the path of the bare rays; the second is that of the turn, slope^2 f / 2 w = 5e-6 waves
    geo = landscape()
    radius = float(geo.first_order().stop_semi_aperture_mm)
    bare = analysis.wavefront(geo, 0.0, grid=16)
    for scale in (1.0, 0.5, 0.25):
        plate = ZernikePlate({4: 0.01 * scale, 5: 0.02 * scale, 11: -0.01 * scale}, radius)
        found = analysis.wavefront(with_plate(geo, plate), 0.0, grid=16)
        at = torch.cat([bare.pupil * radius, torch.zeros(1, 2, dtype=D)])  # the stop is the entrance pupil
        path = plate.look(at)[0].detach() * plate.mm_per_rad(0.5875618)
        away = (
            found.opd_mm - bare.opd_mm + (path[:-1] - path[-1])
        )  # the chief ray, unturned, passes the centre
        assert bool(away.abs().max() < 1e-5 * scale**2 * 0.5875618e-3)


def test_light_behind_the_last_surface_is_that_between_plane_waves():
    # a plate in the converging light of an f/12.5: its phase on rays of the bare lens, against a thin element in
    # the field, whose rim diffracts on the way to the plate: that differs as 1 / Fresnel number of the plate
    geo = mirror()
    pixel = 0.002

    def difference(before_mm, count):
        plate = ZernikePlate({5: 0.4, 7: 0.5, 11: 0.3}, 0.04 * before_mm).requires_grad_(False)
        psf = analysis.psf_on_pixels(with_plate(geo, plate, -1, 50 - before_mm), 0.0, pixel, 48, grid=256)
        field = wave.before_image(geo, before_mm, pixel, count, grid=320)
        beyond = 2 / (math.pi * 2 * math.pi / 0.5875618e-3 * 0.04 * pixel * count / 2)  # of an Airy pattern
        assert float(field.energy) == pytest.approx(1 - beyond, abs=2e-3)
        x = field.places_mm()
        points = torch.stack(torch.meshgrid(x, x, indexing="xy"), -1).reshape(-1, 2)
        phase = plate.look(points)[0].reshape(count, count)
        film = wave.angular_spectrum(field.times(torch.polar(torch.ones_like(phase), phase)), before_mm)
        # about the chief ray, which the plate turns
        shift = psf.reference_mm / pixel
        f = torch.fft.fftfreq(count, dtype=D)
        turn = torch.exp(2j * math.pi * (f * shift[0] + f[:, None] * shift[1]))
        at = torch.fft.ifft2(torch.fft.fft2(film.amplitude) * turn).abs().square() * pixel**2
        middle = slice(count // 2 - 24, count // 2 + 24)
        return float((psf.energy - at[middle, middle]).abs().max() / psf.energy.max())

    far, near = difference(12.0, 640), difference(6.0, 384)  # Fresnel numbers 33 and 16
    assert far < 1.5 / 33
    assert near > 1.6 * far  # it is that difference and no other


def test_a_plate_of_no_phase_changes_nothing():
    geo = landscape()
    for plate in (ZernikePlate({4: 0.0, 7: 0.0}, 4.0), GridPlate(torch.zeros(12, 12, dtype=D), 1.5)):
        plated = with_plate(geo, plate, z_mm=1.0)
        for field in (0.0, 0.1):
            found, truth = (
                analysis.psf_on_pixels(g, field, 0.004, 32, at_m=2.0).energy for g in (plated, geo)
            )
            torch.testing.assert_close(found, truth, rtol=0, atol=1e-10)


def test_a_corrector_is_found_from_zero():
    # what flattens the wavefront is the conjugate of the lens's own Zernike terms, over the points of the plate
    geo = landscape()
    radius = float(geo.first_order().stop_semi_aperture_mm)
    bare = analysis.wavefront(geo, 0.0, grid=32)
    terms = (4, 11, 22)
    values, _ = zernike((1, *terms), bare.pupil)
    closed = 2 * math.pi * torch.linalg.lstsq(values, bare.waves[:, None]).solution[1:, 0]
    assert float(analysis.rms_waves(bare)) > 0.5  # there is something to correct
    plate = ZernikePlate(dict.fromkeys(terms, 0.0), radius)
    plated = with_plate(geo, plate)
    optimiser = torch.optim.LBFGS(plate.parameters(), max_iter=20, line_search_fn="strong_wolfe")

    def closure():
        optimiser.zero_grad()
        loss = analysis.rms_waves(analysis.wavefront(plated, 0.0, grid=32)).square()
        loss.backward()
        return loss

    optimiser.step(closure)
    # the turned rays add slope^2 f / 2 w = 4e-3 waves where the slope is 3e-4
    torch.testing.assert_close(plate.coefficients_rad.detach(), closed, rtol=1e-2, atol=1e-2)
    plate.requires_grad_(False)
    # what is left is below a twentieth of a wave, and the light returns: Strehl above 0.9 by Marechal
    flat = analysis.wavefront(plated, 0.0, grid=32)
    assert float(analysis.rms_waves(flat)) < 0.05
    psf = analysis.psf_on_pixels(plated, 0.0, 0.001, 33, grid=128)
    ideal = (
        math.pi / 4 * (8.0 / (geo.first_order().efl_mm * 0.5875618e-3)) ** 2 * 0.001**2
    )  # peak of Airy's pattern
    assert float(psf.energy.max() / ideal) > 0.9


def test_gradients_of_light_reach_the_plate():
    geo = landscape()
    picture = torch.rand(16, 16, dtype=D, generator=torch.Generator().manual_seed(7))

    def make(kind, values):
        plate = (
            ZernikePlate({4: 0.0, 9: 0.0}, 4.0) if kind == "zernike" else GridPlate(torch.zeros(6, 6), 2.0)
        )
        (parameter,) = plate.parameters()
        plated = with_plate(geo, plate, z_mm=1.0)
        parameter.data.copy_(values)
        return plated, parameter

    generator = torch.Generator().manual_seed(8)
    for kind, shape in (("zernike", (2,)), ("grid", (6, 6))):
        values = torch.randn(shape, dtype=D, generator=generator)
        direction = torch.randn(shape, dtype=D, generator=generator)

        def loss(values, kind=kind):
            plated, parameter = make(kind, values)
            energy = analysis.psf_on_pixels(plated, 0.03, 0.004, 16, (0.55, 0.6), grid=192, at_m=1.5).energy
            return (energy * picture).sum(), parameter

        value, parameter = loss(values)
        (found,) = torch.autograd.grad(value, parameter)
        step = 1e-5
        ahead, behind = (loss(values + s * direction)[0] for s in (step, -step))
        truth = float((ahead - behind).detach()) / (2 * step)
        assert float((found * direction).sum()) == pytest.approx(truth, rel=1e-6)


def test_phase_follows_wavelength_as_its_kind_says():
    relief = ZernikePlate({4: 1.0}, 4.0, wavelength_um=0.55)
    grating = ZernikePlate({4: 1.0}, 4.0, wavelength_um=0.55, diffractive=True)
    assert relief.mm_per_rad(0.45) == relief.mm_per_rad(0.65) == pytest.approx(0.55e-3 / (2 * math.pi))
    assert grating.mm_per_rad(0.65) / grating.mm_per_rad(0.55) == pytest.approx(0.65 / 0.55)


# --- refusals


def test_phases_finer_than_the_rays_resolve_are_refused():
    geo = landscape()
    steep = with_plate(geo, ZernikePlate({11: 60.0}, 4.0), z_mm=1.0)
    with pytest.raises(DomainError, match=r"finer than 64 cells .* give a grid of at least (\d+)") as caught:
        analysis.pupil_function(steep, 0.0, grid=64)
    needed = int(str(caught.value).split("at least ")[1].split(",")[0])
    # a phase c Z11 steps by c sqrt(5) (24 - 12) / pi waves per radius at the rim; half a wave from cell to cell
    assert needed == pytest.approx(60 * math.sqrt(5) * 12 / (2 * math.pi) * 2 * 2, rel=0.02)
    ripple = torch.zeros(121, 121, dtype=D)
    ripple[::2] = 0.1  # small, but with detail between cells
    with pytest.raises(DomainError, match=r"detail of 0.07 mm"):
        analysis.psf_on_pixels(with_plate(geo, GridPlate(ripple, 0.07), z_mm=1.0), 0.0, 0.004, 16, grid=64)
    with pytest.raises(
        DomainError, match=r"asks for a pitch of at most 0.00453 mm and a pupil grid of at least"
    ):
        wave.before_image(geo, 20.0, 0.02, 64, grid=64)


@pytest.mark.parametrize(
    ("where", "match"),
    [
        ({"surface": 1, "z_mm": 1.0}, "is not modelled; put it next to the stop"),
        ({"surface": 7}, "from surface 8 is not modelled"),
        ({"surface": -1, "z_mm": -1.0}, "is not modelled"),
        ({"z_mm": 4.5}, "meets a surface or the film; between 0 and 4 mm"),
        ({"surface": -1, "z_mm": 61.0}, "meets a surface or the film"),
        ({"surface": -1, "z_mm": 61.0}, "and 60 mm there is room"),
    ],
)
def test_places_that_cannot_be_are_refused(where, match):
    with pytest.raises(DomainError, match=match):
        with_plate(landscape(), ZernikePlate({4: 0.0}, 4.0), **where)


def test_other_refusals():
    triplet = lens.load("cooke-triplet").replace()
    plate = ZernikePlate({4: 0.0}, 4.0)
    with pytest.raises(
        DomainError, match="behind surface 3 is glass; put the plate on the other side of surface 4"
    ):
        with_plate(triplet, plate, z_mm=-0.5)
    with pytest.raises(DomainError, match=r"between 0.6257 and 4.75 mm there is room"):  # the stop's own sag
        with_plate(triplet, plate)
    plated = with_plate(triplet, plate, z_mm=1.0)
    with pytest.raises(DomainError, match="its phase plate is no surface"):
        plated.scaled(0.5)
    assert with_plate(plated, None).scaled(0.5).plate is None
    with pytest.raises(DomainError, match="whole numbers from 1"):
        ZernikePlate({0: 1.0}, 4.0)
    with pytest.raises(DomainError, match="at least one Zernike term"):
        ZernikePlate({}, 4.0)
    for value in (math.nan, math.inf):
        with pytest.raises(DomainError, match=r"plate coefficients: 1 of 2 values .* give finite radians"):
            ZernikePlate({4: 1.0, 5: value}, 4.0)
        with pytest.raises(DomainError, match=f"a plate {value} mm from a surface cannot be"):
            with_plate(triplet, plate, -1, value)
    with pytest.raises(DomainError, match="wavelength 0"):
        ZernikePlate({4: 1.0}, 4.0, wavelength_um=0)
    with pytest.raises(ShapeError, match=r"\[N, N\] with N of at least 4, got \(3, 4\)"):
        GridPlate(torch.zeros(3, 4), 1.0)
    with pytest.raises(DomainError, match="must be finite"):
        GridPlate(torch.full((4, 4), math.nan), 1.0)
