"""MTF against the closed form of a perfect lens, a public program's Huygens integral, and identities between
wavelengths."""

import math

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Surface, analysis
from codesign.lens.analysis import (
    diffraction_mtf,
    geometric_mtf,
    ideal_mtf,
    through_focus_mtf,
    through_focus_spot_mm,
)
from tests.lens.systems import LINES, check_gradient, paraboloid

D = torch.float64
# Cooke triplet, d line: share of the 20 degree field, tangential MTF at 20, 50 and 100 / mm. Computed with
# optiland's FFT (256 rays across); its sagittal values off the axis are left out, as they take one f-number
# for both directions
PEER = {
    0.0: (0.8406794014456553, 0.41187756706890327, 0.027946421159544373),
    0.7: (0.336200636043009, 0.026627558839844315, 0.009064087984148234),
    1.0: (0.6964834066396411, 0.15230820707882786, 0.16852098718089803),
}


def test_a_perfect_lens_reaches_the_closed_form():
    cutoff = 1 / (0.5875618e-3 * 20.0)
    frequency = torch.linspace(0, 1.1, 45, dtype=D) * cutoff
    v = (frequency / cutoff).clamp_max(1)
    truth = 2 / math.pi * (v.acos() - v * (1 - v * v).sqrt())
    torch.testing.assert_close(ideal_mtf(frequency, 20.0), truth, rtol=0, atol=1e-15)
    found = diffraction_mtf(paraboloid(), 0.0, frequency).detach()
    # the staircase rim of 128 cells
    torch.testing.assert_close(found, truth.expand(2, -1), rtol=0, atol=1.5e-3)
    assert found[:, 0].tolist() == pytest.approx([1, 1], abs=1e-12)
    assert not found[:, frequency > 1.001 * cutoff].any()
    geometric = geometric_mtf(paraboloid(), 0.0, frequency)
    torch.testing.assert_close(geometric, torch.ones(2, 45, dtype=D), rtol=0, atol=1e-12)


def test_defocus_of_half_a_wave_lowers_the_mtf_by_hopkins_integral():
    # OTF of W r^2 at v of the cut-off (Hopkins 1955): the mean of cos(2 pi W 4 v x) over the overlap of two
    # pupils at +-v; here a fine sum
    diameter, f, w, v = 5.0, 100.0, 0.5875618e-3, 0.3
    # y^2 / 2 (1 / f - 1 / (f + shift)) is half a wave at the rim
    shift = 1 / (1 / f - w / (diameter / 2) ** 2) - f
    x, y = torch.meshgrid(*[torch.linspace(-1, 1, 2001, dtype=D)] * 2, indexing="ij")
    overlap = ((x + v).square() + y * y <= 1) & ((x - v).square() + y * y <= 1)
    truth = float((torch.cos(2 * math.pi * 0.5 * 4 * v * x) * overlap).sum() / (x * x + y * y <= 1).sum())
    frequency = [v / (w * (f + shift) / diameter)]
    found = diffraction_mtf(paraboloid(defocus_mm=shift), 0.0, frequency, grid=256)[:, 0].tolist()
    assert found == pytest.approx([abs(truth)] * 2, abs=1.5e-3)


@pytest.mark.parametrize("H", PEER)
def test_tangential_mtf_of_the_triplet(H):
    geo = lens.load("cooke-triplet")
    found = diffraction_mtf(geo, math.radians(20.0) * H, [20.0, 50.0, 100.0], grid=256)[0].tolist()
    # theirs interpolates between steps of 1.2 / mm, where the curve bends by up to 4e-3, and takes one
    # f-number for both directions
    assert found == pytest.approx(PEER[H], abs=5e-3)


@pytest.mark.parametrize("H", [0.0, 0.7, 1.0])
def test_mtf_against_a_sum_over_rays_with_their_own_directions(H):
    # Huygens: every ray is a plane wave near the image; no even grid of direction cosines, no Fourier
    # transform
    geo = lens.load("cooke-triplet")
    field = math.radians(20.0) * H
    front = analysis.wavefront(geo, field, grid=64)
    at = (torch.arange(160, dtype=D) - 80) * 0.001
    waves = [
        torch.polar(torch.ones_like(a), a)
        for a in ((2 * math.pi / 0.5875618e-3 * at[:, None] * front.slope[:, k]).detach() for k in (0, 1))
    ]
    amplitude = torch.polar(torch.ones_like(front.waves), -2 * math.pi * front.waves).detach()
    picture = ((waves[1] * amplitude) @ waves[0].T).abs().square()
    frequency = torch.tensor([0.0, 20.0, 50.0, 100.0], dtype=D)
    kernel = torch.polar(torch.ones(4, 160, dtype=D), -2 * math.pi * frequency[:, None] * at)
    truth = torch.stack([(kernel * picture.sum(axis)).sum(1).abs() for axis in (1, 0)])
    found = diffraction_mtf(geo, field, frequency, grid=128).detach()
    # the picture's rim at 80 um cuts off 0.4 % of the light, which raises what is left by that share
    torch.testing.assert_close(found, truth / truth[:, :1], rtol=0, atol=5e-3)


