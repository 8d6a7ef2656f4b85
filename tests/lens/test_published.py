"""Three published lenses against independent programs: two ray tracers, one of 30 digits
(tests/data/refs/lens), and what optiland says of their wavefronts, foci and transfer functions
(optiland.json)."""

import json
import math
from pathlib import Path

import pytest
import torch

from codesign import lens
from codesign.lens import Glass, analysis
from codesign.lens.seidel import seidel_sums
from tests.lens.systems import NAMES, PLANE, close, half_field, reference
from tests.numbers import f64

OPTILAND = json.loads(Path(__file__).with_name("optiland.json").read_text())
SHARES = (0.0, 0.7, 1.0)
AXES = ("x", "y", "L", "M", "N", "opl")
SLOT = {"c": "curvature_per_mm", "t": "thickness_mm", "n": "index_offset"}


@pytest.fixture(params=NAMES)
def name(request):
    return request.param


@pytest.fixture
def page(name, shared):
    return reference(name, shared)


@pytest.fixture
def geo(name):
    return lens.load(name).freeze()


def fields(name):
    return [share * half_field(name) for share in SHARES]


def test_they_are_the_published_prescriptions(page, geo, name):
    facts = (geo.stop_index, geo.entrance_pupil_diameter_mm, lens.half_field_deg(name))
    assert facts == (page["stop_index"], page["epd"], page["half_field_deg"])
    for mine, theirs in zip(geo.to_surfaces(), page["surfaces"], strict=True):
        shape = mine.radius_mm, mine.thickness_mm, mine.semi_aperture_mm, mine.conic
        keys = ("thickness", "semi_aperture", "conic")
        assert shape == (theirs["radius"] or PLANE, *(theirs[key] for key in keys))
        for line, wavelength_um in lens.WAVELENGTH_UM.items():
            index = 1.0 if mine.medium is None else mine.medium.index(wavelength_um)
            close(index, theirs["n"][line], atol=1e-12)
            if theirs["glass"]:
                # of the catalogue, rounded to 1e-9 there
                close(
                    Glass.named(theirs["material"]).index(wavelength_um),
                    theirs["n"][line],
                    atol=6e-10,
                )


# the programs agree among themselves to 5e-14 mm (2e-13 in path); the figures asked for leave room
# for another order of operations. Float32: eleven surfaces, coordinates up to 30 mm with roundings
# of 2e-6 mm each
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_rays(name, page, dtype):
    assert len(page["rays"]) == 54
    for line, wavelength_um in page["wavelengths_um"].items():
        rows = [row for row in page["rays"] if row["w"] == line]
        rays = (f64([row[key] for row in rows]).to(dtype) for key in ("start", "dir"))
        out = lens.load(name, dtype).trace(*rays, wavelength_um)
        assert not out.status.any()
        truth = f64([[float(row["mp30"][axis]) for axis in AXES] for row in rows])
        if dtype == torch.float32:
            close(out.position_mm[:, :2], truth[:, :2], atol=3e-5)
            continue
        close(out.position_mm[:, :2], truth[:, :2], atol=1e-11)
        close(out.direction, truth[:, 2:5], atol=1e-12)
        close(out.optical_path_mm, truth[:, 5], atol=1e-11)


def test_derivatives_of_rays(name, page):
    geo = lens.load(name)
    tensors = [getattr(geo, slot) for slot in SLOT.values()]
    for case in page["ray_parameter_gradients_d"]["rays"]:
        out = geo.trace(f64([case["ray"]["start"]]), f64([case["ray"]["dir"]]))
        values = [*out.position_mm[0, :2], *out.direction[0], out.optical_path_mm[0]]
        found = [torch.autograd.grad(value, tensors, retain_graph=True) for value in values]
        slopes = {
            kind: torch.stack(rows)
            for kind, rows in zip(SLOT, zip(*found, strict=True), strict=True)
        }
        for row in case["grads"]:
            truth = f64([row["d"][axis] for axis in AXES])
            # 1e-8 of each entry; entries that vanish by symmetry may carry the rounding of larger
            # ones (1e-13: the reference's own step)
            room = 1e-11 * float(truth.abs().max()) + 1e-13
            close(slopes[row["param"]][:, row["surface"]], truth, 1e-8, atol=room)


