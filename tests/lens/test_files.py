"""Lens files: exact round trips, and one sentence for everything a file can have wrong."""

import json
import os

import pytest
import torch

from codesign import lens
from codesign.errors import CodesignError, DomainError, FileFormatError
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.surface import Phase


def page(**changes):
    surfaces = [
        {"radius_mm": 50.0, "thickness_mm": 3.0, "medium": "N-BK7", "semi_aperture_mm": 5.0},
        {"radius_mm": None, "thickness_mm": 40.0, "medium": None, "semi_aperture_mm": 5.0},
    ]
    return {
        "schema": "codesign-lens/1",
        "name": "test",
        "entrance_pupil_diameter_mm": 8.0,
        "surfaces": surfaces,
        **changes,
    }


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
        Surface(
            31.7,
            5.1,
            Glass.from_indices(1.61, 1.6, 1.595, "mine"),
            9.0,
            conic=-0.7,
            asphere=(1e-4, -2.2e-6),
            is_stop=True,
        ),
        Surface(-50.3, 0.1, None, 9.0),
        Surface(float("inf"), 2.0, Glass.named("F2"), 8.0, asphere=(0.0, 1e-7, 3e-9)),
        Surface(-44.4, 41.0, None, 8.0, conic=0.3),
    ]
    return GeoLens(surfaces, 9.5, soft_edge_mm=0.15, name="special")


def rare_lens():
    """A lens with everything only the newer schema holds."""
    surfaces = [
        Surface(
            31.7,
            5.1,
            Glass.from_abbe(1.6123, 44.1),
            9.0,
            is_stop=True,
            phase=Phase((-3.3, 0.01), order=2, blaze_um=0.55),
        ),
        Surface(-250.0, 20.0, None, 9.0, inner_semi_aperture_mm=1.25),
        Surface(
            -180.3, 21.0, None, 9.0, conic=-1.1, mirror=True, decentre_mm=(0.1, -0.2), tilt_deg=(0.3, 1 / 3)
        ),
    ]
    return GeoLens(surfaces, 9.5, soft_edge_mm=0.15, name="rare", half_field_deg=12.3)


@pytest.mark.parametrize(
    "make",
    [
        special_lens,
        rare_lens,
        lambda: lens.load("cooke-triplet"),
        lambda: lens.load("double-gauss"),
        lambda: lens.load("la1509").scaled(0.37),
    ],
)
def test_a_round_trip_is_exact(make, tmp_path):
    before = make()
    lens.save(before, tmp_path / "a.json")
    after = lens.load(tmp_path / "a.json")
    for name, value in before.state_dict().items():
        assert torch.equal(after.state_dict()[name], value), name
    assert after.to_surfaces() == before.to_surfaces()
    for name in ("name", "stop_index", "soft_edge_mm", "entrance_pupil_diameter_mm", "half_field_deg"):
        assert getattr(after, name) == getattr(before, name), name
    for wavelength_um in (0.45, 0.5876, 0.7):
        assert torch.equal(after.index(wavelength_um), before.index(wavelength_um))
    lens.save(after, tmp_path / "b.json")
    assert (tmp_path / "b.json").read_bytes() == (tmp_path / "a.json").read_bytes()


def test_changed_values_are_what_is_saved(tmp_path, generator):
    geo = special_lens()
    changed = geo.replace(
        curvature_per_mm=geo.curvature_per_mm * 1.1,
        thickness_mm=geo.thickness_mm + 0.01,
        index_offset=torch.tensor([0.01, 0, -0.02, 0], dtype=torch.float64),
    )
    lens.save(changed, tmp_path / "a.json")
    after = lens.load(tmp_path / "a.json")
    rays = (
        torch.tensor([[1.0, 2.0, -5.0], [-3.0, 0.5, -5.0]], dtype=torch.float64),
        torch.tensor([[0.0, 0.0, 1.0]] * 2, dtype=torch.float64),
    )
    # 1 / (1 / c) may differ from c in the last bit
    torch.testing.assert_close(
        after.trace(*rays).position_mm, changed.trace(*rays).position_mm, rtol=0, atol=1e-13
    )


