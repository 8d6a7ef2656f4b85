"""Rays, first order, spots and derivatives of three published lenses against independent programs (two ray
tracers, one of 30 digits).

The reference folder holds 54 rays per lens; a few of its numbers are typed in below, so that the core runs
without it.
"""

import math

import pytest
import torch

from codesign import lens
from tests.lens.systems import NAMES, half_field, reference

# the skew ray through pupil (0.5, 0.5) at full field, F line: start, direction, then x, y, L, M, N, optical
# path on the image plane
RAYS = {
    "cooke-triplet": (
        (2.5, -3.50762043288291, -5.0),
        20.0,
        (
            -0.0096154263088987574,
            18.121047266688772,
            -0.047335596206414348,
            0.28290143897612613,
            0.95798022795724781,
            72.990069036208033,
        ),
    ),
    "double-gauss": (
        (8.3325, -7.353236683837698, -5.0),
        14.0,
        (
            -0.057575441795777901,
            24.626717506151886,
            -0.082129877553274167,
            0.11767340421160797,
            0.98965026810198749,
            176.06811488974782,
        ),
    ),
    "la1509": (
        (5.0, 4.825396152541261, -5.0),
        2.0,
        (
            -0.089495677898040319,
            3.3814280058726435,
            -0.051169429316185439,
            -0.016444840832553259,
            0.99855458374264543,
            107.65027994632710,
        ),
    ),
}
# d line: focal length, back focal length, entrance pupil behind the first vertex, exit pupil before the image
# plane, exit pupil diameter
FIRST_ORDER = {
    "cooke-triplet": (
        50.02135070514001,
        42.436440182728965,
        11.505801484441879,
        -50.95521264032195,
        10.232405183291352,
    ),
    "double-gauss": (
        100.00372039876903,
        61.48750293173398,
        57.912053620053136,
        -114.6444800325689,
        38.209572624732544,
    ),
    "la1509": (99.6516960375206, 97.27827837076798, 0.0, -99.65169566675262, 20.0),
}
RMS_SPOT_UM = {  # d line, fields 0, 0.7 and 1 of the half field
    "cooke-triplet": (4.8132151757967065, 15.35562804369679, 10.430072320397763),
    "double-gauss": (36.83721765790443, 48.98500315340455, 64.44725097676016),
    "la1509": (56.91897319716412, 62.40764971535473, 68.22808488036243),
}
# double Gauss, d line, from (16.665, -10.866798566001341, -5) at 9.8 degrees: derivatives of x, y, N and
# optical path (mpmath, 32 digits)
# a plane between two glasses
DERIVATIVES = {
    ("c", 3): (
        5.054248586538719,
        -2.2122001583739874,
        0.00458627719246008,
        -0.722414880552562,
    ),
    ("c", 8): (515.4695956561391, 281.3505333881791, 0.5931732155653981, 8.751435013693847),
    ("t", 4): (-0.03897951997189745, 0.12320344182157804, 0.0006355384841937334, 0.9844891460899354),
    ("t", 10): (-0.16987964230921274, 0.14748367492116188, 0.0, 1.0249929400924462),
    ("n", 2): (-38.9848733290753, 17.704728957606246, -0.03584476360317322, 17.888458017605625),
}
SLOT = {"c": "curvature_per_mm", "t": "thickness_mm", "n": "index_offset"}


def f64(rows):
    return torch.tensor(rows, dtype=torch.float64)


def columns(out):
    return torch.cat([out.position_mm[:, :2], out.direction, out.optical_path_mm[:, None]], 1).detach()


def check_rays(found, truth):
    # the programs agree among themselves to 5e-14 mm (2e-13 in path); the figures asked for leave room for
    # another order of operations
    assert float((found[:, :2] - truth[:, :2]).abs().max()) <= 1e-11
    assert float((found[:, 2:5] - truth[:, 2:5]).abs().max()) <= 1e-12
    assert float((found[:, 5] - truth[:, 5]).abs().max()) <= 1e-11


@pytest.mark.parametrize("name", NAMES)
def test_a_skew_ray_of_every_lens(name):
    start, angle_deg, truth = RAYS[name]
    direction = f64([[0.0, math.sin(math.radians(angle_deg)), math.cos(math.radians(angle_deg))]])
    out = lens.load(name).trace(f64([start]), direction, lens.WAVELENGTH_UM["F"])
    check_rays(columns(out), f64([truth]))
    assert out.status.tolist() == [0]


