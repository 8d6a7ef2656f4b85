"""Reading the lens files of three ray tracers: what each column means, and a sentence for what is not
understood."""

import json
import math

import pytest

from codesign import lens
from codesign.errors import CodesignError
from codesign.lens import Glass, Surface

BK7 = Glass.named("BK7")
MODEL = Glass.from_abbe(1.6123, 44.1, "1.6123/44.1")


def write(folder, name, content):
    path = folder / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def deeplens(*changes, **header):
    surfaces = [
        {
            "idx": 1,
            "type": "Spheric",
            "r": 6.0,
            "c": 0.02,
            "roc": 50.0,
            "d": 0.0,
            "mat1": "air",
            "mat2": "bk7",
            "d_next": 4.0,
        },
        {
            "idx": 2,
            "type": "Aspheric",
            "r": 6.0,
            "roc": -100.0,
            "(c)": -0.01,
            "d": 4.0,
            "k": -0.5,
            "ai": [0.0, 1e-6],
            "mat1": "bk7",
            "mat2": "air",
            "d_next": 2.0,
        },
        {
            "idx": 3,
            "type": "Aperture",
            "r": 4.0,
            "d": 6.0,
            "is_square": False,
            "diffraction": False,
            "d_next": 58.0,
        },
    ]
    for at, change in changes:
        surfaces[at].update(change)
    return {
        "info": "a singlet",
        "foclen": 1.0,
        "fnum": 1.0,
        "r_sensor": 10.0,
        "d_sensor": 64.0,
        "sensor_size": [1, 1],
        "surfaces": surfaces,
        **header,
    }


def test_a_deeplens_file(tmp_path):
    geo = lens.load(write(tmp_path, "lens.json", deeplens()))
    assert geo.to_surfaces() == (
        Surface(50.0, 4.0, BK7, 6.0),
        Surface(-100.0, 2.0, None, 6.0, -0.5, (0.0, 1e-6)),
        Surface(math.inf, 58.0, None, 4.0, is_stop=True),
    )
    f = geo.first_order()
    assert f.stop_semi_aperture_mm.item() == pytest.approx(
        4.0, rel=1e-13
    )  # the stop sets the pupil, not the header
    assert geo.name == "a singlet"


@pytest.mark.parametrize(
    ("fields", "terms"),
    [
        ({"ai": [1e-3, 2e-6]}, (1e-3, 2e-6)),
        ({"ai": [1e-3, 2e-6], "ai2": 1e-3, "ai4": 2e-6}, (1e-3, 2e-6)),
        (
            {"ai": [2e-6, 3e-9], "ai2": 0.0, "ai4": 2e-6, "ai6": 3e-9},
            (0.0, 2e-6, 3e-9),
        ),  # a list that begins at r^4
        ({"ai": [2e-6, 3e-9], "ai4": 2e-6, "ai6": 3e-9}, (0.0, 2e-6, 3e-9)),
        ({"ai": None, "ai4": 2e-6}, (0.0, 2e-6)),
    ],
)
def test_where_the_asphere_of_a_deeplens_file_begins(fields, terms, tmp_path):
    assert lens.load(write(tmp_path, "lens.json", deeplens((1, fields)))).to_surfaces()[1].asphere == terms


def test_without_a_stop_the_smallest_surface_of_a_deeplens_file_is_the_stop(tmp_path):
    page = deeplens((1, {"r": 5.0}), (2, {"type": "Plane"}))
    assert lens.load(write(tmp_path, "lens.json", page)).stop_index == 2
    page["surfaces"][2]["r"] = 5.0
    assert lens.load(write(tmp_path, "lens.json", page)).stop_index == 1


def axes(z, **changes):
    return {"x": 0.0, "y": 0.0, "z": z, "rx": 0.0, "ry": 0.0, "rz": 0.0, "reference_cs": None, **changes}


