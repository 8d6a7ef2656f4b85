"""What lens files say: closed forms of first-order optics, the facts of files.txt, encodings,
units, folded axes."""

import codecs
import math

import numpy as np
import pytest

from codesign.lens import Glass, Surface
from codesign.lens.surface import Phase
from tests.lens.systems import FACTS, FILES, close, efl, load_file

CROWN = Glass.named("N-BK7")
N = CROWN.index_d
SINGLET = (Surface(50.0, 4.0, CROWN, 8.0, is_stop=True), Surface(-100.0, 60.0, None, 7.0))

# many of these lenses are made up
pytestmark = pytest.mark.filterwarnings("ignore:the stop, .* cuts the beam")


def thick(c1, c2, t, n=N):
    """Focal length of a thick lens in air (Smith, Modern Optical Engineering, ch. 3)."""
    return 1 / ((n - 1) * (c1 - c2 + (n - 1) * t * c1 * c2 / n))


# paraxial system matrix of the singlet from first to last vertex, by products of matrices
THROUGH = np.array([[1, 4 / N], [0, 1]])
MATRIX = (
    np.array([[1, 0], [-0.01 * (N - 1), 1]]) @ THROUGH @ np.array([[1, 0], [-0.02 * (N - 1), 1]])
)
# angles of 3 and 4 degrees in x and y are slopes there
BOTH = math.degrees(math.atan(math.hypot(math.tan(math.radians(3)), math.tan(math.radians(4)))))
NAMES = vars(math) | globals() | {"Glass": Glass, "Phase": Phase, "BK7": Glass.named("BK7")}


def near(value, rel=1e-12):
    return pytest.approx(value, rel=rel, abs=0)


@pytest.mark.parametrize(("kind", "exchanges", "fact"), FACTS)
def test_a_lens_has_what_its_file_says(kind, exchanges, fact, tmp_path):
    geo = load_file(tmp_path, kind, exchanges)
    names = {"geo": geo, "faces": geo.to_surfaces(), "efl": efl(geo), "near": near}
    assert eval(fact, NAMES | names)


def test_the_name_counts_where_the_first_catalogue_is_its_makers(tmp_path):
    line = r"MODE SEQ => MODE SEQ\nGCAT SCHOTT ;; N-BK7 0 0 1.5 40 => N-BK7 0 0 1.9 20"
    with pytest.warns(UserWarning, match=r"nd 1.51680 .* says 1.9 and 20, .* the name counts"):
        assert load_file(tmp_path, "zmx", line).to_surfaces() == SINGLET


@pytest.mark.parametrize(("kind", "name"), [("zmx", "a singlet"), ("seq", "a; singlet!")])
def test_a_singlet_is_what_the_lensmaker_says(kind, name, tmp_path):
    geo = load_file(tmp_path, kind)
    close(efl(geo), thick(0.02, -0.01, 4), 1e-14)
    assert (geo.name, geo.entrance_pupil_diameter_mm) == (name, 10)
    assert geo.to_surfaces() == SINGLET


@pytest.mark.parametrize(
    "encode",
    [
        lambda t: codecs.BOM_UTF16_LE + t.encode("utf-16-le"),
        lambda t: codecs.BOM_UTF16_BE + t.encode("utf-16-be"),
        lambda t: t.encode("utf-16-le"),
        lambda t: codecs.BOM_UTF8 + t.encode("utf-8"),
        lambda t: t.encode("latin-1"),
        lambda t: t.replace("\n", "\r\n").encode("utf-8"),
        lambda t: t.replace("\n", "\r").encode("latin-1"),
    ],
)
def test_every_encoding_reads_the_same(encode, tmp_path):
    geo = load_file(
        tmp_path, "zmx", content=encode(FILES["zmx"].replace("a singlet", "Ø 16 singlet"))
    )
    assert (geo.name, geo.to_surfaces()) == ("Ø 16 singlet", SINGLET)


ASPHERE = r"STOP\n  TYPE STANDARD => STOP\nTYPE EVENASPH\nPARM 1 0.001\nPARM 2 -2e-5"
DOE = r"CIR 8 => CIR 8\nASP\nA 1e-6\nDIF DOE\nHWL 550\nHCT R\nHCO C1 -1e-4; HCO C2 1e-9"


@pytest.mark.parametrize(
    ("kind", "unit", "shape", "unit_mm"),
    [
        ("zmx", f"UNIT MM => UNIT {name}", ASPHERE, mm)
        for name, mm in (("CM", 10), ("IN", 25.4), ("M", 1000))
    ]
    + [
        ("seq", f"DIM M => DIM {name}", DOE, mm)
        for name, mm in (("C", 10), ("I", 25.4), ("in", 25.4))
    ],
)
def test_units_become_millimetres(kind, unit, shape, unit_mm, tmp_path):
    geo = load_file(tmp_path, kind, f"{unit} ;; {shape}")
    same = load_file(tmp_path, kind, shape)
    # the path a phase adds is a length, so that its power scales like that of a curvature
    close(efl(geo), efl(same) * unit_mm, 1e-12)
    for name in ("curvature_per_mm", "thickness_mm", "asphere", "semi_aperture_mm"):
        if not (kind == "seq" and name == "semi_aperture_mm"):
            found, true = (getattr(g, name)[..., :2] for g in (geo, same.scaled(unit_mm)))
            close(found, true, 1e-13)


def test_a_pupil_that_the_stop_cuts_is_told(tmp_path):
    with pytest.warns(
        UserWarning, match="the stop, 16 mm wide, .* an entrance pupil of 40 mm needs 40 mm"
    ):
        load_file(tmp_path, "zmx", "ENPD 10 => ENPD 40")


@pytest.mark.parametrize("spec", ["ENPD 10", "FNUM 5 0", "FNUM 5 1", "FLOA"])
@pytest.mark.parametrize("distance", [math.inf, 200.0])
@pytest.mark.parametrize("stop", [1, 2])
def test_the_pupil_follows_from_any_way_to_give_it(spec, distance, stop, tmp_path):
    behind = r" ;; STOP\n => ;; SURF 2 => SURF 2\nSTOP" if stop == 2 else ""
    far = "" if math.isinf(distance) else f" ;; DISZ INFINITY => DISZ {distance}"
    geo = load_file(tmp_path, "zmx", f"ENPD 10 => {spec}{far}{behind}")
    (_, _), (c, d) = MATRIX
    height, slope = (1.0, 0.0) if stop == 1 else (1 - 4 / N * (N - 1) * 0.02, 4 / N)
    if spec == "ENPD 10":
        true = 10
    elif spec == "FLOA":
        true = 2 * (8 if stop == 1 else 7) / height
    elif spec == "FNUM 5 0" or math.isinf(distance):
        true = -1 / c / 5
    else:
        # a ray from the object's centre that leaves with slope 1 / (2 N)
        true = 2 * abs(0.1 / (c * distance + d) * (distance + slope / height))
    close(geo.entrance_pupil_diameter_mm, true, 1e-12)


def test_an_object_without_a_thickness_touches_the_first_surface(tmp_path):
    behind = r" ;; STOP\n => ;; SURF 2 => SURF 2\nSTOP"
    geo = load_file(tmp_path, "zmx", f"ENPD 10 => FNUM 5 1 ;; DISZ INFINITY => COMM none{behind}")
    (_, _), (_, d) = MATRIX
    height, slope = 1 - 4 / N * (N - 1) * 0.02, 4 / N
    close(geo.entrance_pupil_diameter_mm, 2 * abs(0.1 / d * slope / height), 1e-12)
