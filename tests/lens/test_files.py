"""Lens files: exact round trips, what cannot be saved, and one sentence for everything a file can
have wrong."""

import os
import random
import re

import pytest
import torch

from codesign import lens
from codesign.errors import CodesignError, DomainError, FileFormatError
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.files.text import LARGEST_BYTES, read_text
from codesign.lens.surface import Phase
from tests.lens.systems import FAULTS, close, load_file
from tests.numbers import f64

PLANE = float("inf")
SPECIAL = [
    Surface(
        31.7,
        5.1,
        Glass.from_indices(1.61, 1.6, 1.595, "mine"),
        9.0,
        -0.7,
        (1e-4, -2.2e-6),
        is_stop=True,
    ),
    Surface(-50.3, 0.1, None, 9.0),
    Surface(PLANE, 2.0, Glass.named("F2"), 8.0, asphere=(0.0, 1e-7, 3e-9)),
    Surface(-44.4, 41.0, None, 8.0, conic=0.3),
]
# what only the newer schema holds
PHASE = Phase((-3.3, 0.01), order=2, blaze_um=0.55)
RARE = [
    Surface(31.7, 5.1, Glass.from_abbe(1.6123, 44.1), 9.0, is_stop=True, phase=PHASE),
    Surface(-250.0, 20.0, None, 9.0, inner_semi_aperture_mm=1.25),
    Surface(
        -180.3, 21.0, None, 9.0, -1.1, mirror=True, decentre_mm=(0.1, -0.2), tilt_deg=(0.3, 1 / 3)
    ),
]
LENSES = {
    "special": GeoLens(SPECIAL, 9.5, soft_edge_mm=0.15, name="special"),
    "rare": GeoLens(RARE, 9.5, soft_edge_mm=0.15, name="rare", half_field_deg=12.3),
    "double-gauss": lens.load("double-gauss"),
    "scaled": lens.load("la1509").scaled(0.37),
}
FACTS = ("name", "stop_index", "soft_edge_mm", "entrance_pupil_diameter_mm", "half_field_deg")


@pytest.mark.parametrize("name", LENSES)
def test_a_round_trip_is_exact(name, tmp_path):
    before = LENSES[name]
    lens.save(before, tmp_path / "a.json")
    after = lens.load(tmp_path / "a.json")
    for tensor, value in before.state_dict().items():
        assert torch.equal(after.state_dict()[tensor], value), tensor
    assert after.to_surfaces() == before.to_surfaces()
    assert [getattr(after, fact) for fact in FACTS] == [getattr(before, fact) for fact in FACTS]
    for wavelength_um in (0.45, 0.7):
        assert torch.equal(after.index(wavelength_um), before.index(wavelength_um))
    lens.save(after, tmp_path / "b.json")
    assert (tmp_path / "b.json").read_bytes() == (tmp_path / "a.json").read_bytes()


def test_changed_values_are_what_is_saved(tmp_path):
    geo = LENSES["special"]
    offset = f64([0.01, 0, -0.02, 0])
    changed = geo.replace(
        curvature_per_mm=geo.curvature_per_mm * 1.1,
        thickness_mm=geo.thickness_mm + 0.01,
        index_offset=offset,
    )
    lens.save(changed, tmp_path / "a.json")
    points = f64([[1.0, 2.0, -5.0], [-3.0, 0.5, -5.0]])
    rays = points, f64([[0.0, 0.0, 1.0]] * 2)
    found = lens.load(tmp_path / "a.json").trace(*rays).position_mm
    # 1 / (1 / c) may differ from c in the last bit
    close(found, changed.trace(*rays).position_mm, atol=1e-13)


@pytest.mark.parametrize(("kind", "exchanges", "pattern"), FAULTS)
def test_a_fault_gives_one_sentence_naming_file_place_and_value(kind, exchanges, pattern, tmp_path):
    with pytest.raises(CodesignError, match=pattern) as caught:
        load_file(tmp_path, kind, exchanges)
    message = str(caught.value)
    assert re.match(rf"lens file {tmp_path}/lens\.\w+: ", message)
    assert "\n" not in message
    assert len(message) < 600


