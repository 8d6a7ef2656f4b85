"""Random worlds and their judge: shapes told apart by closed forms, a square whose frames are
known, and gradients that are right and wrong."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from codesign import backend, lens, pose
from codesign.render import MitsubaScene
from tests.hostile import judge, listed, outline_cases, random_worlds, worlds
from tests.scenes.solids import volume
from tests.studies.runs import lines

QUICK = judge.Effort(seeds=(4,))


def test_meshes_are_wound_outwards():
    """Volumes by the divergence theorem: of a ball below 4 pi / 3, of a ring below 2 pi^2 R r^2
    with R = 1 - r."""

    vertices, faces = outline_cases.icosphere(4)
    assert len(faces) == 5120
    assert 0.99 * 4 / 3 * math.pi < volume(vertices, faces) < 4 / 3 * math.pi
    rng = np.random.default_rng(3)
    assert 0.7 * 4 / 3 * math.pi < volume(*random_worlds.MESHES["fine"](rng)) < 4 / 3 * math.pi
    vertices, faces = random_worlds.MESHES["ring"](rng)
    thick = float(vertices[:, 2].max()) / math.sin(2 * math.pi * 2 / 9)
    ring = 2 * math.pi**2 * (1 - thick) * thick**2
    assert 0.85 * ring < volume(vertices, faces) < ring
    assert volume(*random_worlds.MESHES["hull"](rng)) > 0


def test_draws_are_the_same_every_time_and_cover_what_they_promise():
    draws = [random_worlds.draw(seed) for seed in range(60)]
    again = random_worlds.draw(7)
    assert again.facts == draws[7].facts
    assert torch.equal(again.T_world_cam, draws[7].T_world_cam)
    things = [thing for draw in draws for thing in draw.facts["things"]]
    assert {kind for kind, *_ in things} == set(random_worlds.KINDS)
    assert {how for _, how, *_ in things} == {*random_worlds.NEIGHBOURS, "moving"}
    assert {draw.facts["background"] for draw in draws} == set(random_worlds.BACKGROUNDS)
    assert sum("mirrored" in thing for thing in things) > 10
    assert sum(draw.facts["moving"] > 0 for draw in draws) > 5
    sizes = [px for _, _, px, *_ in things]
    assert min(sizes) < 0.5
    assert max(sizes) > 12


def test_a_square_is_judged_by_its_closed_form():
    """A bright rectangle along the pixels: coverage of every pixel is a product of two overlaps, so
    that the difference over a step to the side and ahead is known exactly; the boundary gradient is
    right, the interior one wrong."""
    mi = backend.mitsuba()
    T = mi.ScalarTransform4f
    half = 0.21
    square = {
        "type": "rectangle",
        "to_world": T().translate([0.013, 0.021, 2.0]).rotate([0, 1, 0], 180).scale(half),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 100.0}},
    }
    eye = torch.eye(4, dtype=torch.float64)
    case = judge.Case(MitsubaScene({"square": square}), lens.Pinhole(11.0), eye, 0.25, 24, 2.0, 5)
    px = 11.0 / 0.25

    def loss(dx, dz):
        def overlap(centre):
            low, high = (11.5 + px * (centre + sign * half) / (2 - dz) for sign in (-1, 1))
            edge = torch.arange(24, dtype=torch.float64)
            return ((edge + 0.5).clamp(max=high) - (edge - 0.5).clamp(min=low)).clamp(0, 1)

        image = 100 * overlap(0.021)[:, None] * overlap(0.013 - dx)
        return float((image * case.weight).mean())

    step = float(case.steps()[0, 0])
    assert step * px / 2 == pytest.approx(judge.STEP_PX)
    truth = {
        0: (loss(step, 0) - loss(-step, 0)) / 2,
        2: (loss(0, step) - loss(0, -step)) / 2,
    }
    effort = dataclasses.replace(QUICK, samples=512, poses=8)
    differences = torch.stack([judge.differences(case, effort, k) for k in range(4)]).mean(0)
    whole = torch.stack([judge.gradient(case, effort, k, "boundary") for k in range(4)]).mean(0)
    for k, value in truth.items():
        assert float(differences[k]) == pytest.approx(value, rel=0.02)
        assert float(whole[k]) == pytest.approx(value, rel=0.02)
    assert judge.judge(case, effort=QUICK).verdict == "right"
    left_out = judge.judge(case, "interior", QUICK)
    assert left_out.verdict == "wrong"
    assert left_out.error == pytest.approx(1, abs=1e-6)


def test_a_verdict_weighs_errors_by_their_noise():
    truth = torch.ones(4, 6, dtype=torch.float64)
    sizes = torch.tensor([0.4, 1.5, 0.7, 1.4], dtype=torch.float64)
    shaken = truth * sizes[:, None]
    for verdict, differences, gradient in (
        ("right", truth, 1.04 * truth),
        ("near", truth, 1.08 * truth),
        ("wrong", truth, 0.88 * truth),
        ("empty", 0 * truth, 0 * truth),
        ("doubtful", shaken, truth),
        ("noisy", truth, shaken),
    ):
        found = judge.compared(differences, gradient, 0 * truth[0])
        assert found.verdict == verdict
    assert found.noise == pytest.approx(float(sizes.std()) / 2, rel=1e-6)


def test_random_worlds_are_judged_once_and_counted(tmp_path):
    """Two worlds of which one is known from an earlier call, as wrong and refused as it can be."""
    path = tmp_path / "worlds.jsonl"
    known = {"pinhole": judge.Judged("near", 0.08, 0.01)}
    known |= {"thin": judge.Judged("refused", sentence="too thin")}
    known |= {"traced": judge.Judged("doubtful", 0.3, 0.2)}
    rows = [{"world": 0, "lens": kind, **found.row()} for kind, found in known.items()]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    told = []
    figures, findings = worlds.measure(2, 0, told.append, path)
    assert (figures["worlds_judged"], figures["worlds_right"], figures["worlds_wrong"]) == (4, 3, 1)
    assert figures["worlds_noisy"] == figures["worlds_refused"] == 1
    assert findings[0] == "world 0 through the lens 'pinhole' is 8.0% wrong at a noise of 1.0%."
    assert findings[1:] == ["1 of 6 random worlds are refused, 3% may be."]
    judged = [row for row in lines(path) if row["world"] == 1]
    assert all(row["verdict"] == "right" and row["interior"] > 0.5 for row in judged)
    assert worlds.measure(2, 0, told.append, path) == (figures, findings)
    assert told == []


@pytest.mark.parametrize(
    "name",
    ["facets", "t_junction", "sphere_in_floor", "cylinder_in_floor", "crossing_mesh", "defocus"],
)
def test_gradients_of_listed_worlds_are_right_and_need_their_silhouettes(name):
    found = judge.judge(listed.case_of(outline_cases.CASES[name](), "pinhole"), effort=QUICK)
    assert found.verdict == "right", found
    assert found.interior > 2 * found.error


def test_a_listed_world_is_told_from_a_wrong_gradient():
    case = listed.case_of(outline_cases.far_pole(20), "pinhole")
    assert listed.passes("far_pole_20", judge.judge(case, effort=QUICK))
    assert not listed.passes("far_pole_20", judge.judge(case, "interior", QUICK))
    refused = judge.Judged("refused", sentence="two shapes pass through each other")
    assert listed.passes("sphere_in_floor", refused)
    assert not listed.passes("poles", refused)


def test_the_camera_of_a_listed_world_looks_along_y_and_is_rolled():
    world = outline_cases.sphere_in_floor()
    forward = world.T_world_cam[:3, 2]
    torch.testing.assert_close(forward, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    turned = pose.look_at((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))[:3, 0] @ world.T_world_cam[:3, 0]
    assert float(turned) == pytest.approx(math.cos(0.3))
