"""The system before rendered scenes: what a user brings together, and what is refused before the
first step."""

import copy

import pytest
import torch

import codesign
from codesign import System, events, flow, lens, pose, render
from codesign.errors import DomainError, GradientError
from codesign.system import Batch, check
from scenes import textures, trajectories, worlds

T_S = torch.linspace(0, 0.05, 5, dtype=torch.float64)
START = pose.look_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def wall():
    return worlds.wall(textures.speckle(1, size_px=128), texel_m=0.01)


def endpoint_error(field, truth):
    return ((field.flow_px - truth.flow_px).square().sum(1) + 1e-4).sqrt().mean()


def system_of(geo, scene, **parts):
    camera = render.Camera(geo, 32, 32, 0.037, samples_per_pixel=4)
    usual = {
        "events": events.layer("counts"),
        "flow": flow.estimate_lk,
        "objectives": {"error": endpoint_error},
    }
    return System(camera=camera, scene=scene, **{**usual, **parts})


def batch(count=2):
    velocities = torch.tensor([[0.5, 0.1, 0.0], [-0.3, 0.2, 0.1]], dtype=torch.float64)[:count]
    return Batch(
        torch.stack([trajectories.translation(START, v, T_S) for v in velocities.tolist()]), T_S
    )


def triplet():
    return lens.load("cooke-triplet").scaled(0.22)


def test_a_deep_copy_shares_the_scene_and_nothing_else(wall):
    geo = triplet()
    geo.variables("focus", step_mm=0.02)
    system = system_of(geo, wall)
    before = system(batch()).loss.item()
    twin = copy.deepcopy(system)
    assert twin.scene is wall
    with torch.no_grad():
        for parameter in twin.lens.parameters():
            parameter.add_(5.0)
    assert twin(batch()).loss.item() != pytest.approx(before, rel=1e-3)
    assert system(batch()).loss.item() == pytest.approx(before, rel=1e-6)


def test_an_estimate_of_ones_own_kind_is_left_out_of_the_picture(wall):
    run = system_of(triplet(), wall, flow=lambda volume: volume.counts).begin(batch(1))
    assert codesign.show(run).axes[3].get_title() == "flow, true"


def test_saved_and_loaded_it_is_the_same_system(wall):
    def made():
        geo = triplet()
        geo.variables("curvature", "focus")
        return system_of(geo, wall)

    first = made()
    with torch.no_grad():
        for parameter in first.parameters():
            parameter.add_(0.3)
    second = made()
    second.load_state_dict(first.state_dict())
    assert second(batch()).loss.item() == pytest.approx(first(batch()).loss.item(), rel=1e-6)


def test_the_gradient_of_choice_is_found_for_a_lens_with_variables(wall):
    geo = triplet()
    variables = geo.variables("curvature", "focus")
    losses = []
    slopes = []
    # a wall that fills the view has no silhouette: both are the same
    for way in ("auto", "interior"):
        result = system_of(geo, wall, gradient=way)(batch())
        slopes.append(torch.cat(torch.autograd.grad(result.loss, variables)))
        losses.append(result.loss.item())
    assert losses[0] == pytest.approx(losses[1], rel=1e-6)
    torch.testing.assert_close(slopes[0], slopes[1], rtol=1e-3, atol=1e-6)


def test_a_lens_focused_once_from_its_variables_is_refused(wall):
    geo = triplet()
    variables = geo.variables("curvature")
    once = system_of(geo.focus_at(2.0), wall)
    with pytest.raises(
        GradientError, match=r"computed once from other tensors \(focus_at, replace\)"
    ):
        check(once, batch(), variables)
    kept = triplet()
    focused = kept.variables("curvature", focus_at_m=2.0)
    check(system_of(kept, wall), batch(), focused)


def test_a_moving_object_has_a_truth(wall):
    shift = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    shift[:, 0, 3] = 0.8 * T_S
    scene = render.MovingScene(worlds.blank_room(size_m=(8.0, 8.0, 8.0)), {"wall": (wall, shift)})
    still = START.expand(1, 5, 4, 4)
    truth = system_of(lens.Pinhole(8.0), scene).begin(Batch(still, T_S))["truth"]
    assert truth.interval_s == pytest.approx(0.05, rel=1e-12)
    # 0.04 m to the right at 2 m, 8 mm behind the pinhole: 0.16 mm on pixels of 37 um
    assert float(truth.flow_px[0, 0, 16, 16]) == pytest.approx(
        0.8 * 0.05 / 2.0 * 8.0 / 0.037, rel=1e-3
    )


@pytest.mark.parametrize("lead", [0, 1, 3])
def test_the_truth_is_of_the_interval_whose_events_are_read(wall, lead):
    lead_s = float(T_S[lead])
    settled = events.Settled(events.layer("counts"), lead_s)
    run = system_of(triplet(), wall, events=settled).begin(batch())
    truth = run["truth"]
    assert truth.interval_s == pytest.approx(run["field"].interval_s, abs=1e-12)
    asked = batch().T_world_body[:, [lead, -1]]
    flow_px, valid = render.true_flow(run["camera"], wall, asked)
    torch.testing.assert_close(truth.flow_px, flow_px[:, 0])
    assert torch.equal(truth.valid, valid[:, 0])


def test_a_lead_between_frames_has_no_truth(wall):
    between = events.HardSensor(events.SensorModel(), 4, 0.014)
    run = system_of(triplet(), wall, events=between).begin(batch())
    with pytest.raises(DomainError, match=r"no frame but the last stands 0.014 s after the first"):
        _ = run["truth"]
