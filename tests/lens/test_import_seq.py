"""Reading .seq: closed forms of first-order optics for what the file says, and a sentence for what it cannot
say here."""

import math

import pytest

from codesign import lens
from codesign.errors import CodesignError
from codesign.lens import Glass, Surface
from codesign.lens.surface import Phase

N = Glass.named("N-BK7").index_d
SINGLET = """RDM;LEN "VERSION: 11.2"
TITLE 'a; singlet!' ! made for a test
EPD 10
DIM M
WL 656.3 587.5618 486.1
REF 2
YAN 0 3 5
SO 0 1e13
S 50 &
  4 NBK7_SCHOTT
STO
CIR 8
S -100 60; CIR 7
SI 0 0
GO
"""


def load(folder, content):
    path = folder / "lens.seq"
    path.write_text(content)
    return lens.load(path)


def efl(geo):
    return float(geo.first_order().efl_mm.detach())


def thick(c1, c2, t, n=N):
    """Focal length of a thick lens in air (Smith, Modern Optical Engineering, ch. 3)."""
    return 1 / ((n - 1) * (c1 - c2 + (n - 1) * t * c1 * c2 / n))


def test_a_singlet_is_what_the_lensmaker_says(tmp_path):
    geo = load(tmp_path, SINGLET)
    assert efl(geo) == pytest.approx(thick(0.02, -0.01, 4), rel=1e-14)
    assert (geo.name, geo.entrance_pupil_diameter_mm, geo.half_field_deg) == ("a; singlet!", 10, 5)
    assert geo.to_surfaces() == (
        Surface(50.0, 4.0, Glass.named("N-BK7"), 8.0, is_stop=True),
        Surface(-100.0, 60.0, None, 7.0),
    )


def test_curvatures_are_read_where_radii_are_not_asked_for(tmp_path):
    for mode in ("RDM N;LEN", "LEN"):
        geo = load(
            tmp_path, SINGLET.replace("RDM;LEN", mode).replace("S 50", "S 0.02").replace("S -100", "s -0.01")
        )
        assert efl(geo) == pytest.approx(thick(0.02, -0.01, 4), rel=1e-14)


@pytest.mark.parametrize(("unit", "unit_mm"), [("M", 1), ("C", 10), ("I", 25.4), ("in", 25.4)])
def test_units_become_millimetres(unit, unit_mm, tmp_path):
    doe = "CIR 8\nASP\nA 1e-6\nDIF DOE\nHWL 550\nHCT R\nHCO C1 -1e-4; HCO C2 1e-9"
    geo = load(tmp_path, SINGLET.replace("DIM M", f"DIM {unit}").replace("CIR 8", doe))
    true = load(tmp_path, SINGLET.replace("CIR 8", doe)).scaled(unit_mm)
    # the path a phase adds is a length, so that its power scales like that of a curvature
    assert efl(geo) == pytest.approx(efl(load(tmp_path, SINGLET.replace("CIR 8", doe))) * unit_mm, rel=1e-12)
    assert geo.thickness_mm.tolist() == pytest.approx(true.thickness_mm.tolist())
    assert geo.asphere.tolist()[0] == pytest.approx(true.asphere.tolist()[0])


def test_the_first_surface_is_the_stop_where_none_is_named(tmp_path):
    assert load(tmp_path, SINGLET.replace("STO\n", "")).stop_index == 0
    assert load(tmp_path, SINGLET.replace("STO\n", "").replace("GO", "STO S2")).stop_index == 1


@pytest.mark.parametrize(
    ("word", "index", "abbe"),
    [("517.642", 1.517, 64.2), ("517000.520000", 1.517, 52.0), ("500.700", 1.5, 70.0)],
)
def test_glass_codes(word, index, abbe, tmp_path):
    glass = load(tmp_path, SINGLET.replace("NBK7_SCHOTT", word)).to_surfaces()[0].medium
    assert glass is not None
    assert (glass.index_d, glass.abbe_number) == pytest.approx((index, abbe), rel=1e-13)


