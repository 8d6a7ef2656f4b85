"""Reading .zmx and .seq: closed forms of first-order optics for what the files say."""

import codecs
import math

import numpy as np
import pytest
import torch

from codesign.errors import CodesignError
from codesign.lens import Glass, Surface
from codesign.lens.surface import Phase
from tests.lens.file_case import FILES, load
from tests.lens.systems import efl

CROWN = Glass.named("N-BK7")
N = CROWN.index_d
SINGLET = (Surface(50.0, 4.0, CROWN, 8.0, is_stop=True), Surface(-100.0, 60.0, None, 7.0))
NO_APERTURES = r'DIAM 8 1 0 0 1 ""\n => ;; DIAM 7 1 0 0 1 ""\n =>'


def thick(c1, c2, t, n=N):
    """Focal length of a thick lens in air (Smith, Modern Optical Engineering, ch. 3)."""
    return 1 / ((n - 1) * (c1 - c2 + (n - 1) * t * c1 * c2 / n))


@pytest.mark.parametrize(("kind", "name"), [("zmx", "a singlet"), ("seq", "a; singlet!")])
def test_a_singlet_is_what_the_lensmaker_says(kind, name, tmp_path):
    geo = load(tmp_path, kind)
    assert efl(geo) == pytest.approx(thick(0.02, -0.01, 4), rel=1e-14)
    assert (geo.name, geo.entrance_pupil_diameter_mm) == (name, 10)
    assert geo.half_field_deg == pytest.approx(5)
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
    geo = load(tmp_path, "zmx", content=encode(FILES["zmx"].replace("a singlet", "Ø 16 singlet")))
    assert (geo.name, geo.to_surfaces()) == ("Ø 16 singlet", SINGLET)


ASPHERE = r"STOP\n  TYPE STANDARD => STOP\nTYPE EVENASPH\nPARM 1 0.001\nPARM 2 -2e-5"
DOE = r"CIR 8 => CIR 8\nASP\nA 1e-6\nDIF DOE\nHWL 550\nHCT R\nHCO C1 -1e-4; HCO C2 1e-9"


@pytest.mark.parametrize(
    ("kind", "unit", "shape", "unit_mm"),
    [("zmx", f"UNIT MM => UNIT {name}", ASPHERE, mm) for name, mm in (("CM", 10), ("IN", 25.4), ("M", 1000))]
    + [("seq", f"DIM M => DIM {name}", DOE, mm) for name, mm in (("C", 10), ("I", 25.4), ("in", 25.4))],
)
def test_units_become_millimetres(kind, unit, shape, unit_mm, tmp_path):
    geo = load(tmp_path, kind, f"{unit} ;; {shape}")
    same = load(tmp_path, kind, shape)
    # the path a phase adds is a length, so that its power scales like that of a curvature
    assert efl(geo) == pytest.approx(efl(same) * unit_mm, rel=1e-12)
    for name in ("curvature_per_mm", "thickness_mm", "asphere", "semi_aperture_mm"):
        if not (kind == "seq" and name == "semi_aperture_mm"):
            found, true = (getattr(g, name)[..., :2] for g in (geo, same.scaled(unit_mm)))
            torch.testing.assert_close(found, true, rtol=1e-13, atol=0)


def matrix(geo):
    """Paraxial system matrix of the singlet from first to last vertex, by products of matrices."""
    first, last = (s.curvature_per_mm * (N - 1) for s in geo.to_surfaces())
    return np.array([[1, 0], [last, 1]]) @ np.array([[1, 4 / N], [0, 1]]) @ np.array([[1, 0], [-first, 1]])


@pytest.mark.parametrize("spec", ["ENPD 10", "FNUM 5 0", "FNUM 5 1", "FLOA"])
@pytest.mark.parametrize("distance", [math.inf, 200.0])
@pytest.mark.parametrize("stop", [1, 2])
def test_the_pupil_follows_from_any_way_to_give_it(spec, distance, stop, tmp_path):
    behind = r" ;; STOP\n => ;; SURF 2 => SURF 2\nSTOP" if stop == 2 else ""
    far = "" if math.isinf(distance) else f" ;; DISZ INFINITY => DISZ {distance}"
    geo = load(tmp_path, "zmx", f"ENPD 10 => {spec}{far}{behind}")
    (_, _), (c, d) = matrix(geo)
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
    assert geo.entrance_pupil_diameter_mm == pytest.approx(true, rel=1e-12)


def test_a_floating_stop_without_a_diameter_takes_the_widest_axial_beam_the_lens_lets_through(tmp_path):
    geo = load(tmp_path, "zmx", r'ENPD 10 => FLOA ;; DIAM 8 1 0 0 1 ""\n =>')
    # at the back, where the semi-diameter is 7
    assert geo.entrance_pupil_diameter_mm == pytest.approx(2 * 7 / matrix(geo)[0, 0], rel=1e-12)