JUNK = random.Random(0).randbytes(20_000)
HOSTILE = {
    "empty": b"",
    "one line of 50 MB": b"9" * 50_000_000,
    "3 MB of lines": b"S 1 1\n" * 500_000,
    "2 MB of lines": b"S 1 1\n" * 333_000,
    "2 MB of long lines": b"S 1 1 ; S 1 1 ; S 1 1 ; S 1 1 ; S 1 1 ; \n" * 47_000,
    "2 MB of brackets": b"[" * 2_000_000,
    "2 MB of braces": b'{"a":' * 390_000,
    "2 MB of SURF": b"SURF 0\n" * 285_000,
    "2 MB of semicolons": b";" * 2_000_000,
    "2 MB of quotes": b"'" * 2_000_000,
    "2 MB of continuations": b"&\n" * 1_000_000,
    "2 MB joined": (b"S" + b"1" * 38 + b"&\n") * 49_000,
    "2 MB of bangs": b"!\n" * 1_000_000,
    "null bytes": b"MODE SEQ\x00\x00\x00",
    "binary": JUNK,
    "binary UTF-16": b"\xff\xfe" + JUNK,
    "half a UTF-16 character": b"\xff\xfeM",
    "lone surrogates": b"\xff\xfe" + b"\x00\xd8" * 50,
    "escape sequences": b"\x1b[2J\x1b[H",
    "a million digits": b'{"schema": ' + b"9" * 1_000_000 + b"}",
    "code": b"__import__('os').system('touch hacked')\n" * 5,
    "negative surface": b"MODE SEQ\nSURF -1\n",
    "600 surfaces": b"MODE SEQ\n" + b"".join(b"SURF %d\n" % i for i in range(600)),
}


@pytest.mark.parametrize("ending", ["json", "zmx", "seq", "txt"])
@pytest.mark.parametrize("kind", HOSTILE)
def test_every_hostile_file_ends_in_one_short_sentence(kind, ending, tmp_path):
    with pytest.raises(CodesignError) as caught:
        load_file(tmp_path, ending, content=HOSTILE[kind])
    message = str(caught.value)
    assert message.startswith(f"lens file {tmp_path / 'lens'}.{ending}: ")
    assert message.isprintable()
    assert len(message) < 500
    assert len(list(tmp_path.iterdir())) == 1


def test_no_more_than_the_limit_is_ever_read(tmp_path):
    path = tmp_path / "lens.zmx"
    with open(path, "wb") as file:
        file.truncate(50_000_000_000)  # a sparse file, longer than memory
    with pytest.raises(FileFormatError, match=f"more than the {LARGEST_BYTES} of its kind"):
        lens.load(path)
    path.write_bytes(b" " * LARGEST_BYTES)
    assert len(read_text(path)) == LARGEST_BYTES


def test_a_link_to_a_lens_file_is_read(tmp_path):
    lens.save(lens.load("la1509"), tmp_path / "a.json")
    (tmp_path / "b.json").symlink_to("a.json")
    assert lens.load(tmp_path / "b.json").to_surfaces() == lens.load("la1509").to_surfaces()