def test_the_geometric_mtf_is_the_transform_of_the_spot():
    # a defocused paraboloid spreads its light nearly evenly over a disc of radius a: 2 J1(x) / x, x = 2 pi a
    # f
    radius = 0.05 * 2.5 / 100
    frequency = torch.linspace(0, 400, 9, dtype=D)
    x = 2 * math.pi * radius * frequency
    truth = torch.where(x == 0, 1.0, 2 * torch.special.bessel_j1(x) / torch.where(x == 0, 1, x))
    found = geometric_mtf(paraboloid(defocus_mm=0.05), 0.0, frequency, grid=256).detach()
    torch.testing.assert_close(found, truth.abs().expand(2, -1), rtol=0, atol=2e-3)


def test_several_wavelengths():
    geo = lens.load("cooke-triplet")
    field = math.radians(20.0)
    one = diffraction_mtf(geo, field, [30.0], LINES[0], grid=128)
    torch.testing.assert_close(
        diffraction_mtf(geo, field, [30.0], [LINES[0]] * 3, grid=128), one, rtol=1e-12, atol=0
    )

    class Light:
        wavelengths_um = LINES
        weights = (2.0, 0.0, 0.0)

    torch.testing.assert_close(
        diffraction_mtf(geo, field, [30.0], Light(), grid=128), one, rtol=1e-12, atol=0
    )
    # transfer functions add as complex numbers, so the sum is at most the sum of the sizes (each about its
    # own sphere: 1e-6)
    parts = torch.stack([diffraction_mtf(geo, field, [30.0], w, grid=128) for w in LINES]).mean(0)
    assert bool((diffraction_mtf(geo, field, [30.0], LINES, grid=128) <= parts + 1e-5).all())


def test_through_focus():
    shifts = [-0.2, -0.05, 0.0, 0.1]
    # a paraboloid's rays all pass the focus: the spot grows in proportion to the shift
    sizes = through_focus_spot_mm(paraboloid(), [0.0], shifts).detach()[0]
    truth = torch.tensor(shifts, dtype=D).abs() / 0.2
    torch.testing.assert_close(sizes / sizes[0], truth, rtol=0, atol=1e-10)
    # tangents: (y / 2 f)^2
    even = float(analysis.pupil_grid(32).square().sum(1).mean().sqrt())
    assert float(sizes[0]) == pytest.approx(0.2 * 2.5 / 100 * even, rel=1e-3)
    geo = lens.load("cooke-triplet")
    moved = geo.replace(thickness_mm=geo.thickness_mm + torch.tensor([0, 0, 0, 0, 0, 0.1], dtype=D))
    for method, single in (("diffraction", diffraction_mtf), ("geometric", geometric_mtf)):
        curve = through_focus_mtf(geo, 0.2, 30.0, [0.0, 0.1], method=method)
        for at, made in enumerate((geo, moved)):
            torch.testing.assert_close(
                curve[:, at : at + 1], single(made, 0.2, [30.0]), rtol=1e-8, atol=1e-10
            )


@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss"])
def test_a_float32_lens_keeps_its_wavefront(name):
    frequency = [10.0, 40.0]
    truth = diffraction_mtf(lens.load(name), 0.1, frequency).detach()
    found = diffraction_mtf(lens.load(name).float(), 0.1, frequency).detach()
    assert found.dtype == torch.float32
    # lens numbers rounded to 6e-8: 6e-6 mm of path, mostly alike for all rays, under 1e-3 waves of difference
    torch.testing.assert_close(found.double(), truth, rtol=0, atol=1e-4)


@pytest.mark.parametrize("make", [diffraction_mtf, geometric_mtf])
def test_gradients_of_the_mtf(make):
    geo = lens.load("cooke-triplet")
    check_gradient(
        lambda t: make(geo.replace(thickness_mm=t), 0.2, [10.0, 40.0], LINES, grid=64).sum(),
        geo.thickness_mm,
        step=1e-7,
        rel=1e-5,
    )


def test_an_aperture_inside_the_pupil_makes_a_smaller_pupil():
    # of half the diameter, so an f/40
    mirror = Surface(-200.0, 100.0, None, 1.25, conic=-1.0, is_stop=True, mirror=True)
    clipped = GeoLens([mirror], 5.0, soft_edge_mm=0.0)
    frequency = torch.linspace(0, 40, 9, dtype=D)
    found = diffraction_mtf(clipped, 0.0, frequency, grid=256, vignetting=True)[0].detach()
    # the staircase rim of 128 cells across
    torch.testing.assert_close(found, ideal_mtf(frequency, 40.0), rtol=0, atol=2e-3)
