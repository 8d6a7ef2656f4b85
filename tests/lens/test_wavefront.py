"""Wavefront errors against exact paraboloids, Seidel's W040, a public program, and closed forms of the Strehl
ratio."""

import math
from dataclasses import replace

import pytest
import torch

from codesign import lens
from codesign.lens import GeoLens, Surface
from codesign.lens.analysis import (
    Wavefront,
    peak_to_valley_waves,
    pupil_grid,
    remove_fit,
    rms_waves,
    strehl_direct,
    strehl_marechal,
    wavefront,
)
from codesign.lens.paraxial import cardinal_points
from codesign.lens.seidel import seidel_sums
from codesign.lens.solves import focus_paraxial
from tests.lens.systems import PLANE, check_gradient, paraboloid

D = torch.float64
# d line, 740 rays of a 32 x 32 grid over [-1, 1] with its ends, fields 0, 0.7 and 1 of the half field:
# standard deviation and mean of the optical path difference in waves. Computed with optiland (release of
# 2026) from the same indices; its sign is the same.
PEER = {
    "cooke-triplet": (
        (0.209454595832, -0.529330646764),
        (0.59139948487, -0.162493761113),
        (0.332904033883, 0.636245869922),
    ),
    "double-gauss": (
        (1.57245172496, 1.82189681178),
        (2.53247561522, 3.70906301581),
        (3.55001828511, 5.7433459115),
    ),
    "la1509": (
        (1.37092602113, 1.52600634442),
        (1.57721143745, 1.85768632039),
        (1.79493879906, 2.20279713645),
    ),
}


@pytest.mark.parametrize("name", PEER)
def test_wavefront_of_published_lenses(name):
    line = torch.linspace(-1, 1, 32, dtype=D)
    pupil = torch.cartesian_prod(line, line)
    pupil = pupil[pupil.square().sum(1) <= 1]
    assert len(pupil) == 740
    for H, truth in zip((0.0, 0.7, 1.0), PEER[name], strict=True):
        front = wavefront(lens.load(name), H * math.radians(lens.half_field_deg(name)), pupil=pupil)
        # paths of 180 mm carry roundings of 3e-14 mm each, 5e-11 waves, in their program and here
        assert [rms_waves(front).item(), front.waves.mean().item()] == pytest.approx(truth, abs=1e-9)


def test_a_paraboloid_is_perfect_on_its_axis():
    mirror = paraboloid(40.0).freeze()
    front = wavefront(mirror, 0.0)
    # roundings of paths of 200 mm
    assert front.opd_mm.abs().max().item() <= 1e-12
    assert strehl_direct(front).item() == pytest.approx(1, abs=1e-12)

    def rms(curvature):
        return rms_waves(wavefront(mirror.replace(curvature_per_mm=curvature), 0.0))

    leaf = torch.tensor([-1 / 200.0], dtype=D, requires_grad=True)
    (gradient,) = torch.autograd.grad(rms(leaf), leaf)
    # the rms has a kink here, k |c - c0|: any slope between -k and k is one
    assert abs(float(gradient)) <= 1.01 * rms(leaf.detach() + 1e-9).item() / 1e-9


@pytest.mark.parametrize("shift", [-0.3, 0.05, 2.0])
def test_defocus_of_a_perfect_lens_is_the_gap_between_two_spheres(shift):
    # rays at angle a through the focus F meet the sphere of radius f + s about F + s at r = sqrt((f + s)^2 -
    # s^2 sin^2 a) - s cos a; OPD = r - f
    f = 100.0
    pupil = pupil_grid(16)
    # of a paraboloid
    angle = 2 * torch.atan(pupil.norm(dim=1) * 20.0 / (2 * f))
    truth = ((f + shift) ** 2 - (shift * angle.sin()) ** 2).sqrt() - shift * angle.cos() - f
    front = wavefront(paraboloid(40.0, defocus_mm=shift), 0.0, pupil=pupil)
    torch.testing.assert_close(front.opd_mm.detach(), truth, rtol=0, atol=1e-12)


def test_spherical_aberration_of_a_singlet_is_an_eighth_of_the_seidel_sum():
    rim = torch.tensor([[0.0, 1.0]], dtype=D)
    ratio = []
    for diameter in (4.0, 2.0):
        small = focus_paraxial(GeoLens(lens.load("la1509").surfaces, diameter))
        sums = seidel_sums(small, 0.01).total
        ratio.append((wavefront(small, 0.0, pupil=rim).opd_mm / (sums[0] / 8)).item())
    assert ratio[0] == pytest.approx(1, abs=2e-3)
    # (y / f)^4 = 2e-7, and roundings of 1e-14 mm beside 2e-7 mm
    assert (4 * ratio[1] - ratio[0]) / 3 == pytest.approx(1, abs=1e-6)