def test_private_glasses_have_their_tabulated_indices(tmp_path):
    table = (
        "PRV\nPWL 656.2725 587.5618 &\n 486.1327\n'MINE' 1.51 1.52 1.53\n'OTHER' LAU 2.3 0 0 0 0 0\nEND\nSO"
    )
    glass = (
        load(tmp_path, SINGLET.replace("SO", table).replace("NBK7_SCHOTT", "'MINE'")).to_surfaces()[0].medium
    )
    assert glass is not None
    assert (glass.index_F, glass.index_d, glass.index_C) == pytest.approx((1.53, 1.52, 1.51), rel=1e-12)
    with pytest.raises(CodesignError, match="glass OTHER is given by a formula"):
        load(tmp_path, SINGLET.replace("SO", table).replace("NBK7_SCHOTT", "'OTHER'"))


def test_the_solve_for_the_image_finds_the_paraxial_focus(tmp_path):
    geo = load(
        tmp_path,
        SINGLET.replace("CIR 7", "CIR 7; PIM").replace("SI 0 0", "SI 0 -0.25").replace("-100 60", "-100 -7"),
    )
    back = thick(0.02, -0.01, 4) * (1 - (N - 1) * 4 * 0.02 / N)
    assert geo.thickness_mm[-1].item() == pytest.approx(back - 0.25, rel=1e-13)


def test_the_defocus_behind_a_mirror_counts_along_the_fixed_axis(tmp_path):
    mirror = "RDM\nDIM M\nEPD 10\nSO 0 1e13\nS -200 -100 REFL\n{}SI 0 -0.5"
    for solve in ("", "PIM\n"):  # light travels towards -z there: the image lies 0.5 mm beyond the focus
        assert load(tmp_path, mirror.format(solve)).thickness_mm[-1].item() == pytest.approx(100.5, rel=1e-14)


@pytest.mark.parametrize(("spec", "factor"), [("FNO 4", 1 / 4), ("NA 0.125", 2 * 0.125)])
def test_the_pupil_from_the_image_side(spec, factor, tmp_path):
    geo = load(tmp_path, SINGLET.replace("EPD 10", spec))
    assert geo.entrance_pupil_diameter_mm == pytest.approx(factor * efl(geo), rel=1e-13)


@pytest.mark.parametrize(
    ("fields", "true"), [("XAN 0 3\nYAN 0 4", 5.0), ("YIM 0 10", None), ("YRI 0 10", None), ("YAN 0", 0.0)]
)
def test_the_half_field(fields, true, tmp_path):
    geo = load(tmp_path, SINGLET.replace("YAN 0 3 5", fields))
    true = math.degrees(math.atan(10 / efl(geo))) if true is None else true or None
    assert geo.half_field_deg == pytest.approx(true)


def test_the_aspheres_powers(tmp_path):
    geo = load(tmp_path, SINGLET.replace("CIR 8", "CIR 8\nASP\nK -0.5\nA 1e-6; B -2e-8; J 3e-25"))
    front = geo.to_surfaces()[0]
    assert front.conic == -0.5
    assert front.asphere == (0.0, 1e-6, -2e-8, 0, 0, 0, 0, 0, 0, 3e-25)  # r^2, r^4, r^6, ... r^20


def test_a_diffractive_surface_has_the_power_of_its_path(tmp_path):
    doe = "CIR 8\nDIF DOE\nHOR 1\nHWL 550\nHCT R\nHCO C1 -0.0025"
    geo = load(
        tmp_path,
        SINGLET.replace("CIR 8", doe)
        .replace("S 50", "S 0")
        .replace("S -100", "S 0")
        .replace(" NBK7_SCHOTT", ""),
    )
    assert geo.first_order(0.55).efl_mm.item() == pytest.approx(200, rel=1e-13)  # path -r^2 / 2 f
    assert geo.to_surfaces()[0].phase == Phase((-0.0025 * 2 * math.pi / 550e-6,), 1)


