"""Published lens files, where they lie beside the checkout: focal lengths against what makers and patents
say, one lens in two formats, and reasons for refusals."""

import contextlib
import json
import math

import pytest
import torch

from codesign import lens
from codesign.errors import CodesignError, DomainError, FileFormatError
from codesign.lens.analysis.rays import field_rays
from studies import lens_files
from studies.frame.run import main
from studies.lens_files import ALLOWED, CLAIMS, examine

FOLDER = "data/lenses"
EXTENSIONS = (".json", ".zmx", ".seq", ".txt")

# files whose own header states the paraxial focal length
HEADERS = [
    f"deeplens/{name}.json"
    for name in (
        "camera/ef100mm_f2.8",
        "camera/rf50mm_f1.8",
        "camera/sigma70mm_f2.8",
        "camera/yongnuo_50mm_f1.8",
        "cooke",
        "thorlabs/lb1471a",
    )
]
# and files that claim none, for the round trips
OTHERS = [
    f"rayoptics/{name}"
    for name in (
        "US05331467-1.zmx",
        "US08427765-1.ZMX",
        "HoO-V2C18Ex27.zmx",
        "schmidt.seq",
        "achroMangin_ok.seq",
        "asp46.seq",
    )
]
# file -> what the sentence must name
REFUSED = {
    "deeplens/materials_data.json": "schema",
    "deeplens/zemax_double_gaussian.zmx": "surface 1: type PARAXIAL",
    "deeplens/cellphone/3P_blank.json": "the sensor lies at 6.09375 mm, but the distances d_next lead to "
    "6.59375 mm",
    "rayoptics/ASL5040-UV-Zemax(ZMX).zmx": "surface 1: type QED_TYPE",
    "rayoptics/CODV_35571.seq": "surface 2: its aperture is off the axis",
    "rayoptics/HoO-V2C18Ex46.zmx": "surface 7: type TOROIDAL",
    "rayoptics/US05831776-1.zmx": "OBNA",
    "rayoptics/US08011793-1.zmx": "surface 2: its aperture is rectangular",
    "rayoptics/achroMangin.seq": "surface 1: glass 'SK19_Schott' is not in the catalogue",
    "rayoptics/dec_rev_tilt_test.seq": "surface 3: it tilts or shifts everything behind it",
    "rayoptics/dec_test.seq": "surface 4: it tilts or shifts everything behind it",
    "rayoptics/dec_tilt_test.seq": "surface 2: it bends the axis",
    "rayoptics/folded_lenses.seq": "surface 2: it bends the axis",
    "rayoptics/lens_reflection_test.seq": "surface 3: the glass behind it is -0.03",
    "rayoptics/threemir.seq": "surface 2: its aperture is rectangular",
    "rayoptics/tilt_test.seq": "surface 3: it tilts or shifts everything behind it",
    "rayoptics/zmax_37992.zmx": "surface 3: its aperture is off the axis",
}


@pytest.mark.parametrize("name", [*HEADERS, *(name for name, claim in CLAIMS.items() if not claim.remark)])
def test_focal_lengths_are_within_half_a_percent_of_what_is_claimed(name, shared):
    outcome = examine(shared(f"{FOLDER}/{name}"), shared(FOLDER))
    claim, found = outcome.claims[0]
    assert found == pytest.approx(claim.efl_mm, rel=ALLOWED)


@pytest.mark.parametrize(
    ("name", "claimed"),
    [("rf16mm_f2.8", 16), ("rf24mm_f1.8", 24), ("ef35mm_f2.0", 35), ("ef40mm_f2.8", 40), ("ef50mm_f1.8", 50)],
)
def test_camera_lenses_have_the_focal_length_of_their_name_as_far_as_names_are_rounded(name, claimed, shared):
    geo = lens.load(shared(f"{FOLDER}/deeplens/camera/{name}.json"))
    assert geo.first_order().efl_mm.item() == pytest.approx(claimed, rel=0.031)
    # and they are in focus
    assert geo.first_order().bfl_mm.item() == pytest.approx(geo.thickness_mm[-1].item(), abs=0.05)