@pytest.mark.parametrize(
    ("kind", "fields", "true"),
    [
        # the third is not in use
        ("zmx", "FTYP 0 => FTYP 0 ;; YFLN 0 4 => YFLN 0 12 99", lambda f: 12.0),
        ("zmx", "FTYP 0 => FTYP 1 ;; YFLN 0 4 => YFLN 0 30 99", lambda f: math.degrees(math.atan(30 / 200))),
        ("zmx", "FTYP 0 => FTYP 2 ;; YFLN 0 4 => YFLN 0 10 99", lambda f: math.degrees(math.atan(10 / f))),
        ("zmx", "FTYP 0 => FTYP 3 ;; YFLN 0 4 => YFLN 0 10 99", lambda f: math.degrees(math.atan(10 / f))),
        ("seq", r"YAN 0 3 5 => XAN 0 3\nYAN 0 4", lambda f: 5.0),
        ("seq", "YAN 0 3 5 => YIM 0 10", lambda f: math.degrees(math.atan(10 / f))),
        ("seq", "YAN 0 3 5 => YRI 0 10", lambda f: math.degrees(math.atan(10 / f))),
    ],
)
def test_the_half_field_follows_from_any_way_to_give_it(kind, fields, true, tmp_path):
    near = " ;; XFLN 0 3 => XFLN 0 0 ;; DISZ INFINITY => DISZ 200" if kind == "zmx" else ""
    geo = load(tmp_path, kind, fields + near)
    assert geo.half_field_deg == pytest.approx(true(efl(geo)), rel=1e-12)


def test_parm_1_is_the_square_of_the_height(tmp_path):
    geo = load(
        tmp_path, "zmx", f"{ASPHERE.replace('0.001', '0.01').replace('-2e-5', '0')} ;; CURV 0.02 => CURV 0"
    )
    # the same vertex curvature, 2 x 0.01
    assert efl(geo) == pytest.approx(thick(0.02, -0.01, 4), rel=1e-14)


@pytest.mark.parametrize(("order", "radius"), [(1, 1.0), (2, 5.0)])
def test_a_binary_phase_has_the_power_of_its_first_term(order, radius, tmp_path):
    phase = rf"PARM 0 {order}\nXDAT 1 2 0 0\nXDAT 2 {radius} 0 0\nXDAT 3 -40 0 0\nXDAT 4 0.5 0 0"
    plane = "CURV 0.02 => CURV 0 ;; CURV -0.01 => CURV 0 ;; GLAS N-BK7 => GLAS AIR"
    geo = load(tmp_path, "zmx", rf"STOP\n  TYPE STANDARD => STOP\nTYPE BINARY_2\n{phase} ;; {plane}")
    # path m w phi / 2 pi = -r^2 / 2 f
    assert efl(geo) == pytest.approx(math.pi * radius**2 / (order * 40 * 0.5875618e-3), rel=1e-13)
    assert geo.to_surfaces()[0].phase == Phase((-40 / radius**2, 0.5 / radius**4), order)


def zmx(*surfaces, head="UNIT MM\nENPD 50"):
    """A .zmx file of surfaces, each the lines between two SURF, behind an object at infinity."""
    rows = ["DISZ INFINITY", *surfaces, "CURV 0"]
    return "\n".join(["MODE SEQ", head, *(f"SURF {i}\n{row}" for i, row in enumerate(rows))])


def test_mirrors_are_unfolded(tmp_path):
    mirrors = (
        "STOP\nCURV -0.005\nDISZ -75\nGLAS MIRROR 0 0 1.5 40\nCONI -1\nDIAM 25\nCLAP 6 25 0",
        "CURV -0.0125\nDISZ 80\nGLAS MIRROR 0 0 1.5 40\nCONI -9\nDIAM 11",
    )
    geo = load(tmp_path, "zmx", content=zmx(*mirrors))
    # two thin elements, f1 = 100, f2 = -40, 75 apart
    assert efl(geo) == pytest.approx(100 * -40 / (100 - 40 - 75), rel=1e-13)
    assert geo.to_surfaces() == (
        Surface(-200.0, 75.0, None, 25.0, -1.0, is_stop=True, mirror=True, inner_semi_aperture_mm=6.0),
        Surface(80.0, 80.0, None, 11.0, -9.0, mirror=True),
    )


LENS = ("STOP\nCURV 0.02\nDISZ 4\nGLAS N-BK7\nDIAM 8", "CURV -0.01\nDISZ {}\nDIAM 7")


def test_the_light_may_step_back_at_a_plane_that_does_nothing(tmp_path):
    front, back = LENS
    for first, lengths in ((-5, [4, 60]), (5, [5, 4, 60])):
        geo = load(
            tmp_path,
            "zmx",
            content=zmx(f"CURV 0\nDISZ {first}", front, back.format(65), "CURV 0\nDISZ -5"),
        )
        assert [s.thickness_mm for s in geo.to_surfaces()] == lengths


