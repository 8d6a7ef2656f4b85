"""Controls of the joint race: what each of them takes away, and ratios of known errors."""

import json
from types import SimpleNamespace

import pytest
import torch

from codesign import render
from codesign.pose import look_at
from codesign.types import EventVolume
from scenes.robots import pair as robot_pair
from studies import joint_controls
from studies.codesign.design import Space, Whole
from studies.codesign.problem import Drawn
from tests import refusals
from tests.studies.browser import check_page
from tests.studies.runs import numbers, ran

F = torch.float64
SETTING = {"pair": "outdoors", "family": None, "light": 1.0, "speed": 1.0, "free": [], "held": {}}


class Stage(torch.nn.Module):
    """One event where a frame is brighter than the last, in the bin of that frame."""

    def volume(self, frames, t_s, bins, generator=None):
        rise = (frames.diff(dim=1) > 0).to(F)
        return EventVolume(torch.stack([rise, 0 * rise], 1), t_s[1:], t_s.diff())


@pytest.fixture(scope="module")
def frames():
    return torch.rand(2, 5, 4, 6, generator=torch.Generator().manual_seed(1), dtype=F)


def test_shuffled_events_are_as_many_at_every_pixel_in_another_order(frames):
    t_s = torch.linspace(0, 1, 5, dtype=F)
    plain = Stage().volume(frames, t_s, 4).counts
    shuffled = joint_controls.Shuffled(Stage()).volume(frames, t_s, 4).counts
    assert torch.equal(shuffled.sum(2), plain.sum(2))
    # of four bins in random order a quarter of the events stays where it was
    stayed = float((shuffled * plain).sum() / plain.square().sum())
    assert 0.3 < stayed < 0.8
    assert not torch.equal(shuffled, plain)


def test_frames_without_contrast_have_no_events(frames):
    made = joint_controls.Bland(Stage()).volume(frames, torch.linspace(0, 1, 5, dtype=F), 4)
    assert made.counts.shape == (2, 2, 4, 4, 6)
    assert float(made.counts.sum()) == 0


def test_the_pinhole_shows_an_even_wall_evenly(monkeypatch):
    space = Space.of(**{**SETTING, "family": "retrofocus-4"})
    seen = []
    monkeypatch.setattr(joint_controls, "looked", lambda drawn, whole: seen.append(whole) or whole)
    monkeypatch.setattr(Whole, "hard", lambda whole: whole, raising=False)
    joint_controls.without_blur(None, space.made(space.start), 0)
    wall = render.TexturedPlane([[0.0, 0.0]], [0.0], [0.0])
    films = render.frames(seen[0].camera, wall, look_at((0, -2, 0), (0, 0, 0))[None])
    assert float(films.max() / films.min()) < 1 + 1e-6


def test_a_mount_without_errors_is_judged_as_designed_and_one_with_a_turn_is_not(monkeypatch):
    space = Space.of(**SETTING)
    drawn = Drawn(space, robot_pair.unseen(1), 1, 1)
    whole = space.made(space.start)
    plainly = joint_controls.as_designed(drawn, whole, 0)
    monkeypatch.setattr(joint_controls, "MADE", {"z_m": lambda value, deviate: value})
    assert torch.allclose(joint_controls.made_and_mounted(drawn, whole, 0), plainly, rtol=1e-9)
    # a camera that looks 20 degrees lower than its robot believes takes another velocity for true
    turned = {"pitch_rad": lambda value, deviate: value + 0.35}
    monkeypatch.setattr(joint_controls, "MADE", turned)
    assert not torch.allclose(
        joint_controls.made_and_mounted(drawn, whole, 0), plainly, rtol=1e-3, atol=1e-4
    )


def raw(path):
    rows = {(0, "joint"): 0.1, (0, "book"): 0.4, (1, "joint"): 0.2, (1, "book"): 0.8}
    with path.open("w") as file:
        for (seed, arm), error in rows.items():
            row = {"setting": SETTING | {"free": ["z_m"]}, "share": [error], "errors": [error]}
            file.write(json.dumps([{"seed": seed, "arm": arm}, [row]]) + "\n")
    return path


def test_ratios_are_those_of_the_errors_under_each_control(tmp_path, monkeypatch):
    known = {
        "as designed": lambda drawn, share, seed: share,
        "worse for the one": lambda drawn, share, seed: share * (2 if share[0] < 0.3 else 1),
    }
    monkeypatch.setattr(joint_controls, "CONTROLS", known)
    space = SimpleNamespace(made=lambda share: share.repeat(4), pair=SimpleNamespace(name="x"))
    monkeypatch.setattr(joint_controls, "space_of", lambda setting: space)
    monkeypatch.setattr(joint_controls, "Drawn", lambda *_: None)
    given = "--arms joint book --judged-worlds 2 --out"
    answers = ("--raw", raw(tmp_path / "raw.jsonl"))
    assert ran(joint_controls, given, tmp_path / "run", *answers) == 0
    found = numbers(tmp_path / "run")
    assert found["as_designed_joint_over_book"] == pytest.approx(0.25)
    assert found["worse_for_the_one_joint_over_book"] == pytest.approx(0.5)
    check_page("joint_controls", tmp_path / "run")


@refusals.table(__file__, "joint_controls")
def test_answers_that_are_not_there_are_refused(row, refuses, tmp_path):
    raw(tmp_path / "raw.jsonl")
    refuses(joint_controls, row)
