"""The study of what mounts are blind to: its page and its figures."""

import json
import math

import pytest

from studies import mount_sight
from studies.frame.run import main


def test_the_page_has_tables_and_spheres(tmp_path):
    assert (
        main(
            mount_sight.study,
            mount_sight.Config,
            ["--rows", "4", "--columns", "4", "--out", str(tmp_path / "run")],
        )
        == 0
    )
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    # straight down from height h, forward is measured by f / h: three times worse at three times the height
    low, high = (metrics[f"free_over_ground_{h}_m_downward_forward_m_s"] for h in ("0_4", "1_2"))
    assert high == pytest.approx(3 * low, rel=1e-6)
    # turns about the ground below are as visible from any height
    low, high = (metrics[f"free_over_ground_{h}_m_downward_pitch_rad_s"] for h in ("0_4", "1_2"))
    assert high == pytest.approx(low, rel=1e-6)
    # a robot before which nothing is seen knows its prior, 1 in units of 0.1
    assert metrics["ground_robot_worst_error"] == pytest.approx(10.0)
    assert math.isfinite(metrics["free_in_a_room_best_error"])
    assert len(list((tmp_path / "run").glob("sphere_*.png"))) == 4


def test_sizes_are_checked(tmp_path, capsys):
    assert main(mount_sight.study, mount_sight.Config, ["--rows", "1", "--out", str(tmp_path / "run")]) != 0
    assert "rows and columns must be at least 2" in capsys.readouterr().err