# file -> wavelength um; focal length, back focal length, entrance pupil diameter and its distance from the
# first surface, mm, without signs, as ray-optics 0.9.8 reads the same file
PEER = {
    "CODV_32327.seq": (0.5876, 100.030812742, 95.9519441518, 25.0, 0.0),
    "CODV_49664.seq": (0.5876, 35.0106981913, 28.0864845268, 25.0, 0.0),
    "CODV_65564.seq": (0.5876, 1.49886290764, 0.917674992441, 1.0, 0.0),
    "HoO-V2C18Ex03.zmx": (0.55, 80.0934306569, 24.0350364964, 20.0233580919, 15.9999989294),
    "US00583336-2-scaled.zmx": (0.5875618, 49.3889758468, 41.6005119045, 10.9753280202, 12.2884628237),
    "achroMangin_ok.seq": (0.488, 8.95236806236, 8.11670252288, 5.0, 0.0),
    "ag_dblgauss.seq": (0.5876, 100.003757028, 61.487536418, 50.0, 57.9120144788),
    "landscape_lens.seq": (0.55, 9.99999999061, 10.1502446312, 1.0, 0.0),
    "mangin.seq": (0.555, 457.121708312, 450.553964888, 200.0, 0.0),
    "questar35.seq": (0.555, 1282.7, 259.468229611, 89.0, 161.322621233),
    "rc_f16.seq": (0.55, 31702.2156015, 9441.83097173, 7924.8, 0.0),
    "schmidt.seq": (0.5876, 99.9996957686, 1.73028820645, 75.0, 0.0),
    "singlet.seq": (0.65, 13.1054609256, 12.6602357437, 3.00869821271, 0.0),
    "unfolded_lenses_w_ape.seq": (0.555, 2564.33525393, 2513.25300338, 1.0, 0.0),
}


@pytest.mark.parametrize("name", PEER)
def test_first_order_figures_are_those_of_another_reader(name, shared):
    wavelength_um, *true = PEER[name]
    geo = lens.load(shared(f"{FOLDER}/rayoptics/{name}"))
    f = geo.first_order(wavelength_um)
    found = [abs(v.item()) for v in (f.efl_mm, f.bfl_mm, f.entrance_pupil_diameter_mm, f.entrance_pupil_z_mm)]
    assert found == pytest.approx(true, rel=1e-6)  # it puts objects at infinity to 1e10 mm


# file -> (wavelength um, largest miss of the axis in mm by rays parallel to it through 0.5 and 0.9 of the
# pupil); a wrong sign anywhere misses by millimetres
FOCUSED = {
    "paraboloid.seq": (0.55, 1e-12),
    "paraboloid_f8.seq": (0.55, 1e-12),
    "CODV_65988.seq": (0.5876, 2e-5),
    "questar35.seq": (0.555, 0.02),
    "US05331467-1.zmx": (0.5876, 0.03),
    "HoO-V2C18Ex03.zmx": (0.55, 0.002),
    "schmidt.seq": (0.5876, 0.02),
    "CODV_49664.seq": (0.5876, 0.01),
}


@pytest.mark.parametrize("name", FOCUSED)
def test_mirrors_aspheres_and_phases_bring_the_axis_to_a_focus(name, shared):
    wavelength_um, miss_mm = FOCUSED[name]
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
    assert set(refused) == set(REFUSED)
    for name, sentence in REFUSED.items():
        assert sentence in refused[name]


@pytest.mark.parametrize(
    ("name", "stored"), [("CODV_32327", 95.95194415183156), ("CODV_65564", 0.9176749924408083)]
)
def test_the_solved_focus_is_the_one_another_program_stored(name, stored, shared):
    assert lens.load(shared(f"{FOLDER}/rayoptics/{name}.seq")).thickness_mm[-1].item() == pytest.approx(
        stored, rel=1e-12
    )


def test_a_diffractive_surface_brings_the_focus_where_the_maker_put_the_image(shared):
    geo = lens.load(shared(f"{FOLDER}/rayoptics/CODV_65988.seq"))
    assert geo.first_order().bfl_mm.item() == pytest.approx(geo.thickness_mm[-1].item(), abs=0.005)
    without = lens.load(shared(f"{FOLDER}/rayoptics/CODV_65988_noDOE.seq"))
    assert abs(without.first_order().bfl_mm.item() - without.thickness_mm[-1].item()) > 0.5


def fan(geo, half_field_deg=5.0):
    """Rays on and off axis through a tenth of the pupil's width and its rim, on the entrance pupil of the
    lens."""
    f = geo.first_order()
    pupil = torch.tensor([[0.0, 0.0], [0.0, 0.5], [0.5, 0.0], [0.0, -0.9]], dtype=torch.float64)
    origins = torch.cat(
        [pupil * geo.entrance_pupil_diameter_mm / 2, f.entrance_pupil_z_mm.detach().expand(4, 1)], 1
    )
    towards = torch.tensor(
        [0.0, math.sin(math.radians(half_field_deg)), math.cos(math.radians(half_field_deg))],
        dtype=torch.float64,
    ).expand(4, 3)
    return origins - 50 * towards, towards.contiguous()


