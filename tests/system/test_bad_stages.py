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
from codesign.system import System
from codesign.types import FlowField
from tests import refusals
from tests.hostile import stages as s
from tests.hostile.stages import (
    BATCH,
    SIDE,
    field_of,
    glass,
    held,
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


@refusals.table(__file__, "bad stages")
def test_bad_stages_are_named(row):
    parts = eval(row.call, vars(s) | globals())
    assert s.outcome(parts, f"(?s){row.sentence}") is None


@pytest.mark.parametrize("name", s.BAD)
def test_stages_that_are_spoilt_at_a_place_are_named(name):
    said, parts = s.BAD[name]
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
