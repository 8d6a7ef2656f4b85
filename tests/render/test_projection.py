"""Projection by a table against traced rays."""

from typing import Literal

import pytest
import torch

from codesign import lens, render
from codesign.render import Camera
from codesign.render.projection import TOLERANCE_PX, ProjectionTable
from studies.make_dataset import __main__ as study
from tests.numbers import close, f64, rand64, seeded


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
        draw = rand64(seeded(0), 400, 3)
        depth = 0.3 * 100 ** draw[:, 2:]
        # within and beyond the field
        points = torch.cat([(draw[:, :2] - 0.5) * 0.9 * depth, depth], 1)
        pixels, base, slope = table(points)
        truth = render.project(cam, points)
        assert torch.equal(pixels.isnan(), truth.isnan())
        seen = truth.isfinite().all(1)
        assert 0.2 < seen.double().mean() <= 1
        close(pixels[seen], truth[seen], atol=TOLERANCE_PX)
        # the ray it names passes through the point: 1e-6 px of a 250 px focal length
        close(base[seen] + slope[seen] * points[seen, 2:], points[seen, :2], atol=1e-8 * 30)


def test_a_film_larger_than_the_field_is_projected_by_tracing():
    with torch.no_grad():
        cam = Camera(lens.load("double-gauss").freeze(), 12, 12, 12.0, 1)
        table = ProjectionTable(cam)
        assert table.series is None
        points = f64([[0.1, 0.2, 2.0], [0.0, 0.0, 1.0]])
        close(table(points)[0], render.project(cam, points))
