"""Published lens files, where they lie beside the checkout: focal lengths against what makers and
patents say, one lens in two formats, and reasons for refusals."""

import contextlib
import json
import math
from pathlib import Path

import pytest
import torch

from codesign import lens
from codesign.errors import CodesignError, DomainError, FileFormatError
from codesign.lens.analysis.rays import field_rays
from tests.lens.systems import close
from tests.numbers import f64

FOLDER = "data/lenses"
EXTENSIONS = (".json", ".zmx", ".seq", ".txt")

# the maker's 1.49 mm are those of the name, not of what its line says
pytestmark = pytest.mark.filterwarnings(
    "ignore:glass 'D-ZK3M' has nd 1.58642", "ignore:the stop, 0.5 mm wide, cuts the beam"
)
REAL = json.loads(Path(__file__).with_name("real_files.json").read_text())


@pytest.mark.parametrize("name", [*REAL["headers"], *REAL["claimed"]])
def test_focal_lengths_are_within_half_a_percent_of_what_is_claimed(name, shared):
    path = shared(f"{FOLDER}/{name}")
    if name in REAL["headers"]:
        wavelength_um, claimed = 0.5875618, json.loads(path.read_text())["foclen"]
    else:
        wavelength_um, claimed, _ = REAL["claimed"][name]
    close(lens.load(path).first_order(wavelength_um).efl_mm.detach(), claimed, 0.005)


@pytest.mark.parametrize("name", REAL["peer"])
def test_first_order_figures_are_those_of_another_reader(name, shared):
    wavelength_um, *true = REAL["peer"][name]
    geo = lens.load(shared(f"{FOLDER}/rayoptics/{name}"))
    f = geo.first_order(wavelength_um)
    found = [
        abs(v.item())
        for v in (f.efl_mm, f.bfl_mm, f.entrance_pupil_diameter_mm, f.entrance_pupil_z_mm)
    ]
    close(found, true, 1e-6)  # it puts objects at infinity to 1e10 mm


@pytest.mark.parametrize("name", REAL["focused"])
def test_mirrors_aspheres_and_phases_bring_the_axis_to_a_focus(name, shared):
    wavelength_um, miss_mm = REAL["focused"][name]
    geo = lens.load(shared(f"{FOLDER}/rayoptics/{name}"))
    origins, towards = fan(geo, 0.0)
    assert geo.trace(origins, towards, wavelength_um).position_mm.abs().max().item() < miss_mm


@pytest.mark.filterwarnings("ignore:.* the centre of the stop")
def test_every_file_is_a_lens_or_is_refused_by_name(shared):
    folder = shared(FOLDER)
    refused = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in EXTENSIONS:
            try:
                lens.load(path)
            except CodesignError as error:
                refused[path.relative_to(folder).as_posix()] = str(error)
                assert str(error).startswith(f"lens file {path}: ")  # noqa: PT017
                assert len(str(error)) < 500 + len(str(path))  # noqa: PT017
    assert set(refused) == set(REAL["refused"])
    for name, sentence in REAL["refused"].items():
        assert sentence in refused[name]


@pytest.mark.parametrize(
    ("name", "stored"), [("CODV_32327", 95.95194415183156), ("CODV_65564", 0.9176749924408083)]
)
def test_the_solved_focus_is_the_one_another_program_stored(name, stored, shared):
    close(lens.load(shared(f"{FOLDER}/rayoptics/{name}.seq")).thickness_mm[-1], stored, 1e-12)


def fan(geo, half_field_deg=5.0):
    """Rays on and off axis through a tenth of the pupil's width and its rim, on the entrance pupil
    of the lens."""
    f = geo.first_order()
    pupil = f64([[0.0, 0.0], [0.0, 0.5], [0.5, 0.0], [0.0, -0.9]])
    origins = torch.cat(
        [pupil * geo.entrance_pupil_diameter_mm / 2, f.entrance_pupil_z_mm.detach().expand(4, 1)], 1
    )
    towards = f64(
        [0.0, math.sin(math.radians(half_field_deg)), math.cos(math.radians(half_field_deg))]
    ).expand(4, 3)
    return origins - 50 * towards, towards.contiguous()


