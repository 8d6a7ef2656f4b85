"""Reading and writing .zmx: closed forms of first-order optics for what the file says, and a sentence for
what it cannot say here."""

import codecs
import math

import numpy as np
import pytest
import torch

from codesign import lens
from codesign.errors import CodesignError, FileFormatError
from codesign.lens import GeoLens, Glass, Surface
from codesign.lens.surface import Phase

N = Glass.named("N-BK7").index_d
HEAD = [
    "VERS 140124 0 0",
    "MODE SEQ",
    "NAME a singlet",
    "UNIT MM X W X CM MR CPMM",
    "ENPD 10",
    "FTYP 0 0 2 1 0 0 0",
    "XFLN 0 3",
    "YFLN 0 4",
    "WAVM 1 0.5875618 1",
    "PWAV 1",
]
OBJECT = ["SURF 0", "  TYPE STANDARD", '  CURV 0.0 0 0 0 0 ""', "  DISZ INFINITY"]
FRONT = [
    "SURF 1",
    "  STOP",
    "  TYPE STANDARD",
    '  CURV 0.02 0 0 0 0 ""',
    "  DISZ 4",
    "  GLAS N-BK7 0 0 1.5 40 0 0 0 0 0 0",
    '  DIAM 8 1 0 0 1 ""',
]
BACK = ["SURF 2", "  TYPE STANDARD", '  CURV -0.01 0 0 0 0 ""', "  DISZ 60", '  DIAM 7 1 0 0 1 ""']
IMAGE = [
    "SURF 3",
    "  TYPE STANDARD",
    "  CURV 0.0",
    "  DISZ 0",
    "TOL TOFF   0   0",
    "EFLY 1 3 0 0 0 0 0 0 0 0",
]


def text(head=HEAD, surfaces=(OBJECT, FRONT, BACK, IMAGE)):
    return "\n".join([*head, *(line for block in surfaces for line in block)]) + "\n"


def changed(block, old, new):
    """A block with the line that begins with a keyword replaced by others."""
    assert any(line.strip().startswith(old) for line in block)
    return [x for line in block for x in (new if line.strip().startswith(old) else [line])]


