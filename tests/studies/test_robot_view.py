"""The study of a robot's camera: its page, its drawn view, its refusals."""

import json
import math

import numpy as np
import pytest
import torch

from codesign import lens, render
from codesign.report import robot_figures
from scenes import robots
from studies import robot_view
from studies.frame.run import main


def test_the_page_shows_the_robot_and_counts_its_body_in_view(tmp_path):
    assert main(robot_view.study, robot_view.Config, ["--quick", "--out", str(tmp_path / "run")]) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    # four wheels and a mast of 48-gons (2 x 48 + 2 x 48 triangles), three boxes of 12
    assert metrics["faces"] == 5 * 4 * 48 + 3 * 12
    # chassis: its front edge lies 0.35 m below and 0.13 m ahead of the camera, which nods by 0.8
    row = math.tan(math.atan2(0.35, 0.13) - 0.8) / math.tan(math.radians(40))  # in half widths of the film
    assert (
        metrics["body_share"] < (0.75 - row) / 1.5 + 0.05
    )  # only the wheels' arcs rise above the edge's row
    assert metrics["body_share"] > 0.05
    assert (tmp_path / "run" / "report.html").is_file()


def test_the_drawn_view_is_that_of_the_camera():
    camera = render.Camera(lens.Pinhole(4.0), 40, 20, 0.1, 1)
    lines = robot_figures.view_lines(camera, robots.T_LINK_OPTICAL, 2.0)
    # 2 m ahead the film of 4 x 2 mm behind 4 mm is 2 x 1 m wide, in the axes of a link: x ahead, y left, z up
    np.testing.assert_allclose(
        lines[:4, 1], [[2, 1, 0.5], [2, -1, 0.5], [2, -1, -0.5], [2, 1, -0.5]], atol=1e-12
    )
    assert not lines[:4, 0].any()


def test_cut_triangles_cover_what_they_were_cut_from():
    generator = torch.Generator().manual_seed(0)
    triangles = torch.rand(5, 3, 3, generator=generator, dtype=torch.float64).numpy()
    parts, shade = robot_figures.cut(triangles, np.arange(5.0), 0.2)
    edges = np.linalg.norm(parts - np.roll(parts, -1, 1), axis=2)
    assert edges.max() <= 0.2

    def areas(of):
        return np.linalg.norm(np.cross(of[:, 1] - of[:, 0], of[:, 2] - of[:, 0]), axis=1) / 2

    np.testing.assert_allclose(np.bincount(shade.astype(int), areas(parts)), areas(triangles), rtol=1e-12)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--frame", "hand"], "no frame 'hand'; it has base_link"),
        (["--joint", "camera_nod=2"], "outside its limits, -0.6 to 1"),
        (["--joint", "camera_nod"], "give NAME=VALUE"),
        (["--joint", "camera_nod=up"], "must be a number"),
        (["--urdf", "nowhere.urdf"], "is not a file"),
        (["--field-deg", "200"], "field_deg must lie in"),
    ],
)
def test_what_cannot_be_shown_is_told_in_a_sentence(options, sentence, tmp_path, capsys):
    assert main(robot_view.study, robot_view.Config, [*options, "--out", str(tmp_path / "run")]) == 2
    assert sentence in " ".join(capsys.readouterr().err.split())
