"""Point spreads against the Airy pattern, Parseval's theorem, the Strehl ratio, and the rays' own
mean."""

import math

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Surface, analysis
from codesign.lens.analysis import (
    Psf,
    diffraction_mtf,
    diffraction_psf,
    geometric_mtf,
    geometric_psf,
    ideal_mtf,
    psf_on_pixels,
    through_focus_mtf,
    through_focus_spot_mm,
    working_fno,
)
from codesign.report import lens_figures
from tests.lens.systems import LINES, close, paraboloid
from tests.numbers import D, f64


def test_the_airy_pattern():
    # f/20: (2 J1(x) / x)^2 with x = pi r / (w N); its first zero at 1.22 w N
    pixel = 5e-4
    w = 0.5875618e-3
    N = 20.0
    energy = psf_on_pixels(paraboloid(), 0.0, pixel, 128, grid=256).energy.detach()
    r = (torch.arange(128, dtype=D) - 64) * pixel
    x = math.pi * r / (w * N)
    airy = torch.where(
        x == 0, 1.0, (2 * torch.special.bessel_j1(x) / torch.where(x == 0, 1, x)).square()
    )
    for line in (energy[64], energy[:, 64]):
        # the staircase rim has an area wrong by 1e-4 and a sine condition of (y / f)^2 / 4 = 2e-4
        close(line / energy[64, 64], airy, atol=5e-4)
    ring = energy[64, 64:]
    low = int((ring[1:-1] < torch.minimum(ring[:-2], ring[2:])).nonzero()[0]) + 1
    a, b, c = ring[low - 1 : low + 2].tolist()
    close((low + (a - c) / (2 * (a - 2 * b + c))) * pixel, 1.2197 * w * N, 2e-3)
    # peak: energy density pi / 4 (1 / w N)^2 of the whole
    close(float(energy[64, 64]) / pixel**2, math.pi / 4 / (w * N) ** 2, 1e-3)


def test_the_cone_of_light_is_that_of_the_distance_and_of_the_medium():
    # an ellipsoid of index 1.5 brings parallel light to its far focus, 150 mm behind its vertex
    glass = lens.Glass.from_indices(1.5, 1.5, 1.5)
    geo = GeoLens([Surface(50.0, 150.0, glass, 12.0, conic=-1 / 1.5**2, is_stop=True)], 20.0)
    height, bend = 10.0, 1 - 1 / 1.5**2
    sag = height**2 / 50 / (1 + math.sqrt(1 - bend * (height / 50) ** 2))
    true = math.hypot(height, 150 - sag) / (2 * 1.5 * height)
    close(working_fno(geo), true, 1e-12)
    close(
        diffraction_mtf(geo, 0.0, [50.0, 200.0])[0], ideal_mtf(f64([50.0, 200.0]), true), atol=3e-3
    )
    # a triplet at f/25 and 0.11 m: its own transform, and the circle that is drawn
    near = lens.load("cooke-triplet").with_pupil(2.0).focus_at(0.11)
    number, f = working_fno(near, at_m=0.11), f64([20.0, 30.0])
    close(diffraction_mtf(near, 0.0, f, at_m=0.11)[0], ideal_mtf(f, number.detach()), atol=0.01)
    axis = lens_figures.spots_by_wavelength(near, [0.0], 0.5875618, at_m=0.11).axes[0]
    close(axis.patches[0].radius, 1.22 * 0.5875618 * number, 1e-12)


