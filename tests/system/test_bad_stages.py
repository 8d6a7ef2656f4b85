"""Stages cut, wrapped and misshapen on purpose are named by ``check`` or refused; unusual ones that
are right are not."""

import functools
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import nn

from codesign import events
from codesign.errors import CodesignError, DomainError, ShapeError
from codesign.system import Batch, System
from codesign.types import FlowField
from tests.hostile import stages as s
from tests.hostile.stages import (
    BATCH,
    SIDE,
    T_S,
    counted,
    field_of,
    flow_of,
    glass,
    held,
    moved,
    of,
)


def truth(px, valid=True):
    seen = {"error": lambda field, truth: (field.flow_px - truth.flow_px.detach()).square().mean()}
    known = torch.ones(len(px), SIDE, SIDE, dtype=torch.bool) if valid else px[:, 0]
    return of(objectives=seen, batch=replace(BATCH, truth=FlowField(px, known, 0.02)))


def placed(frames, t_s, /):
    return frames


def helper(volume):
    return NET(volume)


NET, GAIN = s.Convolution(), nn.Parameter(torch.ones(()))
PX = torch.ones(2, 2, SIDE, SIDE)
BAD = {
    "hard sensor": ("events", of(events=s.HARD_SENSOR)),
    "pose cut": (
        "flow.*T_world_cam",
        of(flow=lambda v, T_world_cam: flow_of(v, T_world_cam.detach().mean())),
    ),
    "objective cuts": (
        "'a'.*'estimate'",
        of(
            objectives={
                "a": lambda estimate, field: s.error(estimate.detach()) + field.flow_px.mean()
            }
        ),
    ),
    "flow of one drive": ("'flow' holds 1", of(flow=lambda v: field_of(moved(v)[:1]))),
    "flow [N, 2, 1, 1]": (
        "flow",
        of(flow=lambda v: s.entry("flow_px", lambda t: t[..., :1, :1])(flow_of(v))),
    ),
    "confidence [N, 1, H, W]": (
        "flow",
        of(flow=lambda v: replace(flow_of(v), confidence=moved(v)[:, :1])),
    ),
    "covariance of two": ("flow", of(flow=lambda v: replace(flow_of(v), covariance_px2=moved(v)))),
    "truth [N, 2, 1, 1]": ("truth", truth(PX[..., :1, :1])),
    "truth [N, 1, H, W]": ("truth", truth(PX[:, :1])),
    "truth [1, 2, H, W]": ("'truth' holds 1", truth(PX[:1])),
    "truth valid of floats": ("truth", truth(PX, valid=False)),
    "frames of one drive": ("'frames' holds 1", of(render=s.picture(after=lambda f: f[:1]))),
    "frames on 0 to 1": (
        "scale is 0 to 255",
        of(render=s.picture(after=lambda f: (f - f.min()) / 255)),
    ),
    "counts below 0": ("0 or more", of(events=lambda f: counted(f) - 1)),
    "rays as a tensor": ("camera", of(camera=s.Camera(glass(), lambda r: r.direction))),
    "mounts of three drives": ("mount", of(mount=held(lambda T: T.expand(3, 4, 4)))),
    "trajectory of T - 1": (
        "trajectory",
        of(trajectory=lambda: s.DRIVES[1:5], batch=Batch(None, T_S, "waves")),
    ),
    "times in ms": ("milliseconds", of(batch=replace(BATCH, t_s=1e3 * T_S))),
    "times that stand still": ("increase strictly", of(batch=replace(BATCH, t_s=0 * T_S))),
    "float64 network": (
        "float64 on cpu.*float32 on cpu.*'events'",
        of(flow=s.Convolution().double()),
    ),
    "weights without values": (
        "'flow.0.weight' is on the device meta",
        of(flow=s.Convolution().to("meta")),
    ),
    "hidden in a global": ("does not see", of(flow=lambda volume: helper(volume))),
    "hidden parameter": ("does not see", of(events=lambda frames: counted(frames, GAIN))),
    "hidden mount": ("does not see", of(mount=s.closed(held()))),
    "hidden camera": ("does not see", of(camera=s.closed(functools.partial(s.Camera, glass())))),
    "hidden in an objective": (
        "does not see",
        of(objectives={"a": lambda volume: NET(volume).flow_px.mean()}),
    ),
    "in place on the batch": (
        "in place",
        of(mount=None, render=s.picture(poses=lambda T: T.mul_(1.01))),
    ),
    "in place on times": (
        "in place",
        of(flow=lambda volume, t_s: (t_s.add_(1), flow_of(volume))[1]),
    ),
    "takes no input": ("flow.*takes no input", of(flow=lambda: None)),
    "takes another first": ("names its first argument 't", of(flow=lambda truth, volume: None)),
    "more by position": ("'t_s' by position alone", of(events=placed)),
    "asks for what is not": ("asks for 'theta'", of(events=lambda frames, theta: frames)),
    "asks for what comes after": ("in a circle: '", of(events=lambda frames, field: frames)),
    "a class": ("is the class", of(flow=s.Convolution)),
    "a string": ("is a str", of(flow="refiner")),
    "no objective": ("at least one objective", of(objectives={})),
    "a gradient of no kind": ("gradient must be .* got 'exact'", of(gradient="exact")),
    "said to cut, of no stage": ("may_cut is", of(may_cut=("event",))),
    "one variable of 0": (
        "'estimate.gain' is exactly 0",
        of(estimate=s.Stage(lambda f, gain: s.mean_flow(f) + 0 * gain)),
    ),
}


