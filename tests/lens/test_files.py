"""Lens files: exact round trips, and one sentence for everything a file can have wrong."""

import json
import os

import pytest
import torch

from codesign import lens
from codesign.errors import CodesignError, DomainError, FileFormatError
from codesign.lens import GeoLens, Glass, Surface


def page(**changes):
    surfaces = [
        {"radius_mm": 50.0, "thickness_mm": 3.0, "medium": "N-BK7", "semi_aperture_mm": 5.0},
        {"radius_mm": None, "thickness_mm": 40.0, "medium": None, "semi_aperture_mm": 5.0},
    ]
    return {"schema": "codesign-lens/1", "name": "test", "entrance_pupil_diameter_mm": 8.0, "surfaces": surfaces, **changes}


def with_surface(**changes):
    made = page()
    made["surfaces"][0].update(changes)
    return made


def write(folder, content):
    path = folder / "lens.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def special_lens():
    surfaces = [
        Surface(31.7, 5.1, Glass.from_indices(1.61, 1.6, 1.595, "mine"), 9.0, conic=-0.7, asphere=(1e-4, -2.2e-6), is_stop=True),
        Surface(-50.3, 0.1, None, 9.0),
        Surface(float("inf"), 2.0, Glass.named("F2"), 8.0, asphere=(0.0, 1e-7, 3e-9)),
        Surface(-44.4, 41.0, None, 8.0, conic=0.3),
    ]
    return GeoLens(surfaces, 9.5, soft_edge_mm=0.15, name="special")


@pytest.mark.parametrize("make", [special_lens, lambda: lens.load("cooke-triplet"), lambda: lens.load("double-gauss"), lambda: lens.load("la1509").scaled(0.37)])
def test_a_round_trip_is_exact(make, tmp_path):
    before = make()
    lens.save(before, tmp_path / "a.json")
    after = lens.load(tmp_path / "a.json")
    for name, value in before.state_dict().items():
        assert torch.equal(after.state_dict()[name], value), name
    assert after.to_surfaces() == before.to_surfaces()
    assert (after.name, after.stop_index, after.soft_edge_mm, after.entrance_pupil_diameter_mm) == (before.name, before.stop_index, before.soft_edge_mm, before.entrance_pupil_diameter_mm)
    for wavelength_um in (0.45, 0.5876, 0.7):
        assert torch.equal(after.index(wavelength_um), before.index(wavelength_um))
    lens.save(after, tmp_path / "b.json")
    assert (tmp_path / "b.json").read_bytes() == (tmp_path / "a.json").read_bytes()


def test_changed_values_are_what_is_saved(tmp_path, generator):
    geo = special_lens()
    changed = geo.replace(curvature_per_mm=geo.curvature_per_mm * 1.1, thickness_mm=geo.thickness_mm + 0.01, index_offset=torch.tensor([0.01, 0, -0.02, 0], dtype=torch.float64))
    lens.save(changed, tmp_path / "a.json")
    after = lens.load(tmp_path / "a.json")
    rays = torch.tensor([[1.0, 2.0, -5.0], [-3.0, 0.5, -5.0]], dtype=torch.float64), torch.tensor([[0.0, 0.0, 1.0]] * 2, dtype=torch.float64)
    # 1 / (1 / c) may differ from c in the last bit
    torch.testing.assert_close(after.trace(*rays).position_mm, changed.trace(*rays).position_mm, rtol=0, atol=1e-13)


