"""video_to_events --upsample: the events of a moving grating at the times its closed form gives, in any
chunks."""

import json
import math

import numpy as np
import torch

from codesign import events
from studies.frame.run import main
from studies.video_to_events import __main__ as study

SPEED_PX = 3.0
PERIOD_PX = 14.0
RATE_HZ = 100.0


def grating(count, height=24, width=56):
    """[T, H, W] float32 whose log is a sinusoid that moves to the right."""
    x = np.arange(width) - SPEED_PX * np.arange(count)[:, None, None]
    return np.broadcast_to(
        np.exp(4.5 + 0.55 * np.sin(2 * math.pi * x / PERIOD_PX)), (count, height, width)
    ).astype(np.float32)


def call(folder, *arguments):
    return main(study.study, study.Config, ["--out", str(folder), *map(str, arguments)])


def test_a_grating_fires_when_its_closed_form_crosses_in_any_chunks(tmp_path, monkeypatch):
    monkeypatch.setattr(study.pages, "pictures", lambda view: None)
    np.save(tmp_path / "in.npy", grating(9))
    options = ["--input", tmp_path / "in.npy", "--fps", RATE_HZ, "--preset", "ideal", "--events", "e.npz"]
    assert call(tmp_path / "up", *options, "--upsample", 0.5) == 0
    assert call(tmp_path / "kept", *options) == 0
    found, kept = (events.read(tmp_path / name / "e.npz") for name in ("up", "kept"))
    monkeypatch.setattr(study, "PIXELS_PER_CHUNK", 2 * 24 * 56)
    assert call(tmp_path / "chunks", *options, "--upsample", 0.5) == 0
    assert (tmp_path / "chunks" / "e.npz").read_bytes() == (tmp_path / "up" / "e.npz").read_bytes()

    # the truth: 2000 steps per second of the same grating; pixels whose light of the last frame was always
    # inside the picture
    t_s = torch.arange(0, 161, dtype=torch.float64) / 2000
    x = torch.arange(56) - SPEED_PX * RATE_HZ * t_s[:, None, None]
    level = 4.5 + 0.55 * torch.sin(2 * math.pi * x / PERIOD_PX)
    truth = events.simulate(level.exp().expand(-1, 24, -1).contiguous(), t_s, events.SensorModel())
    totals = [events.to_counts(each, [0.0, 0.08])[0][..., 28:-4].sum() for each in (truth, found, kept)]
    # cut by 1 - cos(pi 0.5 / 14) = 0.6 % of 1.1 log units, an event of 0.2 more or less per half period of 5
    # events at worst in one pixel of 30
    assert abs(float(totals[1] / totals[0]) - 1) < 0.05
    # straight lines over 3 of 14 px cut 1 - cos(3 pi / 14) = 22 % off half of the peaks
    assert float(totals[2] / totals[0]) < 0.95
    metrics = json.loads((tmp_path / "up" / "metrics.json").read_text())
    assert metrics["frames"] == 9
    assert metrics["simulated_frames"] >= 1 + 8 * 6  # 3 px in steps of half a pixel


def test_a_bound_that_cannot_be_is_one_sentence(tmp_path, capsys):
    np.save(tmp_path / "in.npy", grating(3))
    assert call(tmp_path / "run", "--input", tmp_path / "in.npy", "--fps", 30, "--upsample", 0) == 2
    assert "--upsample is 0" in capsys.readouterr().err
