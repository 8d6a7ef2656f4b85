"""--tolerance of studies: what is chosen on a study's own scene holds for drives that it was not
chosen on; it is refused, and kept, like any option."""

from dataclasses import replace

import h5py
import pytest
import torch

import codesign
from codesign import events, flow, render
from codesign.fidelity import Fidelity
from codesign.fidelity.levels import camera_at
from codesign.system import load_hand_over
from scenes.dataset_motion import LEAD_S
from scenes.robots import pair as robot_pair
from scenes.robots.pairs import PAIRS
from studies.make_dataset import __main__ as make_dataset
from studies.placement import __main__ as placement
from studies.placement.problem import Problem, Samples
from tests import refusals
from tests.studies.browser import check_page
from tests.studies.runs import numbers, ran, stored

SET = "--trajectories 2 --frames 14 --size 32 --samples 8 --chunk 7 --rate-hz 90"


def rms(field):
    """Of the length of flow [..., 2, H, W]."""
    return float(field.double().square().sum(-3).mean().sqrt())


@torch.no_grad()
def flows(config, tries):
    """Flow that events without noise of a data set's camera tell on paths of the configuration's
    seed, in families that --tolerance did not look at."""
    maker = make_dataset.Maker(config, torch.device("cpu"))
    sensor = events.HardSensor(events.SensorModel(config.theta, config.theta), make_dataset.BINS)
    t_s = torch.arange(9, dtype=torch.float64) / config.rate_hz
    found = []
    for index in tries:
        frames = render.frames(maker.camera, maker.scene, maker.path(index)(LEAD_S + t_s))
        found.append(flow.estimate_lk(sensor(frames[None], t_s)).flow_px)
    return torch.cat(found)


def test_a_data_set_keeps_its_tolerance_on_paths_that_were_not_looked_at(tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(make_dataset.Sequence, "finish", interrupted)
        assert ran(make_dataset, f"{SET} --tolerance 0.3 --out", tmp_path / "set") == 130
    levels = stored(tmp_path / "set", "fidelity")["the data set"]["levels"]
    # a resumed run asks nobody
    monkeypatch.setattr(codesign, "select", None)
    assert ran(make_dataset, "--resume", tmp_path / "set") == 0
    with h5py.File(next((tmp_path / "set").glob("*/camera.h5"))) as file:
        assert file.attrs["level"] == levels["camera"] == "pinhole"
    found = numbers(tmp_path / "set")
    assert found["chosen_the_data_set_samples"] == levels["samples"] <= 8
    assert found["chosen_the_data_set_camera_pinhole"] == 1
    check_page("make_dataset", tmp_path / "set")
    config = make_dataset.Config(seed=5, frames=14, size=32, samples=32, rate_hz=90)
    chosen = replace(config, level=levels["camera"], samples=levels["samples"])
    fine, coarse = (flows(each, (2, 3, 4)) for each in (config, chosen))
    assert rms(coarse - fine) <= 0.3 < rms(fine)


def interrupted(sequence):
    raise KeyboardInterrupt


@refusals.table(__file__, "tolerances")
def test_a_tolerance_that_cannot_be_kept_is_one_sentence(row, refuses, tmp_path):
    refuses(make_dataset, row, SET)
    left = [path.name for path in tmp_path.rglob("*") if path.is_file()]
    assert set(left) <= {"config.json", ".lock"}


@pytest.mark.slow
def test_searches_for_a_mount_use_what_is_chosen_and_judges_do_not(tmp_path):
    sizes = "--pair outdoors --seeds 1 --steps 1 --worlds 1 --per-world 2 --judged-worlds 1 --judged-drives 1"
    out = tmp_path / "run"
    assert ran(placement, f"{sizes} --searches random --tolerance 2 --out", out) == 0
    levels = Fidelity(**stored(out, "fidelity")["the searches"]["levels"])
    pair = PAIRS["outdoors"]()
    problem = Problem(pair, robot_pair.unseen(1), 1, 8)
    handed = load_hand_over(out / "mount.yaml").camera
    assert handed.samples_per_pixel == problem.camera.samples_per_pixel > levels.samples
    found = numbers(out)
    assert found["hand_over_score_again"] == pytest.approx(found["hand_over_score"], rel=1e-9)
    # the same noise for both, in a world and drives that were not looked at
    samples = Samples((robot_pair.UNSEEN_FROM,), tuple(range(8)), 3)
    seen = []
    for camera in (problem.camera.with_samples(32), camera_at(problem.camera, levels)):
        problem.camera = camera
        with torch.no_grad():
            chain = problem.system(pair.design.mount()).begin(problem.scenes(samples))
        seen.append(chain["field"].flow_px)
    assert rms(seen[1] - seen[0]) <= 2 < rms(seen[0])