def same_rays(a, b, atol, leading_mm=0.0):
    """Positions of the same rays through two lenses; the second begins with a plane ``leading_mm`` in front
    of the first's vertex."""
    origins, towards = fan(a)
    shift = torch.tensor([0.0, 0.0, leading_mm], dtype=torch.float64)
    torch.testing.assert_close(
        b.trace(origins + shift, towards).position_mm,
        a.trace(origins, towards).position_mm,
        rtol=0,
        atol=atol,
    )


def test_one_lens_as_text_and_as_zmx(shared):
    text, zmx = (
        lens.load(shared(f"{FOLDER}/diffoptics/DoubleGauss/US02532751-1.{kind}")) for kind in ("txt", "zmx")
    )
    # its wavelength is 587.562 nm, not 587.5618
    assert text.entrance_pupil_diameter_mm == pytest.approx(zmx.entrance_pupil_diameter_mm, rel=1e-7)
    same_rays(text, zmx, 5e-5)  # one radius is -7.02695 in one and -7.027 in the other


def test_one_lens_as_deeplens_and_as_zmx(shared):
    page, zmx = (
        lens.load(shared(f"{FOLDER}/deeplens/camera/ef35mm_f2.0.{kind}")) for kind in ("json", "zmx")
    )
    same_rays(page, zmx, 1e-10)


def test_one_lens_from_optiland_and_from_the_catalogue(shared):
    # indices rounded to 1e-9 in one
    same_rays(lens.load("cooke-triplet"), lens.load(shared(f"{FOLDER}/optiland/Cooke_triplet.json")), 1e-7)


def test_double_gauss_of_the_program_that_sells_it_and_of_the_catalogue(shared):
    named = lens.load("double-gauss")
    file = lens.load(shared(f"{FOLDER}/rayoptics/ag_dblgauss.seq"))
    assert file.first_order().efl_mm.item() == pytest.approx(named.first_order().efl_mm.item(), rel=1e-3)


@pytest.mark.parametrize("name", [*HEADERS, *CLAIMS, *OTHERS])
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
        assert b.radius_mm == pytest.approx(a.radius_mm, rel=3e-16 if extension == "zmx" else 0, abs=0)
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
        assert after.first_order().efl_mm.item() == pytest.approx(
            before.first_order().efl_mm.item(), rel=1e-12
        )


OPENED = ("cooke-triplet", "optiland/heliar.json", "rayoptics/US05331467-1.zmx")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", OPENED)
def test_another_program_opens_what_is_written_as_zmx_and_sees_the_same_lens(name, shared, tmp_path):
    fileio = pytest.importorskip("optiland.fileio")
    geo = lens.load(shared(f"{FOLDER}/{name}") if "/" in name else name).freeze()
    lens.save(geo, tmp_path / "lens.zmx")
    optic = fileio.load_zemax_file(str(tmp_path / "lens.zmx"))
    assert float(optic.paraxial.f2()) == pytest.approx(float(geo.first_order().efl_mm), rel=1e-5)
    pupil = lens.pupil_grid(8)
    for share in (0.0, 0.7, 1.0):
        ours = geo.trace(*field_rays(geo, share * math.radians(geo.half_field_deg), pupil))
        rays = optic.trace_generic(0.0, share, pupil[:, 0].numpy(), pupil[:, 1].numpy(), 0.5875618)
        theirs = torch.stack([torch.as_tensor(v).ravel() for v in (rays.x, rays.y)], 1)
        both = (ours.status == 0) & theirs.isfinite().all(1)
        spots = [p[both].std(0, correction=0).norm() for p in (ours.position_mm[:, :2], theirs)]
        assert float(spots[0]) == pytest.approx(float(spots[1]), rel=0.01)


def test_a_study_of_a_folder_counts_what_loads(tmp_path, capsys):
    folder = tmp_path / "lenses"
    out = tmp_path / "run"
    folder.mkdir()
    lens.save(lens.load("la1509"), folder / "good.zmx")
    (folder / "bad.seq").write_text("S 1 1 NOGLASS")
    (folder / "note.md").write_text("not a lens")
    arguments = ["--out", str(out), "--folder", str(folder)]
    assert main(lens_files.study, lens_files.Config, arguments) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert [metrics[name] for name in ("files", "loaded", "refused", "claims")] == [2, 1, 1, 0]
    table = (out / "table.md").read_text()
    assert "| bad.seq | refused |" in table
    assert "glass 'NOGLASS' is not in the catalogue" in table
    assert "| good.zmx | loads | 2 | 20 | 99.6" in table
    arguments = ["--out", str(tmp_path / "none"), "--folder", str(tmp_path / "nowhere")]
    assert main(lens_files.study, lens_files.Config, arguments) == 2
    assert "name another folder with --folder" in capsys.readouterr().err