# pitches of the two axes differ by 1e-3 off the axis: by 0.02 px at 24 px from the middle
@pytest.mark.parametrize(("field", "share", "pitch"), [(0.0, 1e-6, 1e-10), (0.03, 1e-3, 1e-3)])
def test_the_two_transforms_agree(field, share, pitch):
    """Picture for picture, off the axis with the coma of a singlet: turned or mirrored they differ
    by a third of the peak."""
    geo = GeoLens(lens.load("la1509").surfaces, 12.0).freeze()
    fft = diffraction_psf(geo, field, grid=64, padding=2)
    pixels = psf_on_pixels(geo, field, float(fft.pitch_mm.mean()), 48, grid=64)
    close(fft.pitch_mm[0], fft.pitch_mm[1], pitch)
    close(pixels.energy, fft.energy[40:88, 40:88], atol=share * float(fft.energy.max()))
    # w N / padding, N to (y / f)^2
    close(fft.pitch_mm[0], f64(0.5875618e-3 * 99.65 / 12 / 2), 5e-3)


@pytest.mark.parametrize("count", [8, 9])
def test_the_reference_of_a_picture_is_at_zero(count):
    energy = torch.zeros(count, count)
    energy[count // 2, count // 2] = 1.0
    (drawn,) = (
        lens_figures.psf_pictures([Psf(energy, f64([1e-3] * 2), f64([0.0] * 2))], ["one"])
        .axes[0]
        .images
    )
    left, right, bottom, top = drawn.get_extent()
    share = (count // 2 + 0.5) / count
    assert left + share * (right - left) == pytest.approx(0, abs=1e-9)
    assert bottom + share * (top - bottom) == pytest.approx(0, abs=1e-9)
    assert right - left == pytest.approx(count)  # micrometres


def test_the_geometric_spread_keeps_light_and_its_mean():
    geo = lens.load("cooke-triplet")
    field = math.radians(14.0)
    for light in (LINES[0], LINES):
        psf = geometric_psf(geo, field, 0.001, 200, light, grid=64)
        close(psf.energy.sum(), 1, atol=1e-12)
        positions, weight = analysis.polychromatic_spot(geo, field, light, 64)
        mean = ((positions - psf.reference_mm) * weight[..., None]).sum((0, 1))
        at = (torch.arange(200, dtype=D) - 100) * 0.001
        found = torch.stack([(psf.energy.sum(0) * at).sum(), (psf.energy.sum(1) * at).sum()])
        close(found, mean, atol=1e-13)  # bilinear shares keep the mean exactly
    lost = geometric_psf(geo, field, 0.001, 8, grid=64)
    on = ((positions[0] - lost.reference_mm) / 0.001 + 4).floor()
    inside = ((on >= 0) & (on < 7)).all(1).double().mean()
    # the share on the grid is not made up to 1
    assert inside <= lost.energy.sum().detach() < 1


def test_a_perfect_lens_reaches_the_closed_form():
    cutoff = 1 / (0.5875618e-3 * 20.0)
    frequency = torch.linspace(0, 1.1, 45, dtype=D) * cutoff
    v = (frequency / cutoff).clamp_max(1)
    truth = 2 / math.pi * (v.acos() - v * (1 - v * v).sqrt())
    close(ideal_mtf(frequency, 20.0), truth, atol=1e-15)
    found = diffraction_mtf(paraboloid(), 0.0, frequency).detach()
    # the staircase rim of 128 cells
    close(found, truth.expand(2, -1), atol=1.5e-3)
    close(found[:, 0], [1, 1], atol=1e-12)
    assert not found[:, frequency > 1.001 * cutoff].any()
    geometric = geometric_mtf(paraboloid(), 0.0, frequency)
    close(geometric, torch.ones(2, 45, dtype=D), atol=1e-12)


def test_the_geometric_mtf_is_the_transform_of_the_spot():
    # a defocused paraboloid spreads its light nearly evenly over a disc of radius a: 2 J1(x) / x, x
    # = 2 pi a f
    radius = 0.05 * 2.5 / 100
    frequency = torch.linspace(0, 400, 9, dtype=D)
    x = 2 * math.pi * radius * frequency
    truth = torch.where(x == 0, 1.0, 2 * torch.special.bessel_j1(x) / torch.where(x == 0, 1, x))
    found = geometric_mtf(paraboloid(defocus_mm=0.05), 0.0, frequency, grid=256)
    close(found, truth.abs().expand(2, -1), atol=2e-3)


@torch.no_grad()
def test_the_geometric_mtf_takes_the_cells_that_its_frequencies_ask_for():
    # rays of a disc 1 mm across, far beyond the zeros of 2 J1(x) / x, where coarse sums alias
    geo, frequency = paraboloid(defocus_mm=20.0), f64([5.0, 20.0, 40.0])
    x = 2 * math.pi * 20.0 * 2.5 / 100 * frequency
    truth = (2 * torch.special.bessel_j1(x) / x).abs()
    close(geometric_mtf(geo, 0.0, frequency), truth.expand(2, -1), atol=2e-3)
    # where 64 suffice it is their sum
    close(geometric_mtf(geo, 0.0, [5.0]), geometric_mtf(geo, 0.0, [5.0], grid=64), atol=0)
    assert geometric_mtf(geo, 0.0, [0.0], grid=1).tolist() == [[1.0], [1.0]]


def test_several_wavelengths():
    geo = lens.load("cooke-triplet")
    field = math.radians(20.0)
    one = diffraction_mtf(geo, field, [30.0], LINES[0], grid=128)
    close(diffraction_mtf(geo, field, [30.0], [LINES[0]] * 3, grid=128), one, 1e-12)

    # transfer functions add as complex numbers, so the sum is at most the sum of the sizes (each
    # about its own sphere: 1e-6)
    parts = torch.stack([diffraction_mtf(geo, field, [30.0], w, grid=128) for w in LINES]).mean(0)
    assert (diffraction_mtf(geo, field, [30.0], LINES, grid=128) <= parts + 1e-5).all()


def test_through_focus():
    shifts = [-0.2, -0.05, 0.0, 0.1]
    # a paraboloid's rays all pass the focus: the spot grows in proportion to the shift
    sizes = through_focus_spot_mm(paraboloid(), [0.0], shifts).detach()[0]
    truth = f64(shifts).abs() / 0.2
    close(sizes / sizes[0], truth, atol=1e-10)
    # tangents: (y / 2 f)^2
    even = float(analysis.pupil_grid(32).square().sum(1).mean().sqrt())
    close(sizes[0], 0.2 * 2.5 / 100 * even, 1e-3)
    geo = lens.load("cooke-triplet")
    moved = geo.replace(thickness_mm=geo.thickness_mm + f64([0, 0, 0, 0, 0, 0.1]))
    for method, single in (("diffraction", diffraction_mtf), ("geometric", geometric_mtf)):
        curve = through_focus_mtf(geo, 0.2, 30.0, [0.0, 0.1], method=method)
        for at, made in enumerate((geo, moved)):
            close(curve[:, at : at + 1], single(made, 0.2, [30.0]), 1e-8, atol=1e-10)


@pytest.mark.parametrize("defocus_mm", [47.0, 94.0])
def test_a_pupil_has_as_many_cells_as_the_aberration_asks_for(defocus_mm):
    geo = paraboloid(defocus_mm=defocus_mm)
    rim = analysis.wavefront(geo, 0.0, pupil=f64([[0.0, 1.0], [0.0, 31 / 32]])).waves
    # a third of a wave from cell to cell, of which there are powers of two
    needed = 3 * 64 * float((rim[0] - rim[1]).detach())
    assert needed <= analysis.pupil_function(geo, 0.0).field.shape[0] < 2 * needed


def test_an_aperture_inside_the_pupil_makes_a_smaller_pupil():
    # of half the diameter, so an f/40
    mirror = Surface(-200.0, 100.0, None, 1.25, conic=-1.0, is_stop=True, mirror=True)
    clipped = GeoLens([mirror], 5.0, soft_edge_mm=0.0)
    frequency = torch.linspace(0, 40, 9, dtype=D)
    found = diffraction_mtf(clipped, 0.0, frequency, grid=256, vignetting=True)[0]
    # the staircase rim of 128 cells across
    close(found, ideal_mtf(frequency, 40.0), atol=2e-3)