BAD = {
    "not json": ("{", "not readable JSON"),
    "not text": ("\x00\x01", "not text"),
    "a list": ([1, 2], '"schema" must be "codesign-lens/1" or "codesign-lens/2"'),
    "wrong schema": (page(schema="other/2"), '"schema" must be'),
    "no surfaces": (page(surfaces=[]), "add at least one"),
    "surfaces missing": ({k: v for k, v in page().items() if k != "surfaces"}, "add at least one"),
    "too many surfaces": (page(surfaces=page()["surfaces"] * 251), "1 to 500 surfaces"),
    "surface is a number": (page(surfaces=[3]), "surface 1"),
    "surface is a list": (page(surfaces=[[1, 2]]), "surface 1"),
    "radius missing": (page(surfaces=[{"thickness_mm": 1.0}]), "surface 1.*'radius_mm' is missing"),
    "radius a string": (with_surface(radius_mm="50"), "radius_mm is '50', a number is needed"),
    "radius zero": (with_surface(radius_mm=0.0), "radius 0.0 mm"),
    "radius NaN": (with_surface(radius_mm=float("nan")), "surface 1: radius_mm is nan, a finite number"),
    "thickness negative": (with_surface(thickness_mm=-1.5), "thickness -1.5 mm is negative"),
    "thickness infinite": (
        with_surface(thickness_mm=float("inf")),
        "surface 1: thickness_mm is inf, a finite number",
    ),
    "thickness true": (with_surface(thickness_mm=True), "thickness_mm is 'True'"),
    "thickness a list": (with_surface(thickness_mm=[[1]]), "thickness_mm is"),
    "number too large": (json.dumps(page()).replace("50.0", "1" + "0" * 400), "a finite number is needed"),
    "number of 5000 digits": (json.dumps(page()).replace("50.0", "1" * 5000), "not readable JSON"),
    "aperture beyond the radius": (
        with_surface(radius_mm=4.0),
        "semi-aperture 5.0 mm exceeds what radius 4.0 mm",
    ),
    "aperture beyond the conic": (with_surface(conic=120.0), "conic 120.0 reach"),
    "aperture zero": (with_surface(semi_aperture_mm=0), "semi-aperture 0.0 mm must be positive"),
    "glass unknown": (with_surface(medium="UNOBTAINIUM"), "glass 'UNOBTAINIUM' is not in the catalogue"),
    "glass a number": (with_surface(medium=1.5), "surface 1"),
    "glass without C": (with_surface(medium={"F": 1.5, "d": 1.5}), "surface 1.*'C' is missing"),
    "glass below one": (with_surface(medium={"F": 0.9, "d": 0.9, "C": 0.9}), r"must lie in \[1, 5\)"),
    "asphere a number": (with_surface(asphere=1e-4), "a list of at most 16 numbers"),
    "asphere of strings": (with_surface(asphere=["x"]), "asphere is 'x'"),
    "asphere too long": (with_surface(asphere=[0.0] * 17), "at most 16"),
    "asphere NaN": (with_surface(asphere=[float("nan")]), "asphere is nan, a finite number"),
    "stop a string": (with_surface(is_stop="false"), "is_stop is 'false', true or false is needed"),
    "two stops": (page(surfaces=[{**s, "is_stop": True} for s in page()["surfaces"]]), "mark one"),
    "pupil missing": (
        {k: v for k, v in page().items() if k != "entrance_pupil_diameter_mm"},
        "'entrance_pupil_diameter_mm' is missing",
    ),
    "pupil negative": (page(entrance_pupil_diameter_mm=-1), "entrance pupil diameter -1.0 mm"),
    "pupil infinite": (page(entrance_pupil_diameter_mm=float("inf")), "entrance pupil diameter inf mm"),
    "soft edge NaN": (page(soft_edge_mm=float("nan")), "soft_edge_mm is nan, a finite number"),
    "a key twice": (json.dumps(page())[:-1] + ', "name": "again"}', "the key 'name' comes twice"),
    "nested too deep for a lens": (
        page(name=[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[[]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]]),
        "nests deeper than 30",
    ),
    "an unknown field": (with_surface(toroid=3.0), "surface 1: the field 'toroid' is not understood"),
    "an unknown field of the lens": (page(zoom=2), "the field 'zoom' is not understood"),
    "mirror a number": (with_surface(mirror=1), "mirror is '1', true or false"),
    "phase a list": (with_surface(phase=[1.0]), "phase is"),
    "phase empty": (with_surface(phase={"coefficients": []}), "needs finite coefficients"),
    "order a fraction": (
        with_surface(phase={"coefficients": [-3.0], "order": 1.5}),
        "order is '1.5', a whole number",
    ),
    "order huge": (with_surface(phase={"coefficients": [-3.0], "order": 10**300}), "a whole number"),
    "decentre of one number": (with_surface(decentre_mm=[1.0]), "decentre_mm has 1 numbers, two"),
    "obstruction too large": (with_surface(inner_semi_aperture_mm=6.0), "central obstruction of 6.0 mm"),
    "half field of 90 degrees": (page(half_field_deg=90.0), "half field 90.0 degrees"),
    "glass of an unknown model": (
        with_surface(
            medium={"name": "x", "model": "herzberger", "coefficients": [1.5], "range_um": [0.4, 0.7]}
        ),
        "model 'herzberger' is not known",
    ),
    "soft edge negative": (page(soft_edge_mm=-0.1), "soft edge -0.1 mm"),
    "deeply nested": ("[" * 100_000 + "]" * 100_000, "not readable JSON"),
    "huge": (" " * 2_000_001, "2000001 bytes, more than the 2000000"),
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
    with pytest.raises(FileFormatError, match="not a regular file"):
        lens.load(tmp_path / "folder.json")
    (tmp_path / "lens.doc").write_text("{}")
    with pytest.raises(FileFormatError, match=r"'\.doc' is not read; give \.json, \.zmx, \.seq, \.txt"):
        lens.load(tmp_path / "lens.doc")
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
    with pytest.raises(FileFormatError, match=r"cannot write.*No space left on device"):
        lens.save(geo, path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_a_place_that_is_not_there_or_is_a_folder_is_refused(tmp_path):
    with pytest.raises(FileFormatError, match=r"cannot write .*json"):
        lens.save(lens.load("la1509"), tmp_path / "missing" / "a.json")
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(FileFormatError, match=r"cannot write .*json"):
        lens.save(lens.load("la1509"), tmp_path / "folder.json")
    assert [p.name for p in tmp_path.iterdir()] == ["folder.json"]