@pytest.mark.parametrize("name", [*BAD, *s.BAD])
def test_bad_stages_are_named(name):
    said, parts = (BAD | s.BAD)[name]
    assert s.outcome(parts, f"(?s){said}") is None


@pytest.mark.parametrize("name", s.GOOD)
def test_unusual_stages_that_are_right_pass(name):
    torch.manual_seed(0)
    assert s.outcome(s.GOOD[name], None) is None


def test_random_combinations_of_them():
    figures, findings = s.measure(12, 0, say=lambda finding: None)
    assert figures["stages_named"] == figures["stages_right_passed"] == 12, findings


def test_a_silent_network_runs_no_more_often_for_more_weights():
    net, calls = s.zeroed(s.Convolution()), []
    net.register_forward_hook(lambda *_: calls.append(1))
    s.checked(flow=net)
    # the pass, one beside, its input moved and not, its weights moved and not
    assert len(calls) <= 6


def brighter(mount, rays, T_world_cam):
    return mount()[0, 0].float() * s.picture()(rays, T_world_cam)


def scaled(field, scale):
    return scale()[0, 0] * s.mean_flow(field)


WRAPPED = [
    ("flow", 4, NET.forward),
    ("flow", 4, NET.method),
    ("flow", 4, functools.partial(NET)),
    ("flow", 4, functools.partial(NET.forward)),
    ("flow", 4, functools.partial(functools.partial(lambda net, v, gain: net(v), NET), gain=2.0)),
    ("events", 2, events.layer("counts").volume),
    ("mount", 1, held().forward),
    ("camera", 2, functools.partial(s.Camera, glass())),
    ("render", 1, functools.partial(brighter, held())),
    ("estimate", 1, functools.partial(scaled, scale=held())),
    (
        "objectives",
        4,
        {"a": functools.partial(lambda net, volume: net(volume).flow_px.mean(), NET)},
    ),
]


@pytest.mark.parametrize(("part", "count", "given"), WRAPPED)
def test_methods_and_partials_bring_their_weights(part, count, given):
    names = [name for name, _ in s.checked(**{part: given})[0].named_parameters()]
    assert len([name for name in names if name.startswith(f"{part}.")]) == count


@pytest.mark.parametrize(
    ("name", "meant"),
    [("netwrk", "'flow'"), ("event", "'events'"), ("flwo", "'flow'"), ("qqq", "it has camera")],
)
def test_a_part_of_another_name_is_told_the_nearest(name, meant):
    parts: Any = {name: 1}
    with pytest.raises(DomainError, match=f"no part '{name}'.*{meant}"):
        System(**parts)


@pytest.mark.parametrize("channels", [8, 7])
def test_a_network_of_other_bins_is_told_both_numbers(channels):
    class Mine(nn.Module):
        def __init__(self):
            super().__init__()
            self.layers = nn.Sequential(nn.Conv2d(channels, 2, 3, padding=1))

        def forward(self, volume):
            return field_of(self.layers(volume.counts.float().flatten(1, 2)))

    says = f"{channels} channels, and the volume has 2 bins of two polarities, 4 channels"
    with pytest.raises(ShapeError, match=says):
        s.checked(flow=Mine())


def test_typos_are_refused():
    with pytest.raises(CodesignError, match="did you mean 'events'"):
        s.checked()[0].event = s.layer()