def optiland(*changes, pupil=None, **page):
    air = {"type": "IdealMaterial", "index": 1.0, "absorp": 0.0}
    glass = {"type": "AbbeMaterial", "index": 1.6123, "abbe": 44.1}
    surfaces = [
        {
            "type": "ObjectSurface",
            "geometry": {"type": "Plane", "cs": axes(-math.inf), "radius": math.inf},
            "material_post": air,
        },
        {
            "type": "Surface",
            "geometry": {"type": "StandardGeometry", "cs": axes(0.0), "radius": 50.0, "conic": -0.5},
            "material_pre": air,
            "material_post": glass,
            "is_stop": True,
            "aperture": {"type": "RadialAperture", "r_max": 8.0, "r_min": 0.0},
            "coating": None,
            "bsdf": None,
            "is_reflective": False,
        },
        {
            "type": "Surface",
            "geometry": {
                "type": "EvenAsphere",
                "cs": axes(4.0),
                "radius": -100.0,
                "conic": 0.0,
                "tol": 1e-10,
                "max_iter": 100,
                "coefficients": [1e-4, 1e-7],
            },
            "material_pre": glass,
            "material_post": air,
            "is_stop": False,
            "aperture": None,
            "coating": None,
            "bsdf": None,
            "is_reflective": False,
        },
        {
            "type": "Surface",
            "geometry": {"type": "Plane", "cs": axes(64.0), "radius": math.inf},
            "material_pre": air,
            "material_post": air,
            "is_stop": False,
            "aperture": None,
            "is_reflective": False,
        },
    ]
    for at, change in changes:
        surfaces[at].update(change)
    return {
        "version": 1.0,
        "aperture": pupil or {"type": "EPD", "value": 10, "object_space_telecentric": False},
        "fields": {
            "fields": [{"field_type": "angle", "x": 0.0, "y": 0}, {"field_type": "angle", "x": 3.0, "y": 4}],
            "telecentric": False,
            "field_type": "angle",
        },
        "wavelengths": {
            "wavelengths": [{"value": 587.5618, "is_primary": True, "unit": "nm"}],
            "polarization": "ignore",
        },
        "pickups": [],
        "solves": {"solves": []},
        "surface_group": {"surfaces": surfaces},
        **page,
    }


def test_an_optiland_file(tmp_path):
    front, back = (geo := lens.load(write(tmp_path, "lens.json", optiland()))).to_surfaces()
    assert (front.radius_mm, front.thickness_mm, front.conic, front.semi_aperture_mm, front.is_stop) == (
        50,
        4,
        -0.5,
        8,
        True,
    )
    assert (back.radius_mm, back.thickness_mm, back.medium, back.asphere) == (-100, 60, None, (1e-4, 1e-7))
    assert (geo.entrance_pupil_diameter_mm, geo.half_field_deg) == (10, 5)
    assert geo.index().tolist() == pytest.approx([1, 1.6123, 1])


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
    fields = {"fields": [{"x": 0.0, "y": 0, "vx": 0.0, "weight": 1.0}, {"x": 0.0, "y": height}]}
    near = {"geometry": {"type": "Plane", "cs": axes(-200.0), "radius": math.inf}}
    page = optiland(
        (0, near), fields=fields | {"telecentric": False, "field_definition": {"field_type": kind}}
    )
    geo = lens.load(write(tmp_path, "lens.json", page))
    assert geo.half_field_deg == pytest.approx(half_field(geo.first_order().efl_mm.item()), rel=1e-12)


def test_a_medium_without_dispersion_holds_at_any_wavelength(tmp_path):
    page = optiland((1, {"material_post": {"type": "IdealMaterial", "index": 4.002}}))
    geo = lens.load(write(tmp_path, "lens.json", page))
    assert geo.index(10.6).tolist() == [1, 4.002, 1]


@pytest.mark.parametrize(
    ("pupil", "true"),
    [
        ({"type": "imageFNO", "value": 5}, lambda f: f / 5),
        ({"type": "float_by_stop_size", "value": 12.0}, lambda f: 12.0),
    ],
)
def test_the_pupil_of_an_optiland_file(pupil, true, tmp_path):
    geo = lens.load(write(tmp_path, "lens.json", optiland(pupil=pupil)))
    assert geo.entrance_pupil_diameter_mm == pytest.approx(true(geo.first_order().efl_mm.item()), rel=1e-12)


@pytest.mark.parametrize(
    "spelling",
    [
        {"is_reflective": True},
        {"interaction_model": {"type": "RefractiveReflectiveModel", "is_reflective": True}},
    ],
)
def test_mirrors_of_an_optiland_file_are_unfolded(spelling, tmp_path):
    page = optiland(
        (1, {"material_post": {"type": "IdealMaterial", "index": 1.0}}),
        (2, spelling),
        (3, {"geometry": {"type": "Plane", "cs": axes(-46.0), "radius": math.inf}}),
    )
    front, mirror = lens.load(write(tmp_path, "lens.json", page)).to_surfaces()
    assert (mirror.mirror, mirror.radius_mm, mirror.thickness_mm, mirror.medium) == (True, -100, 50, None)


