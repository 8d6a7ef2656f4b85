"""Coordinate breaks of .zmx files: the same rays traced by hand, from one local frame to the next
as the file has them."""

import math

import numpy as np
import pytest
import torch

from codesign import lens
from tests.lens.long_double_lens import by_frames
from tests.lens.systems import close
from tests.numbers import f64

HEAD = "MODE SEQ\nUNIT MM\nENPD 4\nFTYP 0 0 2 1 0 0 0\nYFLN 0 8\nWAVM 1 0.5875618 1\nSURF 0\n  DISZ INFINITY"
MEDIA = {
    "air": ["GLAS AIR"],
    "glass": ["GLAS ___BLANK 1 0 1.6 50"],
    "mirror": ["GLAS MIRROR 0 0 1.5 40"],
}
# rows of a kind, its thickness, and its curvature or PARM 1 to 6
CASES = {
    "an element shifted and back": "air 5 0, break 0 .4 -.3 0 0 0 0, glass 4 .02, air 0 -.01, break 60 -.4 "
    ".3 0 0 0 0",
    "an element tilted about a point inside it": "air 3 0, break -3 0 0 5 -3 0 0, glass 4 .02, air -1 -.01, "
    "break 61 0 0 -5 3 0 1",
    "tilted first, then shifted": "air 8 0, break 2 .5 .2 4 6 30 1, glass 4 .02, air -6 -.01, "
    "break 66 -.5 -.2 -4 -6 -30 0",
    "a tilted image plane": "glass 4 .02, air 55 -.01, break 1 .1 .2 3 -2 10 0",
    "a turned last group behind a mirror": "break 0 0 0 10 0 0 0, mirror 0 -.005, break -30 0 0 10 0 0 0, "
    "glass -4 .01, air -40 -.01",
}


def typed(case):
    return [
        (kind, *map(float, numbers)) for kind, *numbers in (row.split() for row in case.split(","))
    ]


def drawn(seed):
    draw = np.random.default_rng(seed).uniform
    found = []
    sign = 1.0
    for kind in (
        ("glass", "air", "mirror", "glass", "air") if seed % 3 else ("glass", "air", "glass", "air")
    ):
        if draw() < 0.7:
            found += [
                (
                    "break",
                    0.0,
                    *draw(-0.4, 0.4, 2),
                    *draw(-6, 6, 2),
                    draw(-90, 90),
                    int(draw() < 0.5),
                )
            ]
        sign = -sign if kind == "mirror" else sign
        found += [(kind, sign * draw(4, 9), draw(-0.015, 0.015))]
    return [*found, ("break", sign * 20.0, *draw(-0.4, 0.4, 2), *draw(-6, 6, 3), 0)]


def load(folder, rows):
    lines = [HEAD]
    stop = next(i for i, row in enumerate(rows) if row[0] != "break")
    for i, (kind, thickness, *what) in enumerate([*rows, ("air", 0.0, 0.0)]):
        numbers = [f"PARM {j} {v:.17g}" for j, v in enumerate(what, 1)]
        own = (
            ["TYPE COORDBRK", "CURV 0", *numbers]
            if kind == "break"
            else [f"CURV {what[0]:.17g}", *MEDIA[kind], "DIAM 9"]
        )
        lines += [
            f"SURF {i + 1}",
            *(f"  {line}" for line in [f"DISZ {thickness:.17g}", *own, *["STOP"] * (i == stop)]),
        ]
    (folder / "a.zmx").write_text("\n".join(lines))
    return lens.load(folder / "a.zmx")


@pytest.mark.filterwarnings("ignore:.* the centre of the stop")
@pytest.mark.parametrize("case", [*CASES, *range(20)])
def test_rays_go_where_a_trace_by_hand_leads_them(case, tmp_path):
    rows = typed(CASES[case]) if case in CASES else drawn(case)
    geo = load(tmp_path, rows)
    first = next(i for i, row in enumerate(rows) if row[0] != "break")
    vertex, _ = by_frames(rows[first:], np.zeros(3), np.zeros(3), bends=False)
    draw = np.random.default_rng(7).uniform
    starts = [np.array([*draw(-1.5, 1.5, 2), -10.0]) for _ in range(6)]
    aims = [np.array([*draw(-0.06, 0.06, 2), 1.0]) for _ in range(6)]
    towards = [aim / np.linalg.norm(aim) for aim in aims]
    led = np.array(
        [by_frames(rows, *ray, bends=False) for ray in zip(starts, towards, strict=True)], float
    )
    rays = geo.trace(
        torch.tensor(led[:, 0] - [0.0, 0.0, float(vertex[2])]), torch.tensor(led[:, 1])
    )
    true = np.array([by_frames(rows, *ray) for ray in zip(starts, towards, strict=True)], float)
    true[:, 1, 2] = abs(true[:, 1, 2])  # light travels along +z behind a mirror too
    assert not rays.status.any()
    close(rays.position_mm[:, :2], true[:, 0, :2], atol=1e-10)
    close(rays.direction, true[:, 1], atol=1e-12)


def test_what_returns_leaves_the_rest_on_the_axis_and_a_tilted_image_narrows_the_field(tmp_path):
    geo = load(tmp_path, typed(CASES["an element tilted about a point inside it"]))
    plane, front, back = geo.to_surfaces()
    assert (plane.decentre_mm, plane.tilt_deg, geo.half_field_deg) == ((0.0, 0.0), (0.0, 0.0), 8.0)
    assert front.tilt_deg == back.tilt_deg == pytest.approx((5.0, -3.0))
    with pytest.warns(UserWarning, match="centre of the stop lies 3.931 mm beside the axis"):
        tilted = load(tmp_path, typed(CASES["a tilted image plane"]))
    angle = math.degrees(math.acos(math.cos(math.radians(3)) * math.cos(math.radians(2))))
    close(tilted.half_field_deg, 8 - angle, 1e-12)


@pytest.mark.filterwarnings("ignore:.* the centre of the stop")
def test_four_tilted_mirrors_bring_the_beam_to_the_stated_spot(shared):
    geo = lens.load(shared("data/lenses/rayoptics/HoO-V2C18Ex66NEW.zmx"))
    # the breaks' tilts, each once before and once behind its mirror
    angle = -2 * math.radians(16.44 - 12 + 15.939999999989485 - 5.9999999994997468)
    around = torch.linspace(0, 2 * math.pi, 7201, dtype=torch.float64)[:, None]
    tilt = [
        [1, 0, 0],
        [0, math.cos(angle), -math.sin(angle)],
        [0, math.sin(angle), math.cos(angle)],
    ]
    across, up, along = f64(tilt).T
    vertex = f64([*geo.to_surfaces()[0].decentre_mm, 0.0])
    origins = vertex + 10 * (around.sin() * up + around.cos() * across)
    rays = geo.trace(origins, along.expand(7201, 3).contiguous())
    # the semi-diameter of its image, of a beam 20 mm wide
    close(rays.position_mm.norm(dim=1).max(), 0.0026768395313191379, 1e-3)