def same_rays(a, b, atol):
    rays = fan(a)
    close(b.trace(*rays).position_mm, a.trace(*rays).position_mm, atol=atol)


@pytest.mark.parametrize(
    ("one", "other", "atol"),
    [
        # one radius is -7.02695 in one and -7.027 in the other
        (
            "diffoptics/DoubleGauss/US02532751-1.txt",
            "diffoptics/DoubleGauss/US02532751-1.zmx",
            5e-5,
        ),
        ("deeplens/camera/ef35mm_f2.0.json", "deeplens/camera/ef35mm_f2.0.zmx", 1e-10),
        # indices rounded to 1e-9 in one
        ("cooke-triplet", "optiland/Cooke_triplet.json", 1e-7),
    ],
)
def test_one_lens_in_two_formats(one, other, atol, shared):
    a, b = (lens.load(shared(f"{FOLDER}/{name}") if "/" in name else name) for name in (one, other))
    if one.endswith(".txt"):
        # its wavelength is 587.562 nm, not 587.5618
        close(a.entrance_pupil_diameter_mm, b.entrance_pupil_diameter_mm, 1e-7)
    same_rays(a, b, atol)


@pytest.mark.parametrize("name", [*REAL["headers"], *REAL["claimed"], *REAL["others"]])
@pytest.mark.parametrize("extension", ["json", "zmx"])
def test_real_lenses_survive_a_round_trip(name, extension, shared, tmp_path):
    before = lens.load(shared(f"{FOLDER}/{name}"))
    if extension == "zmx" and before.phase.numel():
        with pytest.raises(FileFormatError, match="diffractive phase"):
            lens.save(before, tmp_path / "a.zmx")
        return
    lens.save(before, tmp_path / f"a.{extension}")
    after = lens.load(tmp_path / f"a.{extension}")
    for a, b in zip(before.to_surfaces(), after.to_surfaces(), strict=True):
        close(b.radius_mm, a.radius_mm, 3e-16 if extension == "zmx" else 0)
        for field in (
            "thickness_mm",
            "semi_aperture_mm",
            "conic",
            "is_stop",
            "mirror",
            "phase",
            "inner_semi_aperture_mm",
            *(["asphere", "medium"] if extension == "json" else []),
        ):
            assert getattr(a, field) == getattr(b, field) or (
                field == "is_stop" and before.stop_index == after.stop_index
            ), field
    assert after.entrance_pupil_diameter_mm == before.entrance_pupil_diameter_mm
    with contextlib.suppress(DomainError):  # a file of planes has no focal length
        close(after.first_order().efl_mm, before.first_order().efl_mm, 1e-12)


OPENED = ("cooke-triplet", "optiland/heliar.json", "rayoptics/US05331467-1.zmx")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", OPENED)
def test_another_program_opens_what_is_written_as_zmx_and_sees_the_same_lens(
    name, shared, tmp_path
):
    fileio = pytest.importorskip("optiland.fileio")
    geo = lens.load(shared(f"{FOLDER}/{name}") if "/" in name else name).freeze()
    lens.save(geo, tmp_path / "lens.zmx")
    optic = fileio.load_zemax_file(str(tmp_path / "lens.zmx"))
    close(optic.paraxial.f2(), geo.first_order().efl_mm, 1e-5)
    pupil = lens.pupil_grid(8)
    for share in (0.0, 0.7, 1.0):
        ours = geo.trace(*field_rays(geo, share * math.radians(geo.half_field_deg), pupil))
        rays = optic.trace_generic(0.0, share, pupil[:, 0].numpy(), pupil[:, 1].numpy(), 0.5875618)
        theirs = torch.stack([torch.as_tensor(v).ravel() for v in (rays.x, rays.y)], 1)
        both = (ours.status == 0) & theirs.isfinite().all(1)
        spots = [p[both].std(0, correction=0).norm() for p in (ours.position_mm[:, :2], theirs)]
        close(spots[0], spots[1], 0.01)