TABLE = """a singlet
type distance roc diameter material
O 20 0 100 AIR
S 0.0 50.0 12.0 N-BK7 -0.5 1e-6 2e-9
X 4.0 0.0 12.0 1.6123/44.1 0 0 0
S 2.0 -100.0 12.0 VACUUM
A 1.0 0.0 8.0 OCCLUDER
I 57.0 0.0 20.0 AIR
"""


def test_a_table(tmp_path):
    geo = lens.load(write(tmp_path, "lens.txt", TABLE))
    assert geo.to_surfaces() == (
        Surface(50.0, 4.0, Glass.named("N-BK7"), 6.0, -0.5, (0.0, 1e-6, 2e-9)),
        Surface(math.inf, 2.0, MODEL, 6.0),
        Surface(-100.0, 1.0, None, 6.0),
        Surface(math.inf, 57.0, None, 4.0, is_stop=True),
    )
    assert geo.first_order().stop_semi_aperture_mm.item() == pytest.approx(4.0, rel=1e-13)
    assert geo.name == "a singlet"
    assert (
        lens.load(
            write(tmp_path, "lens.txt", TABLE.replace("A 1.0", "S 1.0").replace("12.0 VACUUM", "7.0 VACUUM"))
        ).stop_index
        == 2
    )  # the smallest


