"""Point spreads against the Airy pattern, Parseval's theorem, the Strehl ratio, and the rays' own mean."""

import math

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, analysis
from codesign.lens.analysis import diffraction_psf, geometric_psf, psf_on_pixels, strehl_direct, wavefront
from tests.lens.systems import LINES, check_gradient, paraboloid

D = torch.float64


def test_the_airy_pattern():
    # f/20: (2 J1(x) / x)^2 with x = pi r / (w N); its first zero at 1.22 w N
    pixel = 5e-4
    w = 0.5875618e-3
    N = 20.0
    energy = psf_on_pixels(paraboloid(), 0.0, pixel, 128, grid=256).energy.detach()
    r = (torch.arange(128, dtype=D) - 64) * pixel
    x = math.pi * r / (w * N)
    airy = torch.where(x == 0, 1.0, (2 * torch.special.bessel_j1(x) / torch.where(x == 0, 1, x)).square())
    for line in (energy[64], energy[:, 64]):
        # the staircase rim has an area wrong by 1e-4 and a sine condition of (y / f)^2 / 4 = 2e-4
        torch.testing.assert_close(line / energy[64, 64], airy, rtol=0, atol=5e-4)
    ring = energy[64, 64:]
    low = int((ring[1:-1] < torch.minimum(ring[:-2], ring[2:])).nonzero()[0]) + 1
    a, b, c = ring[low - 1 : low + 2].tolist()
    assert (low + (a - c) / (2 * (a - 2 * b + c))) * pixel == pytest.approx(1.2197 * w * N, rel=2e-3)
    # peak: energy density pi / 4 (1 / w N)^2 of the whole
    assert float(energy[64, 64]) / pixel**2 == pytest.approx(math.pi / 4 / (w * N) ** 2, rel=1e-3)


@pytest.mark.parametrize("field_deg", [0.0, 1.5])
def test_peak_and_energy_of_the_fft_are_those_of_the_pupil(field_deg):
    geo = GeoLens(lens.load("la1509").surfaces, 8.0)
    field = math.radians(field_deg)
    psf = diffraction_psf(geo, field, grid=64, padding=4)
    assert psf.energy.shape == (256, 256)
    assert float(psf.energy.sum().detach()) == pytest.approx(1, abs=1e-12)
    front = wavefront(geo, field, grid=64)
    # |sum of A|^2 = m^2 x energy x sum |A|^2 (Parseval), so the middle pixel holds the Strehl ratio times M /
    # m^2 of M lit cells
    assert float(psf.energy[128, 128].detach()) == pytest.approx(
        float(strehl_direct(front).detach()) * front.waves.numel() / 256**2, rel=1e-10
    )


def test_the_two_transforms_agree():
    geo = GeoLens(lens.load("la1509").surfaces, 8.0)
    fft = diffraction_psf(geo, 0.0, grid=32, padding=2)
    pixels = psf_on_pixels(geo, 0.0, float(fft.pitch_mm[0].detach()), 64, grid=32)
    torch.testing.assert_close(fft.pitch_mm[0], fft.pitch_mm[1], rtol=1e-10, atol=0)
    torch.testing.assert_close(pixels.energy, fft.energy, rtol=1e-6, atol=1e-12)
    # w N / padding, N to (y / f)^2
    torch.testing.assert_close(
        fft.pitch_mm[0].detach(), torch.tensor(0.5875618e-3 * 99.65 / 8 / 2, dtype=D), rtol=5e-3, atol=0
    )


def test_the_geometric_spread_keeps_light_and_its_mean():
    geo = lens.load("cooke-triplet")
    field = math.radians(14.0)
    for light in (LINES[0], LINES):
        psf = geometric_psf(geo, field, 0.001, 200, light, grid=64)
        assert float(psf.energy.sum().detach()) == pytest.approx(1, abs=1e-12)
        positions, weight = analysis.polychromatic_spot(geo, field, light, 64)
        mean = ((positions - psf.reference_mm) * weight[..., None]).sum((0, 1)).detach()
        at = (torch.arange(200, dtype=D) - 100) * 0.001
        found = torch.stack([(psf.energy.sum(0) * at).sum(), (psf.energy.sum(1) * at).sum()]).detach()
        torch.testing.assert_close(found, mean, rtol=0, atol=1e-13)  # bilinear shares keep the mean exactly
    lost = geometric_psf(geo, field, 0.001, 8, grid=64)
    on = ((positions[0] - lost.reference_mm) / 0.001 + 4).floor()
    inside = ((on >= 0) & (on < 7)).all(1).double().mean()
    assert float(inside) <= float(lost.energy.sum().detach()) < 1  # the share on the grid is not made up to 1


def test_diffraction_keeps_the_mean_of_the_rays():
    # the mean of |U|^2 is the mean slope of the wavefront (Ehrenfest), and the sign of y is that of the lens:
    # coma of a singlet
    geo = GeoLens(lens.load("la1509").surfaces, 16.0)
    field = math.radians(2.0)
    psf = diffraction_psf(geo, field, grid=256, padding=4)
    at = torch.arange(1024, dtype=D) - 512
    mean = float(((psf.energy.sum(1) * at).sum() * psf.pitch_mm[1]).detach())
    positions, weight = analysis.polychromatic_spot(geo, field, 0.5875618, 64)
    rays = float(((positions[0, :, 1] - psf.reference_mm[1]) * weight[0]).sum().detach())
    assert abs(rays) > 5e-4  # mm: there is something to see
    assert mean == pytest.approx(rays, rel=0.15)  # tails that fall as 1 / r^2 are cut at the picture's rim


# bilinear: steps so small that hardly a ray changes its pixel
@pytest.mark.parametrize(
    ("make", "grid", "step", "rel"), [(psf_on_pixels, 64, 2e-6, 1e-5), (geometric_psf, 32, 2e-9, 1e-3)]
)
def test_gradients_of_point_spreads(make, grid, step, rel, generator):
    geo = GeoLens(lens.load("la1509").surfaces, 8.0)
    picture = torch.rand(24, 24, dtype=D, generator=generator)
    check_gradient(
        lambda c: (
            make(geo.replace(curvature_per_mm=c), 0.02, 0.002, 24, LINES, grid=grid).energy * picture
        ).sum(),
        geo.curvature_per_mm,
        step=step,
        rel=rel,
    )


@pytest.mark.parametrize("defocus_mm", [47.0, 94.0])
def test_a_pupil_has_as_many_cells_as_the_aberration_asks_for(defocus_mm):
    geo = paraboloid(defocus_mm=defocus_mm)
    rim = wavefront(geo, 0.0, pupil=torch.tensor([[0.0, 1.0], [0.0, 31 / 32]], dtype=D)).waves
    # a third of a wave from cell to cell, of which there are powers of two
    needed = 3 * 64 * float((rim[0] - rim[1]).detach())
    assert needed <= analysis.pupil_function(geo, 0.0).field.shape[0] < 2 * needed