def test_a_mangin_mirror_is_unfolded(tmp_path):
    geo = load(
        tmp_path,
        "RDM\nDIM M\nEPD 100\nWL 587.5618\nSO 0 1e13\nS -1200 10 NBK7_SCHOTT\nS -1000 -10 REFL\nS -1200 "
        "-500\nSI 0 0",
    )
    front, mirror, back = geo.to_surfaces()
    assert (front.radius_mm, mirror.radius_mm, back.radius_mm) == (-1200, -1000, 1200)
    assert (front.thickness_mm, mirror.thickness_mm, back.thickness_mm) == (10, 10, 500)
    assert (front.mirror, mirror.mirror, back.mirror) == (False, True, False)
    assert geo.index().tolist() == pytest.approx([1, N, N, 1])
    # thin limit: two passes through the lens and one mirror inside glass
    assert efl(geo) == pytest.approx(1 / (2 * ((N - 1) / -1200) + 2 * N / 1000), rel=0.02)


def test_one_surface_may_move_and_return(tmp_path):
    moved = load(
        tmp_path, SINGLET.replace("CIR 7", "CIR 7; DAR; XDE 0.1; YDE -0.2; ADE 1.5; BDE -0.5; CDE 30")
    ).to_surfaces()[1]
    assert (moved.decentre_mm, moved.tilt_deg) == ((0.1, -0.2), (-1.5, 0.5))  # ADE and BDE are left-handed
    behind = load(
        tmp_path,
        "RDM\nDIM M\nEPD 10\nSO 0 1e13\nS -1000 -40 REFL\nS -500 -90 ; DAR; YDE 0.3; ADE 1.5\nSI 0 0",
    ).to_surfaces()[1]
    assert (behind.decentre_mm, behind.tilt_deg) == (
        (0.0, 0.3),
        (1.5, 0.0),
    )  # seen along the light, which travels towards -z there


def test_obstructions_and_holes(tmp_path):
    front, back = load(
        tmp_path,
        SINGLET.replace("CIR 8", "CIR 8\nCIR EDG 9\nCIR OBS L'A' 1.5").replace("CIR 7", "CIR HOL 0.5"),
    ).to_surfaces()
    assert (front.semi_aperture_mm, front.inner_semi_aperture_mm, back.inner_semi_aperture_mm) == (
        8,
        1.5,
        0.5,
    )


def test_solves_and_pickups_keep_the_stored_values(tmp_path):
    extra = "CIR 7\nTHI HMY 0.0\nCUY UMY -0.1\nCCY 0; THC 0\n"
    assert (
        load(
            tmp_path,
            SINGLET.replace("CIR 7", extra).replace("GO", "PIK THI S2 Z1 THI S1 Z1\nDER VAL I1 -0.6"),
        ).to_surfaces()
        == load(tmp_path, SINGLET).to_surfaces()
    )