BAD = {
    "deeplens type": (deeplens((0, {"type": "Cubic"})), "surface 1: type Cubic is not read"),
    "deeplens square": (deeplens((2, {"is_square": True})), "surface 3: its aperture is square"),
    "deeplens radius": (deeplens((0, {"roc": 51.0})), "surface 1: c is 0.02 but 1 / roc is 0.0196"),
    "deeplens no shape": (deeplens((1, {"roc": "x"})), "surface 2: roc is 'x', a number is needed"),
    "deeplens conic on a sphere": (deeplens((0, {"k": 1.0})), "make it Aspheric"),
    "deeplens asphere": (
        deeplens((1, {"ai": [1.0, 2.0], "ai6": 5.0})),
        "surface 2: the list ai and the fields",
    ),
    "deeplens asphere of strings": (deeplens((1, {"ai": ["1"]})), "a number is needed"),
    "deeplens two stops": (
        deeplens((0, {"type": "Stop", "c": 0.0, "roc": 0.0})),
        r"surfaces \[1, 3\] are all stops",
    ),
    "deeplens sensor": (
        deeplens(d_sensor=63.0),
        "the sensor lies at 63 mm, but the distances d_next lead to 64 mm",
    ),
    "deeplens place": (deeplens((1, {"d": 4.5})), "surface 2 lies at 4.5 mm"),
    "deeplens front": (
        deeplens((1, {"mat1": "sf5"})),
        "surface 2: mat1 is 'sf5', but the surface before is followed by 'bk7'",
    ),
    "deeplens unknown field": (
        deeplens((1, {"b_spline": [1]})),
        "surface 2: the field 'b_spline' is not understood",
    ),
    "deeplens unknown glass": (
        deeplens((0, {"mat2": "bk77"})),
        "surface 1: glass 'bk77' is not in the catalogue; the nearest names are",
    ),
    "deeplens glass": (deeplens((0, {"mat2": "1.5/x"})), "the Abbe number is 'x'"),
    "deeplens backwards": (
        deeplens((0, {"d_next": -4.0, "d": 0.0}), (1, {"d": -4.0}), (2, {"d": -2.0}), d_sensor=56.0),
        "surface 1: the light would travel 4 mm backwards",
    ),
    "deeplens surface": (
        deeplens() | {"surfaces": [*deeplens()["surfaces"], 3]},
        "surface 4: it is '3', an object",
    ),
    "optiland type": (
        optiland((1, {"type": "ParaxialSurface"})),
        "surface 1: type ParaxialSurface is not read",
    ),
    "optiland geometry": (
        optiland((1, {"geometry": {"type": "ToroidalGeometry", "cs": axes(0.0), "radius": 1.0}})),
        "surface 1: geometry ToroidalGeometry is not read",
    ),
    "optiland tilt": (
        optiland((2, {"geometry": {"type": "Plane", "cs": axes(4.0, rx=0.1), "radius": math.inf}})),
        "surface 2: it is tilted",
    ),
    "optiland nested axes": (
        optiland(
            (2, {"geometry": {"type": "Plane", "cs": axes(4.0, reference_cs=axes(1.0)), "radius": math.inf}})
        ),
        "reference_cs",
    ),
    "optiland NaN": (
        optiland((2, {"geometry": {"type": "Plane", "cs": axes(math.nan), "radius": math.inf}})),
        "surface 2: z is nan, a finite number",
    ),
    "optiland infinite place": (
        optiland((2, {"geometry": {"type": "Plane", "cs": axes(math.inf), "radius": math.inf}})),
        "surface 2: z is inf, a finite number",
    ),
    "optiland infinite conic": (
        optiland(
            (
                1,
                {
                    "geometry": {
                        "type": "StandardGeometry",
                        "cs": axes(0.0),
                        "radius": 50.0,
                        "conic": math.inf,
                    }
                },
            )
        ),
        "conic is inf",
    ),
    "optiland aperture": (optiland((1, {"aperture": {"type": "RectangularAperture"}})), "not a circle"),
    "optiland bsdf": (optiland((1, {"bsdf": {"type": "Lambertian"}})), "the field 'bsdf' is not understood"),
    "optiland grating": (
        optiland((1, {"interaction_model": {"type": "DiffractiveModel"}})),
        "interaction DiffractiveModel is not read",
    ),
    "optiland material": (
        optiland((1, {"material_post": {"type": "GradientMaterial"}})),
        "material GradientMaterial is not read",
    ),
    "optiland pupil": (optiland(pupil={"type": "objectNA", "value": 0.1}), "objectNA.*give it as EPD"),
    "optiland telecentric": (
        optiland(pupil={"type": "EPD", "value": 1, "object_space_telecentric": True}),
        "telecentric",
    ),
    "optiland no stop": (optiland((1, {"is_stop": False})), "mark one with is_stop"),
    "optiland curved image": (
        optiland(
            (3, {"geometry": {"type": "StandardGeometry", "cs": axes(64.0), "radius": 50.0, "conic": 0.0}})
        ),
        "only a flat image plane",
    ),
    "table header": (TABLE.replace("type distance", "kind distance"), "its second line must be"),
    "table column": (
        TABLE.replace("S 2.0 -100.0 12.0 VACUUM", "S 2.0 -100.0 12.0"),
        "line 6: .*fewer than the five columns",
    ),
    "table type": (TABLE.replace("S 2.0", "B 2.0"), "line 6: type B is not read"),
    "table polynomial": (TABLE.replace("44.1 0 0 0", "44.1 0 1e-3 0"), "polynomial in x and y"),
    "table glass": (TABLE.replace("N-BK7", "N-BK77"), "line 4: glass 'N-BK77' is not in the catalogue"),
    "table number": (TABLE.replace("50.0", "5o.0"), "the radius is '5o.0'"),
    "table without image": (TABLE.replace("I 57", "S 57"), "no image"),
    "table after the image": (TABLE + "S 1 0 5 AIR\n", "behind the image"),
    "table two stops": (TABLE.replace("X 4.0", "A 4.0"), "2 stops"),
    "table backwards": (TABLE.replace("S 2.0", "S -2.0"), "surface 2: the light would travel 2 mm backwards"),
    "table negative edge": (TABLE.replace("X 4.0", "X 0.1"), "surface 1: the glass behind it is -"),
    "table too long": (TABLE.replace("S 2.0", "S 0 0 5 AIR\n" * 600 + "S 2.0"), "at most 500 surfaces"),
    "table curved image": (TABLE.replace("I 57.0 0.0", "I 57.0 30.0"), "only a flat image plane"),
    "prose": ("Dear reader,\nthis is a letter.\n\nYours\nA.\n", "not a table of surfaces"),
}


@pytest.mark.parametrize("fault", BAD)
def test_what_is_not_understood_is_refused_by_name(fault, tmp_path):
    content, sentence = BAD[fault]
    path = write(tmp_path, "lens.txt" if isinstance(content, str) else "lens.json", content)
    with pytest.raises(CodesignError, match=sentence) as caught:
        lens.load(path)
    message = str(caught.value)
    assert message.startswith(f"lens file {path}: ")
    assert "\n" not in message
    assert len(message) < 500