BAD = {
    "not json": ("{", "not readable JSON"),
    "not text": ("\x00\x01", "not readable JSON"),
    "a list": ([1, 2], '"schema" must be "codesign-lens/1"'),
    "wrong schema": (page(schema="other/2"), '"schema" must be'),
    "no surfaces": (page(surfaces=[]), "add at least one"),
    "surfaces missing": ({k: v for k, v in page().items() if k != "surfaces"}, "add at least one"),
    "too many surfaces": (page(surfaces=page()["surfaces"] * 101), "1 to 200 surfaces"),
    "surface is a number": (page(surfaces=[3]), "surface 1"),
    "surface is a list": (page(surfaces=[[1, 2]]), "surface 1"),
    "radius missing": (page(surfaces=[{"thickness_mm": 1.0}]), "surface 1.*'radius_mm' is missing"),
    "radius a string": (with_surface(radius_mm="50"), "radius_mm is '50', a number is needed"),
    "radius zero": (with_surface(radius_mm=0.0), "radius 0.0 mm"),
    "radius NaN": (with_surface(radius_mm=float("nan")), "radius nan mm"),
    "thickness negative": (with_surface(thickness_mm=-1.5), "thickness -1.5 mm is negative"),
    "thickness infinite": (with_surface(thickness_mm=float("inf")), "thickness inf mm"),
    "thickness true": (with_surface(thickness_mm=True), "thickness_mm is 'True'"),
    "thickness a list": (with_surface(thickness_mm=[[1]]), "thickness_mm is"),
    "number too large": (json.dumps(page()).replace("50.0", "1" + "0" * 400), "wrong kind"),
    "number of 5000 digits": (json.dumps(page()).replace("50.0", "1" * 5000), "not readable JSON"),
    "aperture beyond the radius": (with_surface(radius_mm=4.0), "semi-aperture 5.0 mm exceeds what radius 4.0 mm"),
    "aperture beyond the conic": (with_surface(conic=120.0), "conic 120.0 reach"),
    "aperture zero": (with_surface(semi_aperture_mm=0), "semi-aperture 0.0 mm must be positive"),
    "glass unknown": (with_surface(medium="UNOBTAINIUM"), "glass 'UNOBTAINIUM' is not in the catalogue"),
    "glass a number": (with_surface(medium=1.5), "surface 1"),
    "glass without C": (with_surface(medium={"F": 1.5, "d": 1.5}), "surface 1.*'C' is missing"),
    "glass below one": (with_surface(medium={"F": 0.9, "d": 0.9, "C": 0.9}), r"must lie in \[1, 5\)"),
    "asphere a number": (with_surface(asphere=1e-4), "a list of at most 16 numbers"),
    "asphere of strings": (with_surface(asphere=["x"]), "asphere is 'x'"),
    "asphere too long": (with_surface(asphere=[0.0] * 17), "at most 16"),
    "asphere NaN": (with_surface(asphere=[float("nan")]), "must be finite"),
    "stop a string": (with_surface(is_stop="false"), "is_stop is 'false', true or false is needed"),
    "two stops": (page(surfaces=[{**s, "is_stop": True} for s in page()["surfaces"]]), "mark one"),
    "pupil missing": ({k: v for k, v in page().items() if k != "entrance_pupil_diameter_mm"}, "'entrance_pupil_diameter_mm' is missing"),
    "pupil negative": (page(entrance_pupil_diameter_mm=-1), "entrance pupil diameter -1.0 mm"),
    "pupil infinite": (page(entrance_pupil_diameter_mm=float("inf")), "entrance pupil diameter inf mm"),
    "soft edge NaN": (page(soft_edge_mm=float("nan")), "soft edge nan mm"),
    "soft edge negative": (page(soft_edge_mm=-0.1), "soft edge -0.1 mm"),
    "deeply nested": ("[" * 100_000 + "]" * 100_000, "not readable JSON"),
    "huge": (" " * 1_000_001, "has 1000001 bytes"),
}


@pytest.mark.parametrize("fault", BAD)
def test_a_malformed_file_gives_one_sentence_naming_file_and_value(fault, tmp_path):
    content, sentence = BAD[fault]
    path = write(tmp_path, content)
    with pytest.raises(CodesignError, match=sentence) as caught:
        lens.load(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 600


def test_the_good_page_behind_the_bad_ones_loads(tmp_path):
    geo = lens.load(write(tmp_path, page()))
    assert geo.curvature_per_mm.tolist() == [1 / 50.0, 0.0]
    assert [s.medium.name if s.medium else None for s in geo.to_surfaces()] == ["N-BK7", None]


@pytest.mark.parametrize("name", ["nowhere.json", "cook-triplet", "x" * 5000, "a\x00b.json"])
def test_what_is_neither_file_nor_name_lists_the_names(name):
    with pytest.raises(FileFormatError, match="known names: cooke-triplet, double-gauss, la1509"):
        lens.load(name)


def test_folders_and_other_extensions_are_refused(tmp_path):
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(FileFormatError, match="not readable JSON"):
        lens.load(tmp_path / "folder.json")
    (tmp_path / "lens.txt").write_text("{}")
    with pytest.raises(FileFormatError, match=r"'\.txt' is not read"):
        lens.load(tmp_path / "lens.txt")
    with pytest.raises(FileFormatError, match=r"'\.txt' is not written"):
        lens.save(lens.load("la1509"), tmp_path / "lens.txt")


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
    with pytest.raises(FileFormatError, match=r"No space left on device.*choose a folder"):
        lens.save(geo, path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_a_place_that_is_not_there_or_is_a_folder_is_refused(tmp_path):
    with pytest.raises(FileFormatError, match="cannot be written"):
        lens.save(lens.load("la1509"), tmp_path / "missing" / "a.json")
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(FileFormatError, match="cannot be written"):
        lens.save(lens.load("la1509"), tmp_path / "folder.json")
    assert [p.name for p in tmp_path.iterdir()] == ["folder.json"]