def test_a_coordinate_break_that_moves_nothing_stays_in_its_medium(tmp_path):
    still = "TYPE COORDBRK\nCURV 0.0\nPARM 1 0\nPARM 3 0\nPARM 6 1\nDISZ {}"
    front, back = LENS[0].replace("DISZ 4", "DISZ 3"), LENS[1]
    geo = load(tmp_path, "zmx", content=zmx(front, still.format(1), back.format(60), still.format(0)))
    assert geo.to_surfaces() == SINGLET
    # behind a mirror on the back of the glass the light goes back through the glass
    mirror = back.format(-1) + "\nGLAS MIRROR 0 0 1.5 40"
    mangin = (front, still.format(1), mirror, still.format(-3), "CURV 0\nDISZ -30")
    assert load(tmp_path, "zmx", content=zmx(*mangin)).index().tolist() == [1, N, N, 1]


@pytest.mark.parametrize(
    ("kind", "exchanges", "inner"),
    [
        ("zmx", r"DISZ 4 => DISZ 4\nOBSC 0 2.5 0", (2.5, 0.0)),
        ("zmx", r"DISZ 4 => DISZ 4\nCLAP 2.5 8 0", (2.5, 0.0)),
        ("seq", r"CIR 8 => CIR 8\nCIR EDG 9\nCIR OBS L'A' 1.5 ;; CIR 7 => CIR HOL 0.5", (1.5, 0.5)),
    ],
)
def test_obstructions_rings_and_holes_become_an_inner_aperture(kind, exchanges, inner, tmp_path):
    surfaces = load(tmp_path, kind, exchanges).to_surfaces()
    assert tuple(s.inner_semi_aperture_mm for s in surfaces) == inner
    assert surfaces[0].semi_aperture_mm == 8


@pytest.mark.parametrize(
    ("kind", "word", "index", "abbe"),
    [
        ("zmx", "GLAS N-BK7 0 0 1.5 40 => GLAS ___BLANK 1 0 1.6123 44.1", 1.6123, 44.1),
        ("seq", "NBK7_SCHOTT => 517.642", 1.517, 64.2),
        ("seq", "NBK7_SCHOTT => 517000.520000", 1.517, 52.0),
        ("seq", "NBK7_SCHOTT => 500.700", 1.5, 70.0),
    ],
)
def test_model_glasses_and_codes_have_their_index_and_abbe_number(kind, word, index, abbe, tmp_path):
    glass = load(tmp_path, kind, word).to_surfaces()[0].medium
    assert (glass.index_d, glass.abbe_number) == pytest.approx((index, abbe), rel=1e-13)


def test_apertures_a_file_leaves_out_let_the_field_pass(tmp_path):
    geo = load(tmp_path, "zmx", NO_APERTURES)
    stop, back = geo.semi_aperture_mm.tolist()
    assert stop == pytest.approx(5)
    assert back < 6
    tilt = math.radians(5)
    rays = [[0.0, y - 5 * math.tan(tilt), -5.0] for y in (-4.9, 0, 4.9)]
    towards = torch.tensor([[0.0, math.sin(tilt), math.cos(tilt)]] * 3, dtype=torch.float64)
    weight = geo.trace(torch.tensor(rays, dtype=torch.float64), towards).weight
    assert weight.tolist() == pytest.approx([1, 1, 1], abs=0.5)


def test_curvatures_are_read_where_radii_are_not_asked_for(tmp_path):
    for mode in ("RDM N;LEN", "LEN"):
        geo = load(tmp_path, "seq", f"RDM;LEN => {mode} ;; S 50 => S 0.02 ;; S -100 => s -0.01")
        assert efl(geo) == pytest.approx(thick(0.02, -0.01, 4), rel=1e-14)


def test_the_first_surface_is_the_stop_where_none_is_named(tmp_path):
    assert load(tmp_path, "seq", r"STO\n =>").stop_index == 0
    assert load(tmp_path, "seq", r"STO\n => ;; GO => STO S2").stop_index == 1
    assert load(tmp_path, "seq", "YAN 0 3 5 => YAN 0").half_field_deg is None


def test_private_glasses_have_their_tabulated_indices(tmp_path):
    table = r"SO => PRV\nPWL 656.2725 587.5618 &\n 486.1327\n'MINE' 1.51 1.52 1.53\n'OTHER' LAU 2.3 0 0 0 0 0\nEND\nSO"
    glass = load(tmp_path, "seq", f"{table} ;; NBK7_SCHOTT => 'MINE'").to_surfaces()[0].medium
    assert (glass.index_F, glass.index_d, glass.index_C) == pytest.approx((1.53, 1.52, 1.51), rel=1e-12)
    with pytest.raises(CodesignError, match="glass OTHER is given by a formula"):
        load(tmp_path, "seq", f"{table} ;; NBK7_SCHOTT => 'OTHER'")


