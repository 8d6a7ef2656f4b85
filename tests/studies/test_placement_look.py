"""A robot and its camera before a search: its page, and how robots and views are drawn."""

import numpy as np
import torch

from codesign import lens, render
from codesign.report import robot_figures
from scenes import robots
from studies.placement import __main__ as placement
from tests.studies.browser import check_page
from tests.studies.runs import numbers, ran


def test_the_page_shows_the_robot_and_counts_its_body_in_view(tmp_path):
    """The rover that comes along, its camera so high and steep that the chassis is in view."""
    page = tmp_path / "robot.yaml"
    page.write_text(
        f"robot: {robots.ROVER}\nwithout: [camera_link]\n"
        "camera:\n  low_m: [0.1, -0.1, 0.5]\n  high_m: [0.3, 0.1, 0.9]\n"
    )
    out = tmp_path / "run"
    assert ran(placement, "--look --out", out, "--robot", page) == 0
    metrics = numbers(out)
    # four wheels and a mast of 48-gons (2 x 48 + 2 x 48 triangles), two boxes of 12 without the
    # camera's
    assert metrics["faces"] == 5 * 4 * 48 + 2 * 12
    assert 0 <= metrics["own_body_share"] < 0.5
    assert 0 < metrics["downward_forward_m_s"] < metrics["forward_forward_m_s"]
    for name in ("report.html", "robot.png", "sight.png"):
        assert (out / name).is_file()
    check_page("placement", out)


def test_the_drawn_view_is_that_of_the_camera():
    camera = render.Camera(lens.Pinhole(4.0), 40, 20, 0.1, 1)
    lines = robot_figures.view_lines(camera, robots.T_LINK_OPTICAL, 2.0)
    # 2 m ahead the film of 4 x 2 mm behind 4 mm is 2 x 1 m wide, in the axes of a link: x ahead, y
    # left, z up
    corners = [[2, 1, 0.5], [2, -1, 0.5], [2, -1, -0.5], [2, 1, -0.5]]
    np.testing.assert_allclose(lines[:4, 1], corners, atol=1e-12)
    assert not lines[:4, 0].any()


def test_corners_without_light_are_where_a_pinhole_sees_them():
    camera = render.Camera(lens.load("cooke-triplet"), 40, 30, 1.5, 1)  # 60 x 45 mm behind 50 mm
    drawn = robot_figures.view_lines(camera, torch.eye(4, dtype=torch.float64), 1.0)
    expected = np.array([-1, -1]) * [20, 15] * camera.slope_per_px()
    np.testing.assert_allclose(drawn[0, 1, :2], expected)


def test_cut_triangles_cover_what_they_were_cut_from():
    generator = torch.Generator().manual_seed(0)
    triangles = torch.rand(5, 3, 3, generator=generator, dtype=torch.float64).numpy()
    parts, shade = robot_figures.cut(triangles, np.arange(5.0), 0.2)
    edges = np.linalg.norm(parts - np.roll(parts, -1, 1), axis=2)
    assert edges.max() <= 0.2

    def areas(of):
        return np.linalg.norm(np.cross(of[:, 1] - of[:, 0], of[:, 2] - of[:, 0]), axis=1) / 2

    np.testing.assert_allclose(
        np.bincount(shade.astype(int), areas(parts)), areas(triangles), rtol=1e-12
    )
