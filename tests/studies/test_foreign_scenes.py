"""The study of scenes that others wrote: its figures on one of them, its refusals."""

import json

import pytest

from codesign.errors import DomainError
from studies import foreign_scenes
from studies.frame.run import main


def test_a_scene_is_the_picture_that_mitsuba_makes(tmp_path):
    options = ["--quick", "--scene", "terrace", "--gradient-samples", "0", "--out", str(tmp_path / "run")]
    assert main(foreign_scenes.study, foreign_scenes.Config, options) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    noise = metrics["foreign_terrace_mean_noise"]
    assert metrics["foreign_terrace_mean_ratio"] == pytest.approx(1, abs=5 * noise)
    assert noise < 0.01
    # 768 pixels, 16 pairs of pictures that share four: the ratio of two RMS is good to 5 %
    assert metrics["foreign_terrace_rms_over_noise"] < 1.1
    assert metrics["foreign_terrace_baked_rms_after_gain"] < 0.2  # 8 paths per texel
    assert (tmp_path / "run" / "report.html").is_file()


def test_a_scene_that_is_none_is_named():
    with pytest.raises(
        DomainError, match=r"there is no scene 'attic'; choose from cornell, .* or give an \.xml"
    ):
        foreign_scenes.source_of("attic")