def test_the_solve_for_the_image_finds_the_paraxial_focus(tmp_path):
    geo = load(tmp_path, "seq", "CIR 7 => CIR 7; PIM ;; SI 0 0 => SI 0 -0.25 ;; -100 60 => -100 -7")
    back = thick(0.02, -0.01, 4) * (1 - (N - 1) * 4 * 0.02 / N)
    assert geo.thickness_mm[-1].item() == pytest.approx(back - 0.25, rel=1e-13)


def seq(folder, *surfaces):
    return load(folder, "seq", content="\n".join(["RDM", "DIM M", "EPD 10", "SO 0 1e13", *surfaces]))


def test_the_defocus_behind_a_mirror_counts_along_the_fixed_axis(tmp_path):
    # light travels towards -z there: the image lies 0.5 mm beyond the focus
    for solve in ((), ("PIM",)):
        geo = seq(tmp_path, "S -200 -100 REFL", *solve, "SI 0 -0.5")
        assert geo.thickness_mm[-1].item() == pytest.approx(100.5, rel=1e-14)


@pytest.mark.parametrize(("spec", "factor"), [("FNO 4", 1 / 4), ("NA 0.125", 2 * 0.125)])
def test_the_pupil_from_the_image_side(spec, factor, tmp_path):
    geo = load(tmp_path, "seq", f"EPD 10 => {spec}")
    assert geo.entrance_pupil_diameter_mm == pytest.approx(factor * efl(geo), rel=1e-13)


def test_the_aspheres_powers(tmp_path):
    front = load(tmp_path, "seq", r"CIR 8 => CIR 8\nASP\nK -0.5\nA 1e-6; B -2e-8; J 3e-25").to_surfaces()[0]
    assert front.conic == -0.5
    # r^2, r^4, r^6, ... r^20
    assert front.asphere == (0.0, 1e-6, -2e-8, 0, 0, 0, 0, 0, 0, 3e-25)


def test_a_diffractive_surface_has_the_power_of_its_path(tmp_path):
    doe = r"CIR 8 => CIR 8\nDIF DOE\nHOR 1\nHWL 550\nHCT R\nHCO C1 -0.0025"
    geo = load(tmp_path, "seq", f"{doe} ;; S 50 => S 0 ;; S -100 => S 0 ;;  NBK7_SCHOTT =>")
    # path -r^2 / 2 f
    assert geo.first_order(0.55).efl_mm.item() == pytest.approx(200, rel=1e-13)
    assert geo.to_surfaces()[0].phase == Phase((-0.0025 * 2 * math.pi / 550e-6,), 1)


def test_a_mangin_mirror_is_unfolded(tmp_path):
    geo = seq(tmp_path, "WL 587.5618", "S -1200 10 NBK7_SCHOTT", "S -1000 -10 REFL", "S -1200 -500", "SI 0 0")
    surfaces = geo.to_surfaces()
    assert [(s.radius_mm, s.thickness_mm, s.mirror) for s in surfaces] == [
        (-1200, 10, False),
        (-1000, 10, True),
        (1200, 500, False),
    ]
    assert geo.index().tolist() == pytest.approx([1, N, N, 1])
    # thin limit: two passes through the lens and one mirror inside glass
    assert efl(geo) == pytest.approx(1 / (2 * ((N - 1) / -1200) + 2 * N / 1000), rel=0.02)


def test_one_surface_may_move_and_return(tmp_path):
    moves = "CIR 7 => CIR 7; DAR; XDE 0.1; YDE -0.2; ADE 1.5; BDE -0.5; CDE 30"
    moved = load(tmp_path, "seq", moves).to_surfaces()[1]
    # ADE and BDE are left-handed
    assert (moved.decentre_mm, moved.tilt_deg) == ((0.1, -0.2), (-1.5, 0.5))
    geo = seq(tmp_path, "S -1000 -40 REFL", "S -500 -90 ; DAR; YDE 0.3; ADE 1.5", "SI 0 0")
    behind = geo.to_surfaces()[1]
    # seen along the light, which travels towards -z there
    assert (behind.decentre_mm, behind.tilt_deg) == ((0.0, 0.3), (1.5, 0.0))


def test_solves_and_pickups_keep_the_stored_values(tmp_path):
    solves = r"CIR 7 => CIR 7\nTHI HMY 0.0\nCUY UMY -0.1\nCCY 0; THC 0\n"
    pickups = r"GO => PIK THI S2 Z1 THI S1 Z1\nDER VAL I1 -0.6"
    assert load(tmp_path, "seq", f"{solves} ;; {pickups}").to_surfaces() == SINGLET