def test_first_order_at_three_lines(page, geo):
    for line, wavelength_um in page["wavelengths_um"].items():
        row = page["first_order"][line]
        figures = geo.first_order(wavelength_um)
        for key, figure in (("efl", figures.efl_mm), ("bfl", figures.bfl_mm)):
            close(figure, row[key]["own"], 1e-12)
        close(figures.fno, row["efl"]["own"] / page["epd"], 1e-12)
        # lengths below 1 mm: absolute
        close(figures.entrance_pupil_z_mm, row["ep_z"]["own"], 1e-12, atol=1e-12)
        exit_z = figures.exit_pupil_z_mm - geo.thickness_mm[-1]
        close(exit_z, row["xp_z_from_image"]["optiland"], 1e-12, atol=1e-12)
        close(figures.exit_pupil_diameter_mm, row["xp_d"]["optiland"], 1e-12)


def test_spots_and_centroids_at_three_lines(page, geo):
    for row in page["spots"]:
        field, wavelength_um = (
            math.radians(page["half_field_deg"] * row["H"]),
            lens.WAVELENGTH_UM[row["w"]],
        )
        positions, weight = lens.spots(geo, [field], wavelength_um)
        assert (positions.shape[1], int(weight.sum())) == (row["n_rays"], row["n_rays"])
        # mm; the reference pupil is rounded to 1e-9 mm
        close(positions[0, :, 1].mean(), row["rayoptics"]["centroid_y"], atol=1e-9)
        size_mm = lens.rms_spot_mm(geo, [field], wavelength_um)
        close(size_mm, row["rayoptics"]["rms_centroid_um"] / 1e3, 1e-9)


def test_seidel_sums(page, geo, name):
    sums = seidel_sums(geo, half_field(name))
    # both in double precision; sums of parts ten times larger; its signs are the opposite ones
    close(-sums.total, page["seidel_d"]["optiland_seidels"], 1e-11)
    for k, theirs in enumerate(map(f64, page["seidel_d"]["rayoptics_per_surface"].values())):
        # their chief ray is aimed to about 1e-7
        close(sums.per_surface[:, k], theirs[:-1], atol=1e-7 * float(theirs.abs().max()))
        close(sums.total[k], theirs[-1], 1e-6)


def test_distortion_and_colour(page, geo, name):
    field, others_um = half_field(name), [lens.WAVELENGTH_UM[line] for line in "FC"]
    truth = page["distortion_full_field_d"]["percent"]
    # published against f tan, on a film a little out of focus
    ideal = geo.first_order().efl_mm * math.tan(field)
    close(100 * (analysis.chief_height_mm(geo, [field])[0] / ideal - 1), truth, atol=1e-9)
    chiefs = (row for row in page["rays"] if row["px"] == row["py"] == 0 and row["H"] == 1)
    height = {row["w"]: float(row["mp30"]["y"]) for row in chiefs}
    # the reference pupil is rounded to 1e-9
    found = analysis.lateral_colour_mm(geo, [field], others_um)[0]
    close(found, [height[line] - height["d"] for line in "FC"], atol=1e-9)
    bfl = {line: page["first_order"][line]["bfl"]["own"] for line in "dFC"}
    found = analysis.chromatic_focus_shift_mm(geo, others_um)
    close(found, [bfl[line] - bfl["d"] for line in "FC"], atol=1e-12)


def test_wavefronts(geo, name):
    pupil = torch.cartesian_prod(*[torch.linspace(-1, 1, 32, dtype=torch.float64)] * 2)
    pupil = pupil[pupil.square().sum(1) <= 1]
    assert len(pupil) == 740
    for field, truth in zip(fields(name), OPTILAND[name]["wavefront"], strict=True):
        front = analysis.wavefront(geo, field, pupil=pupil)
        # paths of 180 mm carry roundings of 3e-14 mm each, 5e-11 waves, in their program and here
        close(torch.stack([analysis.rms_waves(front), front.waves.mean()]), truth, atol=1e-9)


# their close rays leave 1e-8 mm; numbers of up to 200 mm rounded to 6e-8 of themselves
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 2e-8), (torch.float32, 3e-5)])
def test_field_curvature(name, dtype, atol):
    found = analysis.focus_shift_mm(lens.load(name, dtype), fields(name))
    assert found.dtype == dtype
    close(found, OPTILAND[name]["focus"], atol=atol)


def test_tangential_transfer_functions_of_the_triplet():
    geo = lens.load("cooke-triplet").freeze()
    for field, truth in zip(fields("cooke-triplet"), OPTILAND["cooke-triplet"]["mtf"], strict=True):
        # theirs interpolates between steps of 1.2 / mm, where the curve bends by up to 4e-3, and
        # takes one f-number for both directions
        found = analysis.diffraction_mtf(geo, field, [20.0, 50.0, 100.0], grid=256)[0]
        close(found, truth, atol=5e-3)