def test_what_cannot_be_saved_leaves_the_old_file_whole(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    lens.save(lens.load("la1509"), path)
    before = path.read_bytes()
    geo = lens.load("cooke-triplet")
    with pytest.raises(DomainError, match="surface 1: thickness -1"):
        lens.save(geo.replace(thickness_mm=-torch.ones_like(geo.thickness_mm)), path)
    with pytest.raises(DomainError, match="surface 1: radius nan"):
        lens.save(geo.replace(curvature_per_mm=geo.curvature_per_mm.detach() * float("nan")), path)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(FileFormatError, match=r"cannot write.*No space left on device"):
        lens.save(geo, path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss", "la1509"])
def test_a_zmx_file_reads_back_to_the_last_digit_or_two(name, tmp_path):
    before = lens.load(name)
    lens.save(before, tmp_path / "a.zmx")
    after = lens.load(tmp_path / "a.zmx")
    for old, new in zip(before.to_surfaces(), after.to_surfaces(), strict=True):
        same_in_zmx(old, new)
        assert (new.medium and new.medium.name) == (old.medium and old.medium.name)
    for wavelength_um in lens.WAVELENGTH_UM.values():
        close(after.index(wavelength_um), before.index(wavelength_um), atol=1e-8)
    assert [getattr(after, fact) for fact in FACTS] == [getattr(before, fact) for fact in FACTS]


def same_in_zmx(old, new):
    # the radius passes through its reciprocal
    close(new.radius_mm, old.radius_mm, 3e-16)
    assert new.asphere[: len(old.asphere)] == old.asphere
    assert not any(new.asphere[len(old.asphere) :])
    for name in ("thickness_mm", "semi_aperture_mm", "conic", "mirror", "inner_semi_aperture_mm"):
        assert getattr(new, name) == getattr(old, name), name


def test_all_a_zmx_file_can_hold_is_written(tmp_path):
    model = Glass.from_abbe(1.6123, 44.1)
    surfaces = [
        Surface(31.7, 5.1, model, 9.0, -0.7, (1e-4, -2.2e-6), is_stop=True),
        Surface(-180.3, 21.0, None, 9.0, conic=-1.1, mirror=True, inner_semi_aperture_mm=1.25),
        Surface(250.0, 3.0, Glass.named("F2"), 9.0, asphere=(0.0, 1e-7)),
        Surface(PLANE, 21.0, None, 9.0),
    ]
    before = GeoLens(surfaces, 9.5, name="Öl", half_field_deg=1.5)
    lens.save(before, tmp_path / "a.zmx")
    content = (tmp_path / "a.zmx").read_text()
    flint = Glass.named("F2")
    # the axis is folded again
    for line in (
        "DISZ -21.0",
        "GLAS ___BLANK 1 0 1.6123",
        f"GLAS F2 0 0 {flint.index_d!r} {flint.abbe_number!r} ",
    ):
        assert line in content
    assert "GCAT SCHOTT\n" in content
    after = lens.load(tmp_path / "a.zmx")
    for old, new in zip(surfaces, after.to_surfaces(), strict=True):
        same_in_zmx(old, new)
    assert (after.stop_index, after.to_surfaces()[2].medium) == (0, flint)
    # of the model glass, nd and Vd are kept
    close(after.index(0.65), before.index(0.65), atol=2e-5)


def written(folder, *media):
    surfaces = [Surface(50.0, 2.0, medium, 5.0) for medium in media]
    lens.save(GeoLens([*surfaces, Surface(-50.0, 40.0, None, 5.0)], 5.0), folder / "a.zmx")
    return (folder / "a.zmx").read_text()


def test_catalogues_are_those_of_the_glasses(tmp_path):
    content = written(tmp_path, *map(Glass.named, ("S-LAH65", "N-BK7", "F-SILICA", "N-SK16")))
    assert "GCAT OHARA SCHOTT\n" in content
    # its name differs by program
    assert f"GLAS ___BLANK 1 0 {Glass.named('F-SILICA').index_d!r} " in content
    assert "GCAT" not in written(tmp_path, Glass.from_abbe(1.6, 50.0))


def test_what_a_zmx_file_cannot_hold_goes_into_json(tmp_path):
    """It is refused in refusals.txt."""
    rare = {"asphere": (0.0,) * 8 + (1e-20,), "phase": Phase((-1.0,)), "tilt_deg": (1.0, 0.0)}
    infrared = Glass("GE-LIKE", "sellmeier", (15.0, 0.2), (2.0, 12.0))
    flat = Surface(-60.0, 4.0, Glass.from_indices(1.5, 1.5, 1.5, "flat"), 5.0)
    faces = [Surface(50.0, 4.0, infrared, 5.0, **rare), flat, Surface(60.0, 40.0, None, 5.0)]
    geo = GeoLens(faces, 5.0)
    lens.save(geo, tmp_path / "a.json")
    assert lens.load(tmp_path / "a.json").to_surfaces() == geo.to_surfaces()
