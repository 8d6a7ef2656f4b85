"""The design study from plane plates: its residuals are the spots it is judged by, its searches reach
the published lens."""

import math

import pytest
import torch

from codesign import lens
from codesign.lens import WAVELENGTH_UM
from codesign.lens.analysis import pupil_grid
from studies.lens_scratch.search import search
from studies.lens_scratch.task import (
    EFL_MM,
    HALF_FIELD,
    JUDGED_FIELDS,
    LINES,
    SPOT_UNIT_MM,
    Stage,
    build,
    draw_start,
    judge,
    polychromatic_spots_um,
    residuals_of,
)

D = torch.float64


def published():
    """The Cooke triplet in the study's variables, with its image plane at the paraxial focus; and as
    published."""
    geo = lens.load("cooke-triplet").freeze()
    return torch.cat([geo.curvature_per_mm[:5], geo.thickness_mm[:5], torch.zeros(1, dtype=D)]), geo


def test_a_start_is_plane_and_holds_the_focal_length():
    x = draw_start(torch.Generator().manual_seed(0))
    assert float(x[:5].abs().max()) < 1 / 400  # radii of two metres on average
    geo = build(x)
    assert float(geo.first_order().efl_mm) == pytest.approx(EFL_MM, rel=1e-12)
    assert not torch.equal(x, draw_start(torch.Generator().manual_seed(1)))


def test_the_squared_residuals_are_the_mean_square_spot():
    x, _ = published()
    stage = Stage(1.0, 1.0, LINES, 1)
    geo = build(x)
    fields = [HALF_FIELD * k / 3 for k in range(4)]
    mean_square = 0.0
    for field in fields:
        points = torch.cat([lens.spots(geo, [field], WAVELENGTH_UM[line], grid=8)[0][0] for line in LINES])
        mean_square += float((points - points.mean(0)).square().sum(1).mean()) / 4
    rows = residuals_of(stage)(x)
    rays = 4 * len(LINES) * (pupil_grid(8).shape[0] // 2)
    assert float(rows[: 2 * rays].square().sum()) * SPOT_UNIT_MM**2 == pytest.approx(mean_square, rel=1e-12)
    assert not rows[2 * rays : 3 * rays].any()  # no ray fails


def test_the_judge_sees_the_published_lens_as_it_is():
    x, geo = published()
    spots = polychromatic_spots_um(geo, ("d",))
    assert spots == pytest.approx([1e3 * v for v in lens.rms_spot_mm(geo, JUDGED_FIELDS).tolist()], rel=1e-12)
    verdict = judge(x)
    assert verdict is not None
    assert verdict.rays_pass
    assert judge(torch.full((11,), 0.5, dtype=D)) is None  # radii of 2 mm pass no rays


def test_one_seed_reaches_the_published_lens():
    """From plane plates: better than twice the published spot, all limits held. The yardstick is what the
    study prints."""
    goal = 2 * sum(polychromatic_spots_um(published()[1])) / 3
    found = search("direct", 5, goal)
    assert found["succeeded"]
    verdict = judge(torch.tensor(found["variables"], dtype=D))
    assert verdict is not None
    assert verdict.mean_um <= goal
    surfaces = verdict.geo.to_surfaces()
    for i in (0, 2, 4):  # edges by hand
        height = max(surfaces[i].semi_aperture_mm, surfaces[i + 1].semi_aperture_mm)
        sag = [
            math.copysign(abs(s.radius_mm) - math.sqrt(s.radius_mm**2 - height**2), s.radius_mm)
            for s in surfaces[i : i + 2]
        ]
        assert surfaces[i].thickness_mm - sag[0] + sag[1] >= 1.0 - 1e-3
        assert surfaces[i].thickness_mm >= 1.0 - 1e-3
    assert sum(s.thickness_mm for s in surfaces) <= 75