def load(folder, content, name="lens.zmx"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return lens.load(path)


def efl(geo):
    return float(geo.first_order().efl_mm.detach())


def thick(c1, c2, t, n=N):
    """Focal length of a thick lens in air (Smith, Modern Optical Engineering, ch. 3)."""
    return 1 / ((n - 1) * (c1 - c2 + (n - 1) * t * c1 * c2 / n))


def test_a_singlet_is_what_the_lensmaker_says(tmp_path):
    geo = load(tmp_path, text())
    assert efl(geo) == pytest.approx(thick(0.02, -0.01, 4), rel=1e-14)
    assert geo.entrance_pupil_diameter_mm == 10
    assert geo.half_field_deg == pytest.approx(5)  # 3 and 4 degrees
    assert geo.name == "a singlet"
    assert geo.to_surfaces() == (
        Surface(50.0, 4.0, Glass.named("N-BK7"), 8.0, is_stop=True),
        Surface(-100.0, 60.0, None, 7.0),
    )


@pytest.mark.parametrize(
    "encode",
    [
        lambda t: codecs.BOM_UTF16_LE + t.encode("utf-16-le"),
        lambda t: codecs.BOM_UTF16_BE + t.encode("utf-16-be"),
        lambda t: t.encode("utf-16-le"),
        lambda t: t.encode("utf-8"),
        lambda t: codecs.BOM_UTF8 + t.encode("utf-8"),
        lambda t: t.encode("latin-1"),
        lambda t: t.replace("\n", "\r\n").encode("utf-8"),
        lambda t: t.replace("\n", "\r").encode("latin-1"),
    ],
)
def test_every_encoding_reads_the_same(encode, tmp_path):
    content = text().replace("a singlet", "Ø 16 singlet")
    geo = load(tmp_path, encode(content))
    assert (geo.name, geo.to_surfaces()) == ("Ø 16 singlet", load(tmp_path, text()).to_surfaces())


@pytest.mark.parametrize(("unit", "unit_mm"), [("MM", 1), ("CM", 10), ("IN", 25.4), ("M", 1000)])
def test_units_become_millimetres(unit, unit_mm, tmp_path):
    asphere = changed(FRONT, "TYPE", ["  TYPE EVENASPH", "  PARM 1 0.001", "  PARM 2 -2e-5"])
    geo = load(
        tmp_path,
        text(changed(HEAD, "UNIT", [f"UNIT {unit} X W X CM MR CPMM"]), (OBJECT, asphere, BACK, IMAGE)),
    )
    true = load(tmp_path, text(surfaces=(OBJECT, asphere, BACK, IMAGE))).scaled(unit_mm)
    assert efl(geo) == pytest.approx(efl(true), rel=1e-13)
    assert geo.entrance_pupil_diameter_mm == 10 * unit_mm
    for name in ("curvature_per_mm", "thickness_mm", "asphere", "semi_aperture_mm"):
        torch.testing.assert_close(
            getattr(geo, name)[..., :2], getattr(true, name)[..., :2], rtol=1e-13, atol=0
        )


def matrix(geo):
    """Paraxial system matrix of the singlet from first to last vertex, by products of matrices."""
    s = geo.to_surfaces()
    total = np.eye(2)
    for surface, n, n_behind in zip(s, (1, N), (N, 1), strict=True):
        total = np.array([[1, 0], [-(n_behind - n) * surface.curvature_per_mm, 1]]) @ total
        total = np.array([[1, surface.thickness_mm / n_behind], [0, 1]]) @ total if n_behind != 1 else total
    return total


@pytest.mark.parametrize("spec", ["ENPD 10", "FNUM 5 0", "FNUM 5 1", "FLOA"])
@pytest.mark.parametrize("distance", [math.inf, 200.0])
@pytest.mark.parametrize("stop", [1, 2])
def test_the_pupil_follows_from_any_way_to_give_it(spec, distance, stop, tmp_path):
    front, back = (
        (FRONT, BACK)
        if stop == 1
        else ([x for x in FRONT if "STOP" not in x], [BACK[0], "  STOP", *BACK[1:]])
    )
    blocks = (
        changed(OBJECT, "DISZ", [f"  DISZ {'INFINITY' if math.isinf(distance) else distance}"]),
        front,
        back,
        IMAGE,
    )
    geo = load(tmp_path, text(changed(HEAD, "ENPD", [spec]), blocks))
    (a, b), (c, d) = matrix(geo)
    to_stop = (
        np.eye(2) if stop == 1 else np.array([[1, 4 / N], [0, 1]]) @ np.array([[1, 0], [-(N - 1) * 0.02, 1]])
    )
    pupil_z = to_stop[0, 1] / to_stop[0, 0]
    if spec == "ENPD 10":
        true = 10
    elif spec == "FNUM 5 0" or (spec == "FNUM 5 1" and math.isinf(distance)):
        true = -1 / c / 5
    elif spec == "FLOA":
        true = 2 * (8 if stop == 1 else 7) / to_stop[0, 0]
    else:  # a ray from the object's centre that leaves with slope 1 / (2 N)
        slope = -0.1 / (c * distance + d)
        true = 2 * abs(slope * (distance + pupil_z))
    assert geo.entrance_pupil_diameter_mm == pytest.approx(true, rel=1e-12)


def test_a_floating_stop_without_a_diameter_takes_the_widest_axial_beam_the_lens_lets_through(tmp_path):
    geo = load(
        tmp_path,
        text(changed(HEAD, "ENPD", ["FLOA"]), (OBJECT, [x for x in FRONT if "DIAM" not in x], BACK, IMAGE)),
    )
    height = matrix(geo)[0, 0]  # at the back, where the semi-diameter is 7
    assert geo.entrance_pupil_diameter_mm == pytest.approx(2 * 7 / height, rel=1e-12)


@pytest.mark.parametrize(("kind", "height"), [(0, 12.0), (2, 10.0), (3, 10.0), (1, 30.0)])
def test_the_half_field_follows_from_any_way_to_give_it(kind, height, tmp_path):
    head = changed(
        changed(changed(HEAD, "FTYP", [f"FTYP {kind} 0 2 1 0 0 0"]), "XFLN", ["XFLN 0 0"]),
        "YFLN",
        [f"YFLN 0 {height} 99"],
    )  # the third is not in use
    geo = load(tmp_path, text(head, (changed(OBJECT, "DISZ", ["  DISZ 200"]), FRONT, BACK, IMAGE)))
    true = {
        0: 12.0,
        1: math.degrees(math.atan(30 / 200)),
        2: math.degrees(math.atan(10 / efl(geo))),
        3: math.degrees(math.atan(10 / efl(geo))),
    }[kind]
    assert geo.half_field_deg == pytest.approx(true, rel=1e-12)


def test_parm_1_is_the_square_of_the_height(tmp_path):
    asphere = changed(changed(FRONT, "TYPE", ["  TYPE EVENASPH", "  PARM 1 0.01"]), "CURV", ["  CURV 0"])
    geo = load(tmp_path, text(surfaces=(OBJECT, asphere, BACK, IMAGE)))
    assert efl(geo) == pytest.approx(thick(0.02, -0.01, 4), rel=1e-14)  # the same vertex curvature, 2 x 0.01


@pytest.mark.parametrize(("order", "radius"), [(1, 1.0), (2, 5.0)])
def test_a_binary_phase_has_the_power_of_its_first_term(order, radius, tmp_path):
    doe = changed(
        changed(
            FRONT,
            "TYPE",
            [
                "  TYPE BINARY_2",
                f"  PARM 0 {order}",
                "  XDAT 1 2 0 0",
                f"  XDAT 2 {radius} 0 0",
                "  XDAT 3 -40 0 0",
                "  XDAT 4 0.5 0 0",
            ],
        ),
        "CURV",
        ["  CURV 0"],
    )
    geo = load(
        tmp_path,
        text(
            surfaces=(OBJECT, [x for x in doe if "GLAS" not in x], changed(BACK, "CURV", ["  CURV 0"]), IMAGE)
        ),
    )
    assert efl(geo) == pytest.approx(
        math.pi * radius**2 / (order * 40 * 0.5875618e-3), rel=1e-13
    )  # path m w phi / 2 pi = -r^2 / 2 f
    assert geo.to_surfaces()[0].phase == Phase((-40 / radius**2, 0.5 / radius**4), order)


CASSEGRAIN = [  # two mirrors: primary R -200, secondary R -80 as written, 75 apart
    [
        "SURF 1",
        "  STOP",
        "  CURV -0.005",
        "  DISZ -75",
        "  GLAS MIRROR 0 0 1.5 40",
        "  CONI -1",
        "  DIAM 25",
        "  CLAP 6 25 0",
    ],
    ["SURF 2", "  CURV -0.0125", "  DISZ 80", "  GLAS MIRROR 0 0 1.5 40", "  CONI -9", "  DIAM 11"],
]


def test_mirrors_are_unfolded(tmp_path):
    geo = load(tmp_path, text(changed(HEAD, "ENPD", ["ENPD 50"]), (OBJECT, *CASSEGRAIN, IMAGE)))
    f1 = 100.0
    f2 = -40.0
    d = 75.0
    assert efl(geo) == pytest.approx(f1 * f2 / (f1 + f2 - d), rel=1e-13)  # two thin elements
    front, back = geo.to_surfaces()
    assert (front.radius_mm, front.thickness_mm, front.mirror, front.inner_semi_aperture_mm) == (
        -200,
        75,
        True,
        6,
    )
    assert (back.radius_mm, back.thickness_mm, back.conic, back.mirror) == (80, 80, -9, True)


def test_the_light_may_step_back_at_a_plane_that_does_nothing(tmp_path):
    dummy = ["SURF 1", "  CURV 0", "  DISZ -5"]
    blocks = (
        OBJECT,
        dummy,
        changed(FRONT, "SURF", ["SURF 2"]),
        changed(changed(BACK, "SURF", ["SURF 3"]), "DISZ", ["  DISZ 65"]),
        ["SURF 4", "  CURV 0", "  DISZ -5"],
        ["SURF 5", "  CURV 0"],
    )
    assert load(tmp_path, text(surfaces=blocks)).to_surfaces() == load(tmp_path, text()).to_surfaces()
    kept = (OBJECT, changed(dummy, "DISZ", ["  DISZ 5"]), *blocks[2:])
    assert [s.thickness_mm for s in load(tmp_path, text(surfaces=kept)).to_surfaces()] == [5, 4, 60]


BREAK = ["  TYPE COORDBRK", "  CURV 0.0", "  PARM 1 0", "  PARM 3 0", "  PARM 6 1"]


def test_a_coordinate_break_that_moves_nothing_stays_in_its_medium(tmp_path):
    front = changed(FRONT, "DISZ", ["  DISZ 3"])
    inside = ["SURF 2", *BREAK, "  DISZ 1"]
    outside = ["SURF 4", *BREAK, "  DISZ 0"]
    back = changed(BACK, "SURF", ["SURF 3"])
    geo = load(
        tmp_path, text(surfaces=(OBJECT, front, inside, back, outside, changed(IMAGE, "SURF", ["SURF 5"])))
    )
    assert efl(geo) == pytest.approx(thick(0.02, -0.01, 4.0), rel=1e-13)
    assert [s.medium and s.medium.name for s in geo.to_surfaces()] == ["N-BK7", None]
    # behind a mirror on the back of the glass the light goes back through the glass
    mirror = [*changed(back, "DISZ", ["  DISZ -1"]), "  GLAS MIRROR 0 0 1.5 40"]
    last = ["SURF 5", "  CURV 0", "  DISZ -30"]
    behind = ["SURF 4", *BREAK, "  DISZ -3"]
    mangin = (OBJECT, front, inside, mirror, behind, last, ["SURF 6", "  CURV 0"])
    assert load(tmp_path, text(surfaces=mangin)).index().tolist() == [1, N, N, 1]


def test_obstructions_and_rings_become_an_inner_aperture(tmp_path):
    for line in ("  OBSC 0 2.5 0", "  CLAP 2.5 8 0"):
        geo = load(tmp_path, text(surfaces=(OBJECT, [*FRONT, line], BACK, IMAGE)))
        assert (geo.to_surfaces()[0].inner_semi_aperture_mm, geo.to_surfaces()[0].semi_aperture_mm) == (
            2.5,
            8,
        )


def test_a_model_glass_has_its_index_and_abbe_number(tmp_path):
    geo = load(
        tmp_path,
        text(
            surfaces=(OBJECT, changed(FRONT, "GLAS", ["  GLAS ___BLANK 1 0 1.6123 44.1 0 0 0"]), BACK, IMAGE)
        ),
    )
    glass = geo.to_surfaces()[0].medium
    assert glass is not None
    assert (glass.index_d, glass.abbe_number) == pytest.approx((1.6123, 44.1), rel=1e-13)


def test_apertures_a_file_leaves_out_let_the_field_pass(tmp_path):
    geo = load(
        tmp_path,
        text(
            surfaces=(
                OBJECT,
                [x for x in FRONT if "DIAM" not in x],
                [x for x in BACK if "DIAM" not in x],
                IMAGE,
            )
        ),
    )
    stop, back = geo.semi_aperture_mm.tolist()
    assert stop == pytest.approx(5)
    rays = torch.tensor(
        [[0.0, y - 5 * math.tan(math.radians(5)), -5.0] for y in (-4.9, 0, 4.9)], dtype=torch.float64
    )
    towards = torch.tensor(
        [0.0, math.sin(math.radians(5)), math.cos(math.radians(5))], dtype=torch.float64
    ).expand(3, 3)
    assert geo.trace(rays, towards).weight.tolist() == pytest.approx([1, 1, 1], abs=0.5)
    assert back < 6


@pytest.mark.parametrize("name", ["cooke-triplet", "double-gauss", "la1509"])
def test_a_written_file_reads_back_to_the_last_digit_or_two(name, tmp_path):
    before = lens.load(name)
    lens.save(before, tmp_path / "a.zmx")
    after = lens.load(tmp_path / "a.zmx")
    for old, new in zip(before.to_surfaces(), after.to_surfaces(), strict=True):
        assert new.radius_mm == pytest.approx(old.radius_mm, rel=3e-16)  # it passes through its reciprocal
        assert (new.thickness_mm, new.semi_aperture_mm, new.conic, new.asphere, new.mirror) == (
            old.thickness_mm,
            old.semi_aperture_mm,
            old.conic,
            old.asphere,
            old.mirror,
        )
        assert (new.medium and new.medium.name) == (old.medium and old.medium.name)
    for wavelength_um in lens.WAVELENGTH_UM.values():
        assert after.index(wavelength_um).tolist() == pytest.approx(
            before.index(wavelength_um).tolist(), abs=1e-8
        )
    assert (after.name, after.stop_index, after.entrance_pupil_diameter_mm, after.half_field_deg) == (
        before.name,
        before.stop_index,
        before.entrance_pupil_diameter_mm,
        before.half_field_deg,
    )


def test_all_a_zmx_file_can_hold_is_written(tmp_path):
    surfaces = [
        Surface(
            31.7,
            5.1,
            Glass.from_abbe(1.6123, 44.1),
            9.0,
            conic=-0.7,
            asphere=(1e-4, -2.2e-6),
            is_stop=True,
        ),
        Surface(-180.3, 21.0, None, 9.0, conic=-1.1, mirror=True, inner_semi_aperture_mm=1.25),
        Surface(250.0, 3.0, Glass.named("F2"), 9.0, asphere=(0.0, 1e-7)),
        Surface(float("inf"), 21.0, None, 9.0),
    ]
    before = GeoLens(surfaces, 9.5, name="Öl", half_field_deg=1.5)
    lens.save(before, tmp_path / "a.zmx")
    content = (tmp_path / "a.zmx").read_text()
    assert "DISZ -21.0" in content  # the axis is folded again
    assert "GLAS ___BLANK 1 0 1.6123" in content
    flint = Glass.named("F2")
    assert f"GLAS F2 0 0 {flint.index_d!r} {flint.abbe_number!r} " in content
    assert "GCAT SCHOTT\n" in content
    after = lens.load(tmp_path / "a.zmx")
    for old, new in zip(surfaces, after.to_surfaces(), strict=True):
        assert new.radius_mm == pytest.approx(old.radius_mm, rel=3e-16)
        assert new.asphere[: len(old.asphere)] == old.asphere
        assert not any(new.asphere[len(old.asphere) :])
        for name in (
            "thickness_mm",
            "semi_aperture_mm",
            "conic",
            "is_stop",
            "mirror",
            "inner_semi_aperture_mm",
        ):
            assert getattr(new, name) == getattr(old, name), name
    assert after.to_surfaces()[2].medium == Glass.named("F2")
    assert after.index(0.65).tolist() == pytest.approx(
        before.index(0.65).tolist(), abs=2e-5
    )  # of the model glass, nd and Vd are kept
    assert after.first_order().efl_mm.item() == pytest.approx(before.first_order().efl_mm.item(), rel=1e-12)


def test_catalogues_are_those_of_the_glasses(tmp_path):
    used = ["S-LAH65", "N-BK7", "F-SILICA", "N-SK16"]
    gaps = [Surface(50.0, 2.0, Glass.named(name), 5.0) for name in used]
    lens.save(GeoLens([*gaps, Surface(-50.0, 40.0, None, 5.0)], 5.0), tmp_path / "a.zmx")
    content = (tmp_path / "a.zmx").read_text()
    assert "GCAT OHARA SCHOTT\n" in content
    assert f"GLAS ___BLANK 1 0 {Glass.named('F-SILICA').index_d!r} " in content  # its name differs by program
    model = Glass.from_abbe(1.6, 50.0)
    plain = [Surface(50.0, 4.0, model, 5.0), Surface(-50.0, 40.0, None, 5.0)]
    lens.save(GeoLens(plain, 5.0), tmp_path / "b.zmx")
    assert "GCAT" not in (tmp_path / "b.zmx").read_text()


def test_what_a_zmx_file_cannot_hold_is_not_written(tmp_path):
    plain = Surface(50.0, 40.0, None, 5.0)
    for rare, reason in (
        (Surface(50.0, 4.0, None, 5.0, tilt_deg=(1.0, 0.0)), "decentred or tilted"),
        (Surface(50.0, 4.0, None, 5.0, asphere=(0.0,) * 8 + (1e-20,)), "9 asphere terms"),
        (Surface(50.0, 4.0, Glass.from_indices(1.5, 1.5, 1.5, "flat"), 5.0), "Abbe number inf"),
        (Surface(50.0, 4.0, None, 5.0, phase=Phase((-1.0,))), "diffractive phase"),
    ):
        with pytest.raises(FileFormatError, match=f"surface 1: .*{reason}.*save the lens as .json"):
            lens.save(GeoLens([rare, plain], 5.0), tmp_path / "a.zmx")
    assert not list(tmp_path.iterdir())


def test_a_lens_for_another_band_keeps_its_glass(tmp_path):
    infrared = Glass("GE-LIKE", "sellmeier", (15.0, 0.2), (2.0, 12.0))
    dark = GeoLens([Surface(50.0, 4.0, infrared, 5.0), Surface(60.0, 40.0, None, 5.0)], 8.0)
    with pytest.raises(CodesignError, match="GE-LIKE"):
        lens.save(dark, tmp_path / "a.zmx")  # a model glass is given by visible lines
    assert not list(tmp_path.iterdir())
    lens.save(dark, tmp_path / "a.json")
    assert lens.load(tmp_path / "a.json").to_surfaces() == dark.to_surfaces()


def at_front(line):
    return text(surfaces=(OBJECT, [*FRONT, f"  {line}"], BACK, IMAGE))


def front(old, *new):
    return text(surfaces=(OBJECT, changed(FRONT, old, [f"  {n}" for n in new]), BACK, IMAGE))


def broken(*lines):
    """The singlet with a coordinate break before its image."""
    held = [] if any("DISZ" in line for line in lines) else ["  DISZ 0"]
    turn = ["SURF 3", "  TYPE COORDBRK", "  CURV 0", *held, *(f"  {line}" for line in lines)]
    return text(surfaces=(OBJECT, FRONT, BACK, turn, changed(IMAGE, "SURF", ["SURF 4"])))


def head(old, *new):
    return text(changed(HEAD, old, list(new)))


BAD = {
    "a break that is a surface": (
        front("TYPE", "TYPE COORDBRK", "PARM 3 45"),
        "surface 1: it is a coordinate break with a stop, a glass or extra data",
    ),
    "a break of an order nobody knows": (broken("PARM 1 1", "PARM 6 2"), "surface 3: its PARM 6 is 2, which"),
    "a break with more than it can have": (
        broken("PARM 1 1", "PARM 7 3"),
        "surface 3: its PARM 7 is 3, which",
    ),
    "a fold": (broken("PARM 3 90"), "surface 1: its axis stands at 90 degrees to that of the image plane"),
    "a return": (broken("PARM 4 180"), "surface 1: its axis stands at 180 degrees"),
    "a shift behind the image": (broken("DISZ -70", "PARM 1 1"), "surface 2: the light would travel 10 mm"),
    "a break at infinity": (broken("DISZ INFINITY", "PARM 1 1"), "surface 3: its thickness is infinite"),
    "no aperture": (head("ENPD"), "does not say how wide its beam is; give the entrance pupil diameter"),
    "no curvature": (front("CURV"), "surface 1: the line CURV is missing"),
    "no distance": (front("DISZ"), "surface 1: the line DISZ is missing"),
    "an f-number in glass": (
        text(
            changed(HEAD, "ENPD", ["FNUM 5 0"]),
            (OBJECT, FRONT, [*BACK, "  GLAS N-BK7 0 0"], IMAGE),
        ),
        "f-number is counted in the image space, which is glass",
    ),
    "toroid": (front("TYPE", "TYPE TOROIDAL"), "type TOROIDAL"),
    "paraxial": (front("TYPE", "TYPE PARAXIAL"), "ideal thin lens"),
    "odd asphere": (front("TYPE", "TYPE ODDASPHE"), "odd powers"),
    "a type nobody knows": (front("TYPE", "TYPE GRINSUR9"), "type GRINSUR9 is not read"),
    "extra data": (at_front("XDAT 1 3.0"), "extra data"),
    "parameters of a sphere": (at_front("PARM 2 1e-6"), "parameters or extra data"),
    "parameters beyond 8": (front("TYPE", "TYPE EVENASPH", "PARM 9 1e-9"), "beyond PARM 8"),
    "rectangle": (at_front("SQAP 3 4 0"), r"rectangular \(SQAP\)"),
    "shifted aperture": (at_front("OBDC 0 1.5"), "off the axis"),
    "shifted frame": (at_front("SCBD 1 0 0 0 0 90 0 0"), "SCBD"),
    "ring obstruction": (at_front("OBSC 1 2 0"), "blocks a ring"),
    "unknown keyword": (at_front("WOBL 3"), "keyword 'WOBL' is not understood; delete the line"),
    "two curvatures": (at_front("CURV 0.03"), "CURV comes twice"),
    "unknown glass": (
        front("GLAS", "GLAS N-BK77 0 0 1.5 40"),
        "surface 1: glass 'N-BK77' is not in the catalogue; the nearest names are .*N-BK7",
    ),
    "model glass without numbers": (front("GLAS", "GLAS ___BLANK 1 0"), "no index and Abbe number"),
    "model glass without dispersion": (front("GLAS", "GLAS ___BLANK 1 0 1.5 0"), "Vd=0.0"),
    "negative edge": (
        front("DISZ", "DISZ 0.3"),
        "surface 1: the glass behind it is -.* mm thick at .* mm from the axis",
    ),
    "backwards": (
        text(surfaces=(OBJECT, FRONT, changed(BACK, "DISZ", ["  DISZ -3"]), IMAGE)),
        "surface 2: the light would travel 3 mm backwards",
    ),
    "aperture beyond the sphere": (front("DIAM", "DIAM 51"), "surface 1: semi-aperture 51.0 mm exceeds"),
    "negative diameter": (front("DIAM", "DIAM -8"), "semi-diameter is -8"),
    "no stop": (
        text(surfaces=(OBJECT, [x for x in FRONT if "STOP" not in x], BACK, IMAGE)),
        "mark one between object and image with STOP",
    ),
    "two stops": (
        text(surfaces=(OBJECT, FRONT, [BACK[0], "  STOP", *BACK[1:]], IMAGE)),
        r"surfaces \[1, 2\] are marked as the stop",
    ),
    "stop on the image": (
        text(surfaces=(OBJECT, [x for x in FRONT if "STOP" not in x], BACK, [IMAGE[0], "  STOP"])),
        r"\[3\] are marked",
    ),
    "curved image": (
        text(surfaces=(OBJECT, FRONT, BACK, changed(IMAGE, "CURV", ["  CURV 0.01"]))),
        "only a flat image plane",
    ),
    "immersed object": (
        text(surfaces=([*OBJECT, "  GLAS WATER 0 0"], FRONT, BACK, IMAGE)),
        "object lies in 'WATER'",
    ),
    "a number missing": (
        text(surfaces=(OBJECT, FRONT, changed(BACK, "SURF", ["SURF 3"]), IMAGE)),
        "surface 2 is missing",
    ),
    "a number twice": (
        text(surfaces=(OBJECT, FRONT, changed(BACK, "SURF", ["SURF 1"]), IMAGE)),
        "surface 1 comes twice",
    ),
    "no surface": (text(surfaces=(OBJECT, IMAGE[:1])).replace("SURF 3", "SURF 1"), "it has 2 surfaces"),
    "too many surfaces": ("\n".join([*HEAD, *(f"SURF {i}" for i in range(600))]), "more than 500 surfaces"),
    "configurations": (
        text() + "\nMNUM 3 1\nMOFF 0 1",
        r"it holds 3 configurations \(MNUM\), and only one lens at a time is read; save the one you want",
    ),
    "not sequential": (head("MODE", "MODE NSC"), "mode 'NSC'"),
    "unit unknown": (head("UNIT", "UNIT FURLONG"), "unit 'FURLONG' is not known; known are MM"),
    "unit missing": (head("UNIT"), "names no unit"),
    "numerical aperture at the object": (head("ENPD", "OBNA 0.15 0"), "give the entrance pupil diameter"),
    "pupil negative": (head("ENPD", "ENPD -3"), "diameter is -3; it must be positive"),
    "telecentric": (head("FTYP", "FTYP 0 1 2 1 0 0 0"), "telecentric"),
    "afocal": (head("FTYP", "FTYP 0 0 2 1 0 0 1"), "afocal"),
    "hot": (text([*HEAD, "ENVD 60 1 1"]), "temperature"),
    "not a number": (front("CURV", "CURV 0.0x2"), "CURV is '0.0x2', a finite number is needed"),
    "NaN": (front("CURV", "CURV NaN"), "a finite number"),
    "infinite": (front("CURV", "CURV 1e999"), "a finite number"),
    "infinite thickness": (front("DISZ", "DISZ INFINITY"), "surface 1: its thickness is infinite"),
    "underscores": (front("CURV", "CURV 1_0"), "a finite number"),
    "5000 digits": (front("CURV", "CURV " + "9" * 5000), "a finite number"),
    "a focal length that is none": (
        text(
            changed(HEAD, "ENPD", ["FNUM 5 0"]),
            (OBJECT, changed(FRONT, "CURV", ["  CURV 0"]), changed(BACK, "CURV", ["  CURV 0"]), IMAGE),
        ),
        "afocal",
    ),
}


@pytest.mark.parametrize("fault", BAD)
def test_what_cannot_be_traced_is_refused_by_name(fault, tmp_path):
    content, sentence = BAD[fault]
    with pytest.raises(CodesignError, match=sentence) as caught:
        load(tmp_path, content)
    message = str(caught.value)
    assert message.startswith(f"lens file {tmp_path / 'lens.zmx'}: ")
    assert "\n" not in message
    assert len(message) < 500
