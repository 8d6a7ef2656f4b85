"""Projection by a table against traced rays."""

from typing import Literal

import pytest
import torch

from codesign import lens, render
from codesign.render import Camera
from codesign.render.projection import TOLERANCE_PX, ProjectionTable
from studies.make_dataset import __main__ as study

D = torch.float64


def camera(name="cooke-triplet", size=24, level: Literal["traced", "thin", "pinhole"] = "traced"):
    return study.make_camera(study.Config(lens=name, size=size, samples=2, level=level))


@pytest.mark.parametrize(
    ("name", "level"),
    [
        ("cooke-triplet", "traced"),
        ("double-gauss", "traced"),
        ("cooke-triplet", "thin"),
        ("cooke-triplet", "pinhole"),
    ],
)
def test_the_table_projects_as_traced_rays_do(name, level):
    with torch.no_grad():
        cam = camera(name, level=level)
        table = ProjectionTable(cam)
        assert table.series is not None
        draw = torch.rand(400, 3, generator=torch.Generator().manual_seed(0), dtype=D)
        depth = 0.3 * 100 ** draw[:, 2:]
        # within and beyond the field
        points = torch.cat([(draw[:, :2] - 0.5) * 0.9 * depth, depth], 1)
        pixels, base, slope = table(points)
        truth = render.project(cam, points)
        assert torch.equal(pixels.isnan(), truth.isnan())
        seen = truth.isfinite().all(1)
        assert 0.2 < float(seen.double().mean()) <= 1
        torch.testing.assert_close(pixels[seen], truth[seen], rtol=0, atol=TOLERANCE_PX)
        # the ray it names passes through the point: 1e-6 px of a 250 px focal length
        torch.testing.assert_close(
            base[seen] + slope[seen] * points[seen, 2:], points[seen, :2], rtol=0, atol=1e-8 * 30
        )


def test_a_film_larger_than_the_field_is_projected_by_tracing():
    with torch.no_grad():
        cam = Camera(lens.load("double-gauss").freeze(), 12, 12, 12.0, 1)
        table = ProjectionTable(cam)
        assert table.series is None
        points = torch.tensor([[0.1, 0.2, 2.0], [0.0, 0.0, 1.0]], dtype=D)
        torch.testing.assert_close(table(points)[0], render.project(cam, points), rtol=0, atol=0)