BAD = {
    "tilt of all that follows": ("CIR 7", "ADE 5", "surface 2: it shifts or tilts everything behind it"),
    "tilt and reverse": (
        "CIR 7",
        "ADE 5; REV",
        r"surface 2: it tilts or shifts everything behind it \(REV\)",
    ),
    "bend": ("CIR 7", "BEN", "bends the axis"),
    "conic on a sphere": (
        "CIR 7",
        "K -1",
        "surface 2: it has a conic constant or asphere terms, but its shape is SPH",
    ),
    "asphere on a conic": ("CIR 7", "CON; A 1e-6", "but its shape is CON"),
    "phase on what does not diffract": ("CIR 7", "HWL 550; HCO C1 1", "does not diffract"),
    "shift along the axis": ("CIR 7", "DAR; ZDE 1", "shifted along the axis"),
    "toroid": ("CIR 7", "YTO", "toroidal"),
    "hologram": ("CIR 7", "HOE", "two-point hologram"),
    "grating": ("CIR 7", "DIF GRT", "diffracts as GRT"),
    "phase without wavelength": ("CIR 7", "DIF DOE; HCO C1 1", "no design wavelength"),
    "rectangle": ("CIR 7", "REX 3", "rectangular"),
    "shifted aperture": ("CIR 7", "ADY 3", "off the axis"),
    "strange circle": ("CIR 7", "CIR FOO 3", "CIR FOO 3 is not understood"),
    "fresnel": ("CIR 7", "CUF 0.1", "Fresnel"),
    "unknown command": ("CIR 7", "WOB 7", "command 'WOB' is not understood; delete it"),
    "zoom": ("CIR 7", "ZOO 3", r"it is a zoom \(ZOO 3\), and only one lens at a time"),
    "before any surface": ("DIM M", "CIR 7", "stands before any surface"),
    "unknown glass": (
        "NBK7_SCHOTT",
        "NBK77_SCHOTT",
        "surface 1: glass 'NBK77_SCHOTT' is not in the catalogue; the nearest names are",
    ),
    "total reflection": ("NBK7_SCHOTT", "TIRO", "reflects totally"),
    "unit unknown": ("DIM M", "DIM F", "unit 'F' is not known"),
    "object NA": ("EPD 10", "NAO 0.1", "give the entrance pupil diameter"),
    "no pupil": ("EPD 10", "EPD", "command 'EPD' has no value"),
    "reference wavelength": ("REF 2", "REF 4", "number 4 of 3"),
    "temperature": ("REF 2", "TEM 50", "TEM is 50"),
    "numbered twice": ("S -100 60", "S1 -100 60", "S1 comes where surface 2 is due"),
    "negative number": ("S -100 60", "S-2 -100 60", "command 'S-2' is not understood"),
    "curved image": ("SI 0 0", "SI 20 0", "only a flat image plane"),
    "tilted image": ("SI 0 0", "SI 0 0; ADE 3", "only a flat image plane"),
    "immersed object": ("SO 0 1e13", "SO 0 1e13 NBK7", "only objects in air"),
    "two stops": ("S -100 60", "S -100 60; STO", r"surfaces \[1, 2\] are marked as the stop"),
    "negative edge": ("  4 NBK7", "  0.3 NBK7", "surface 1: the glass behind it is -"),
    "backwards": ("-100 60", "-100 -60", "surface 2: the light would travel 60 mm backwards"),
    "solve without focus": ("CIR 7", "CIR 7; PIM; RDY 40", "paraxial focus puts the image"),
    "NaN": ("S -100", "S nan", "the radius is 'nan', a finite number"),
    "overflow": ("S -100", "S 1e999", "the radius is '1e999', a finite number"),
    "5000 digits": ("S -100", "S " + "7" * 5000, "a finite number"),
    "unfinished": ("GO\n", "S 50 &", "the file ends"),
    "too many surfaces": ("SI 0 0", "S 0 1\n" * 600, "more than 500 surfaces"),
}


@pytest.mark.parametrize("fault", BAD)
def test_what_cannot_be_traced_is_refused_by_name(fault, tmp_path):
    old, new, sentence = BAD[fault]
    assert old in SINGLET
    content = (
        SINGLET.replace("SO 0 1e13\n", "SO 0 1e13\n").replace(old, new, 1)
        if fault != "before any surface"
        else SINGLET.replace("EPD 10\n", "EPD 10\nCIR 7\n")
    )
    with pytest.raises(CodesignError, match=sentence) as caught:
        load(tmp_path, content)
    message = str(caught.value)
    assert message.startswith(f"lens file {tmp_path / 'lens.seq'}: ")
    assert "\n" not in message
    assert len(message) < 500
