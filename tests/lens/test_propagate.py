"""Free-space propagation against closed forms: Gaussian beams, slits, discs, gratings, the focus of a
lens."""

import math

import pytest
import torch
from scipy import special

from codesign.lens.diffraction import Field, angular_spectrum, disc, fresnel, rectangle

D = torch.float64
W = 0.5e-3  # wavelength, mm
K = 2 * math.pi / W


def gaussian(count, pitch, waist, z):
    """Paraxial Gaussian beam on a plane z behind its waist."""
    x = (torch.arange(count, dtype=D) - count // 2) * pitch
    q = 1 + 1j * z * W / (math.pi * waist**2)
    carrier = torch.tensor(complex(math.cos(K * z), math.sin(K * z)), dtype=torch.complex128)
    return carrier / q * torch.exp(-(x.square() + x[:, None].square()) / (waist**2 * q))


@pytest.mark.parametrize("z", [0.0, 4.0, -4.0, 12.0])
def test_a_gaussian_beam_spreads_and_keeps_its_energy(z):
    # roots against parabolas: the beam's fourth order is k z theta^4 / 8 = 2e-5 rad at z = 12, theta = W /
    # (pi w)
    field = Field(gaussian(256, 0.003, 0.06, 0.0), 0.003, 0.5)
    found = angular_spectrum(field, z)
    torch.testing.assert_close(found.amplitude, gaussian(256, 0.003, 0.06, z), rtol=0, atol=1e-4)
    assert float(found.energy / field.energy) == pytest.approx(1, abs=1e-10)
    if z:
        found = fresnel(field, z, 0.003, 192)
        torch.testing.assert_close(found.amplitude, gaussian(192, 0.003, 0.06, z), rtol=0, atol=1e-10)
        assert float(found.energy / field.energy) == pytest.approx(1, abs=1e-10)


def test_there_and_back_is_where_we_were():
    field = Field(gaussian(128, 0.004, 0.05, 3.0), 0.004, 0.5)
    back = angular_spectrum(angular_spectrum(field, 5.0), -5.0)
    # the tail at the rim of the grid, exp(-(0.256 / 0.057)^2), is not kept
    torch.testing.assert_close(back.amplitude, field.amplitude, rtol=0, atol=2e-9)


def slit_truth(x, half, z):
    """Field behind a slit in a plane wave, Fresnel integrals, without exp(i k z)."""
    scale = math.sqrt(2 / (W * z))
    s1, c1 = special.fresnel(scale * (x.numpy() + half))
    s0, c0 = special.fresnel(scale * (x.numpy() - half))
    return torch.tensor(((c1 - c0) + 1j * (s1 - s0)) / (1 + 1j))


@pytest.mark.parametrize("number", [0.5, 1.0, 2.0])
def test_fresnel_diffraction_at_a_square_opening(number):
    # Fresnel number half^2 / (w z)
    pitch = 0.02
    half = 60.3 * pitch  # the rim anywhere in a cell
    z = half**2 / (W * number)
    x = (torch.arange(384, dtype=D) - 192) * pitch
    opening = Field(rectangle(384, pitch, (half, half)).to(torch.complex128), pitch, 0.5)
    truth = slit_truth(x, half, z)
    truth = (truth * truth[:, None]).abs().square()
    for found in (angular_spectrum(opening, z, may_leave=0.1), fresnel(opening, z, pitch, 384)):
        # the paths' fourth order k (2 half)^4 / 8 z^3 is at most 2e-5
        torch.testing.assert_close(found.intensity, truth, rtol=0, atol=1e-4)


# bright, dark, bright
@pytest.mark.parametrize("z", [20 / 3, 10.0, 20.0])
def test_on_the_axis_behind_a_round_opening(z):
    # exact Rayleigh-Sommerfeld: exp(i k z) - z / rho exp(i k rho), bright and dark
    assert on_axis(400, 0.001, z) == pytest.approx(axis_truth(z), abs=1e-4)


def test_rims_converge_in_third_order():
    coarse, fine = (abs(on_axis(count, 0.4 / count, 5.0) - axis_truth(5.0)) for count in (128, 256))
    # second order would give a quarter
    assert fine < coarse / 8


def test_a_grating_images_itself():
    # orders 0 and +-1 come in step again after w / (1 - sqrt(1 - (w / period)^2)), without approximation
    pitch = 0.001
    period = 32 * pitch
    x = (torch.arange(128, dtype=D) - 64) * pitch
    grating = (1 + 0.4 * torch.cos(2 * math.pi * x / period)).expand(128, 128).to(torch.complex128)
    field = Field(grating, pitch, 0.5)
    talbot = W / (1 - math.sqrt(1 - (W / period) ** 2))
    found = angular_spectrum(field, talbot, padding=1)
    torch.testing.assert_close(found.intensity, field.intensity, rtol=0, atol=1e-9)
    half = angular_spectrum(field, talbot / 2, padding=1)  # shifted by half a period
    torch.testing.assert_close(half.intensity, field.intensity.roll(16, -1), rtol=0, atol=1e-9)


def test_the_airy_pattern_in_focus():
    radius, focus = 5.0, 100.0
    opening = Field(disc(192, 0.054, radius).to(torch.complex128), 0.054, 0.5)
    found = fresnel(opening, focus, 0.001, 96, focus_mm=focus)
    x = found.places_mm()
    v = K * radius / focus * torch.sqrt(x.square() + x[:, None].square())
    truth = torch.where(v == 0, 1, 2 * torch.special.bessel_j1(v) / torch.where(v == 0, 1, v)).square()
    peak = (math.pi * radius**2 / (W * focus)) ** 2
    torch.testing.assert_close(found.intensity / peak, truth, rtol=0, atol=2e-5)


def test_the_two_ways_agree_on_a_converging_beam():
    # f / 20 over 6 mm, sampled finely enough for plain plane waves too
    x = (torch.arange(256, dtype=D) - 128) * 0.003
    r2 = x.square() + x[:, None].square()
    smooth = torch.exp(-r2 / 0.1**2)
    bare = Field(smooth.to(torch.complex128), 0.003, 0.5)
    bent = bare.times(torch.polar(torch.ones_like(r2), -K * r2 / (2 * 6.0)))
    by_waves = angular_spectrum(bent, 5.0)
    by_sums = fresnel(bare, 5.0, 0.003, 256, focus_mm=6.0)
    # fourth order of the paths: k (0.1 / 6)^4 z / 8 = 6e-4 rad where light is; the amplitude there is 6
    torch.testing.assert_close(by_waves.amplitude, by_sums.amplitude, rtol=0, atol=6e-3)
    assert float(by_sums.intensity.max()) > 20


def test_gradients():
    generator = torch.Generator().manual_seed(4)
    real = torch.randn(2, 8, 8, dtype=D, generator=generator)
    x = torch.arange(8, dtype=D) - 4
    smooth = torch.exp(-(x.square() + x[:, None].square()) / 6)
    parts = [(smooth * (1 + 0.1 * r)).requires_grad_() for r in real]
    z = torch.tensor(3.0, dtype=D, requires_grad=True)
    focus = torch.tensor(4.0, dtype=D, requires_grad=True)

    def waves(a, b, length):
        return angular_spectrum(Field(torch.complex(a, b), 0.01, 0.5), length, may_leave=1.0).intensity

    def sums(a, b, length, sphere):
        return fresnel(Field(torch.complex(a, b), 0.01, 0.5), length, 0.01, 6, sphere).intensity

    assert torch.autograd.gradcheck(waves, (*parts, z), atol=1e-6)
    assert torch.autograd.gradcheck(sums, (*parts, z, focus), eps=1e-8, atol=1e-5, rtol=1e-4)


NAN, INF = math.nan, math.inf


def test_no_light_stays_no_light():
    beam = gaussian(64, 0.004, 0.02, 0.0)
    found = angular_spectrum(Field(torch.stack([beam, 0 * beam]), 0.004, 0.5), 1.0)
    alone = angular_spectrum(Field(beam, 0.004, 0.5), 1.0)
    torch.testing.assert_close(found.amplitude[0], alone.amplitude, rtol=1e-12, atol=1e-15)
    assert float(found.energy[1]) == 0
    assert float(angular_spectrum(Field(0 * beam, 0.004, 0.5), 1.0).energy) == 0


def on_axis(count, pitch, z):
    """Intensity on the axis behind a disc of 0.1 mm."""
    opening = Field(disc(count, pitch, 0.1).to(torch.complex128), pitch, 0.5)
    return float(angular_spectrum(opening, z, may_leave=1.0).intensity[count // 2, count // 2])


def axis_truth(z):
    rho = math.hypot(z, 0.1)
    return 1 + (z / rho) ** 2 - 2 * z / rho * math.cos(K * (rho - z))
