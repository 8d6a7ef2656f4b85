"""Reading the lens files of three ray tracers: what each column means."""

import math

import pytest

from codesign.lens import Glass, Surface
from tests.lens.file_case import load
from tests.lens.systems import efl

BK7 = Glass.named("BK7")


def test_a_deeplens_file(tmp_path):
    geo = load(tmp_path, "deeplens")
    assert geo.to_surfaces() == (
        Surface(50.0, 4.0, BK7, 6.0),
        Surface(-100.0, 2.0, None, 6.0, -0.5, (0.0, 1e-6)),
        Surface(math.inf, 58.0, None, 4.0, is_stop=True),
    )
    # the stop sets the pupil, not the header
    assert geo.first_order().stop_semi_aperture_mm.item() == pytest.approx(4.0, rel=1e-13)
    assert geo.name == "a singlet"


@pytest.mark.parametrize(
    ("fields", "terms"),
    [
        ("[1e-3, 2e-6]", (1e-3, 2e-6)),
        ('[1e-3, 2e-6], "ai2": 1e-3, "ai4": 2e-6', (1e-3, 2e-6)),
        # a list that begins at r^4
        ('[2e-6, 3e-9], "ai2": 0.0, "ai4": 2e-6, "ai6": 3e-9', (0.0, 2e-6, 3e-9)),
        ('[2e-6, 3e-9], "ai4": 2e-6, "ai6": 3e-9', (0.0, 2e-6, 3e-9)),
        ('null, "ai4": 2e-6', (0.0, 2e-6)),
    ],
)
def test_where_the_asphere_of_a_deeplens_file_begins(fields, terms, tmp_path):
    assert load(tmp_path, "deeplens", f"[0.0, 1e-06] => {fields}").to_surfaces()[1].asphere == terms


def test_without_a_stop_the_smallest_surface_is_the_stop(tmp_path):
    smaller = '"Aperture" => "Plane" ;; "Aspheric", "r": 6.0 => "Aspheric", "r": 5.0'
    assert load(tmp_path, "deeplens", smaller).stop_index == 2
    assert load(tmp_path, "deeplens", f'{smaller} ;; "r": 4.0 => "r": 5.0').stop_index == 1
    assert load(tmp_path, "table", "A 1.0 => S 1.0 ;; 12.0 VACUUM => 7.0 VACUUM").stop_index == 2


def test_an_optiland_file(tmp_path):
    geo = load(tmp_path, "optiland")
    front, back = geo.to_surfaces()
    assert front == Surface(50.0, 4.0, Glass.from_abbe(1.6123, 44.1), 8.0, -0.5, is_stop=True)
    assert (back.radius_mm, back.thickness_mm, back.medium, back.asphere) == (-100, 60, None, (1e-4, 1e-7))
    assert (geo.entrance_pupil_diameter_mm, geo.half_field_deg) == (10, 5)


@pytest.mark.parametrize(
    ("kind", "height", "half_field"),
    [
        ("AngleField", 5.0, lambda f: 5.0),
        ("ObjectHeightField", 5.0, lambda f: math.degrees(math.atan(5.0 / 200.0))),
        ("ParaxialImageHeightField", 4.0, lambda f: math.degrees(math.atan(4.0 / f))),
        ("RealImageHeightField", 4.0, lambda f: math.degrees(math.atan(4.0 / f))),
    ],
)
def test_fields_as_version_0_6_writes_them(kind, height, half_field, tmp_path):
    plain = '"field_type": "angle", "x" => "x" ;; "field_type": "angle", "x": 3.0, "y": 4 => "y": {}'
    definition = f'"field_type": "angle"}} => "field_definition": {{"field_type": "{kind}"}}}}'
    geo = load(tmp_path, "optiland", f"{plain.format(height)} ;; {definition} ;; -Infinity => -200.0")
    assert geo.half_field_deg == pytest.approx(half_field(efl(geo)), rel=1e-12)


def test_a_medium_without_dispersion_holds_at_any_wavelength(tmp_path):
    ideal = 'AbbeMaterial => IdealMaterial ;; "index": 1.6123 => "index": 4.002'
    assert load(tmp_path, "optiland", ideal).index(10.6).tolist() == [1, 4.002, 1]


@pytest.mark.parametrize(
    ("pupil", "true"),
    [
        ('"EPD", "value": 10 => "imageFNO", "value": 5', lambda f: f / 5),
        ('"EPD", "value": 10 => "float_by_stop_size", "value": 12', lambda f: 12.0),
    ],
)
def test_the_pupil_of_an_optiland_file(pupil, true, tmp_path):
    geo = load(tmp_path, "optiland", pupil)
    assert geo.entrance_pupil_diameter_mm == pytest.approx(true(efl(geo)), rel=1e-12)


@pytest.mark.parametrize(
    "spelling",
    [
        '"is_reflective": true }',
        '"interaction_model": {"type": "RefractiveReflectiveModel", "is_reflective": true} }',
    ],
)
def test_mirrors_of_an_optiland_file_are_unfolded(spelling, tmp_path):
    air = 'AbbeMaterial => IdealMaterial ;; "index": 1.6123 => "index": 1.0'
    geo = load(tmp_path, "optiland", f'{air} ;; "is_reflective": false }} => {spelling} ;; 64.0 => -46.0')
    mirror = geo.to_surfaces()[1]
    assert (mirror.mirror, mirror.radius_mm, mirror.thickness_mm, mirror.medium) == (True, -100, 50, None)


def test_a_table(tmp_path):
    geo = load(tmp_path, "table")
    assert geo.to_surfaces() == (
        Surface(50.0, 4.0, Glass.named("N-BK7"), 6.0, -0.5, (0.0, 1e-6, 2e-9)),
        Surface(math.inf, 2.0, Glass.from_abbe(1.6123, 44.1, "1.6123/44.1"), 6.0),
        Surface(-100.0, 1.0, None, 6.0),
        Surface(math.inf, 57.0, None, 4.0, is_stop=True),
    )
    assert geo.first_order().stop_semi_aperture_mm.item() == pytest.approx(4.0, rel=1e-13)
    assert geo.name == "a singlet"