def disc(waves, count=200):
    pupil = pupil_grid(count)
    r2 = pupil.square().sum(1)
    opd = waves(pupil, r2) * 0.5875618e-3
    return Wavefront(
        pupil, opd, torch.ones_like(r2), torch.zeros_like(pupil), 0.5875618, torch.zeros(2, dtype=D)
    )


@pytest.mark.parametrize("size", [0.1, 0.25, 1.0])
def test_rms_and_strehl_of_defocus_and_spherical_aberration(size):
    # W r^2: RMS W / sqrt 12, Strehl sinc^2 W; W r^4: RMS 2 W / sqrt 45 (Mahajan, Optical Imaging and
    # Aberrations, ch. 8); the rim is a staircase of 1 / 100
    defocus = disc(lambda p, r2: size * r2)
    assert float(rms_waves(defocus)) == pytest.approx(size / math.sqrt(12), rel=5e-4)
    assert float(peak_to_valley_waves(defocus)) == pytest.approx(size, rel=1e-3)
    sinc = math.sin(math.pi * size) / (math.pi * size)
    assert float(strehl_direct(defocus)) == pytest.approx(sinc**2, abs=3e-4)
    spherical = disc(lambda p, r2: size * r2**2)
    assert float(rms_waves(spherical)) == pytest.approx(2 * size / math.sqrt(45), rel=1e-3)


def test_strehl_of_a_twentieth_of_a_wave_by_marechal():
    marechal = math.exp(-((2 * math.pi * 0.05) ** 2) / 12)
    assert float(strehl_marechal(disc(lambda p, r2: 0.05 * r2))) == pytest.approx(marechal, rel=1e-4)


def test_fits_take_away_what_they_fit():
    tilted = disc(lambda p, r2: 3 + 0.4 * p[:, 0] - 1.1 * p[:, 1] + 0.7 * r2, 40)
    assert float(rms_waves(remove_fit(tilted, focus=True))) <= 1e-12
    assert float(remove_fit(tilted, tilt=False).waves.mean()) == pytest.approx(0, abs=1e-12)
    # focus balances r^4: sqrt(4 / 45) falls to 1 / (6 sqrt 5) (Mahajan)
    balanced = float(rms_waves(remove_fit(disc(lambda p, r2: r2**2), focus=True)))
    assert balanced == pytest.approx(1 / (6 * math.sqrt(5)), rel=1e-3)
    # what no light passes does not count
    dark = tilted.pupil[:, 0] > 0.5
    blocked = replace(tilted, opd_mm=torch.where(dark, 7.0, tilted.opd_mm), weight=(~dark).double())
    assert float(rms_waves(remove_fit(blocked, focus=True))) <= 1e-12


def test_a_telecentric_lens_has_a_plane_for_a_reference_sphere():
    # a stop in the front focal plane: the wavefront differs from one with a very far pupil by no more than
    # the pupil's distance tells
    surfaces = lens.load("la1509").surfaces
    front = -float(cardinal_points(lens.load("la1509")).front_focal_z_mm.detach())
    found = []
    for shift in (0.0, 1e-4):
        stop = Surface(math.inf, front + shift, None, 12.7, is_stop=True)
        geo = GeoLens([stop, *(Surface(s.radius_mm, s.thickness_mm, s.medium, 12.7) for s in surfaces)], 10.0)
        found.append(wavefront(geo, 0.02, grid=16).waves.detach())
    assert bool(found[0].isfinite().all())
    # moved 1e-4 mm: slopes of the wavefront by 1e-6 of 10 waves
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=1e-4)


def test_failed_and_vignetted_rays_weigh_nothing():
    stopped = GeoLens(
        [Surface(PLANE, 20.0, None, 3.0), *lens.load("la1509").surfaces], 20.0, soft_edge_mm=0.0
    )
    geo = stopped.freeze()
    clipped = wavefront(geo, 0.0, grid=64, vignetting=True)
    open_ = wavefront(geo, 0.0, grid=64)
    inside = open_.pupil.norm(dim=1) * 10.0 < 3.0
    assert torch.equal(clipped.weight > 0, inside)
    expected = (open_.waves[inside] - open_.waves[inside].mean()).square().mean().sqrt().item()
    assert rms_waves(clipped).item() == pytest.approx(expected, rel=1e-12)


def test_single_precision_is_not_refused():
    single, exact = (wavefront(lens.load("la1509", dtype), 0.0, grid=8).waves for dtype in (torch.float32, D))
    # paths of 105 mm to 6e-8: 0.01 waves each
    assert (single.double() - exact).abs().max().item() <= 0.1


def test_gradients_of_the_wavefront_error():
    geo = lens.load("cooke-triplet")

    def loss(c, t, n):
        moved = geo.replace(curvature_per_mm=c, thickness_mm=t, index_offset=n)
        return rms_waves(wavefront(moved, 0.2, grid=12))

    # roundings of 1e-11 waves over differences of 1e-4
    offset = torch.full_like(geo.index_offset, 0.1)
    check_gradient(loss, geo.curvature_per_mm, geo.thickness_mm, offset, step=3e-5)