# eleven surfaces, coordinates up to 30 mm with roundings of 2e-6 mm each: 3e-5 mm is the figure asked for
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", NAMES)
def test_all_reference_rays(name, dtype, shared):
    page = reference(name, shared)
    assert len(page["rays"]) == 54
    for line, wavelength_um in page["wavelengths_um"].items():
        rows = [r for r in page["rays"] if r["w"] == line]
        rays = (f64([r[key] for r in rows]).to(dtype) for key in ("start", "dir"))
        found = columns(lens.load(name, dtype).trace(*rays, wavelength_um))
        truth = f64([[float(r["mp30"][k]) for k in ("x", "y", "L", "M", "N", "opl")] for r in rows])
        if dtype == torch.float64:
            check_rays(found, truth)
        else:
            assert float((found[:, :2] - truth[:, :2]).abs().max()) <= 3e-5


def check_first_order(found, truth):
    names = "efl_mm bfl_mm entrance_pupil_z_mm exit_pupil_z_mm exit_pupil_diameter_mm"
    figures = [getattr(found, name).item() for name in names.split()]
    # lengths below 1 mm: absolute
    assert figures == pytest.approx(truth, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_first_order(name):
    efl, bfl, entrance, exit_from_image, exit_diameter = FIRST_ORDER[name]
    geo = lens.load(name)
    figures = geo.first_order()
    exit_z = exit_from_image + geo.thickness_mm[-1].item()
    check_first_order(figures, (efl, bfl, entrance, exit_z, exit_diameter))
    assert figures.fno.item() * geo.entrance_pupil_diameter_mm == pytest.approx(efl, rel=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_first_order_at_three_lines(name, shared):
    page = reference(name, shared)
    geo = lens.load(name)
    for line, wavelength_um in page["wavelengths_um"].items():
        row = page["first_order"][line]
        own = [row[key]["own"] for key in ("efl", "bfl", "ep_z")]
        exit_z = row["xp_z_from_image"]["optiland"] + geo.thickness_mm[-1].item()
        check_first_order(geo.first_order(wavelength_um), (*own, exit_z, row["xp_d"]["optiland"]))


@pytest.mark.parametrize("name", NAMES)
def test_rms_spots_at_d(name):
    found = lens.rms_spot_mm(lens.load(name), [half_field(name) * h for h in (0.0, 0.7, 1.0)]) * 1e3
    # the reference pupil is rounded to 1e-9 mm
    assert found.tolist() == pytest.approx(RMS_SPOT_UM[name], rel=1e-8)


@pytest.mark.parametrize("name", NAMES)
def test_rms_spots_and_centroids_at_three_lines(name, shared):
    page = reference(name, shared)
    geo = lens.load(name).freeze()
    for row in page["spots"]:
        field = math.radians(page["half_field_deg"] * row["H"])
        positions, weight = lens.spots(geo, [field], lens.WAVELENGTH_UM[row["w"]])
        assert (positions.shape[1], int(weight.sum())) == (row["n_rays"], row["n_rays"])
        centre = positions[0].mean(0)
        # mm; the pupil's rounding again
        assert float(centre[1]) == pytest.approx(row["rayoptics"]["centroid_y"], abs=1e-9)
        rms_um = 1e3 * float((positions[0] - centre).square().sum(1).mean().sqrt())
        assert rms_um == pytest.approx(row["rayoptics"]["rms_centroid_um"], rel=1e-9)


def gradients(geo, start, direction):
    """Rows x, y, L, M, N, opl of the derivatives to every tensor: name -> [6, ...]."""
    out = geo.trace(f64([start]), f64([direction]))
    values = [out.position_mm[0, 0], out.position_mm[0, 1], *out.direction[0], out.optical_path_mm[0]]
    tensors = [getattr(geo, name) for name in SLOT.values()]
    found = [torch.autograd.grad(v, tensors, retain_graph=True) for v in values]
    return {name: torch.stack([row[i] for row in found]) for i, name in enumerate(SLOT.values())}


def test_derivatives_of_a_double_gauss_ray():
    angle = math.radians(9.8)
    found = gradients(
        lens.load("double-gauss"),
        (16.665, -10.866798566001341, -5.0),
        (0.0, math.sin(angle), math.cos(angle)),
    )
    for (kind, surface), truth in DERIVATIVES.items():
        mine = found[SLOT[kind]][[0, 1, 4, 5], surface]
        # atol: entries that are 0, beside others of 0.1 to 500
        torch.testing.assert_close(mine, f64(truth), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_all_reference_derivatives(name, shared):
    geo = lens.load(name)
    for case in reference(name, shared)["ray_parameter_gradients_d"]["rays"]:
        found = gradients(geo, case["ray"]["start"], case["ray"]["dir"])
        for row in case["grads"]:
            truth = f64([row["d"][k] for k in ("x", "y", "L", "M", "N", "opl")])
            mine = found[SLOT[row["param"]]][:, row["surface"]]
            # 1e-8 of each entry; entries that vanish by symmetry may carry the rounding of larger ones
            # (1e-13: the reference's own step)
            torch.testing.assert_close(mine, truth, rtol=1e-8, atol=1e-11 * float(truth.abs().max()) + 1e-13)
