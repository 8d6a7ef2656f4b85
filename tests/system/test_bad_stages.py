"""Stages cut, wrapped and misshapen on purpose are named by ``check`` or refused; unusual ones that are right are not.

One small smooth chain, with a function at every place where something can be spoilt. Cases are what differs from it.
"""

import functools
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import nn
from torch.nn.functional import softplus
from torch.utils.checkpoint import checkpoint

from codesign import events
from codesign.errors import CodesignError
from codesign.pose import se3_exp
from codesign.system import Batch, System, check
from codesign.types import EventVolume, FlowField, Rays

D = torch.float64
SIDE, TIMES = 16, 5
T_S = torch.linspace(0, 0.02, TIMES, dtype=D)
DRIVES = se3_exp(torch.linspace(0, 0.6, 2 * TIMES, dtype=D)[:, None] * torch.ones(6, dtype=D))
BATCH = Batch(DRIVES.reshape(2, TIMES, 4, 4), T_S, scene="waves")
X, Y = torch.meshgrid(torch.arange(SIDE) / 3, torch.arange(SIDE) / 4, indexing="xy")
SENSOR = events.SensorModel(theta_on=0.05, theta_off=0.05)
of = dict


def same(value):
    return value


class Lens(nn.Module):
    def __init__(self, one=same):
        super().__init__()
        self.efl_mm = nn.Parameter(torch.tensor(1.3))
        self.conic = nn.Parameter(torch.tensor(0.4))
        self.one = one


class Camera:
    seed = 0

    def __init__(self, lens, change=same):
        self.lens, self.change, self.film = lens, change, SimpleNamespace(shape=(SIDE, SIDE))

    def with_seed(self, seed):
        return self

    def with_lens(self, lens):
        return Camera(lens, self.change)

    def rays(self):
        tilt = torch.stack([self.lens.efl_mm, self.lens.one(self.lens.conic), torch.ones(())])
        return self.change(Rays(torch.zeros(1, 3), (tilt / tilt.norm())[None], tilt[1:2].sigmoid()))


class Mount(nn.Module):
    def __init__(self, after=same):
        super().__init__()
        self.twist = nn.Parameter(0.1 * torch.arange(1, 7, dtype=D))
        self.after = after

    def forward(self):
        return self.after(se3_exp(self.twist))


class Stage(nn.Module):
    """What it gets, changed, through a function and a gain of its own, changed."""

    def __init__(self, core, before=same, after=same, own=True, gain=same):
        super().__init__()
        self.gain = nn.Parameter(torch.ones(())) if own else 1.0
        self.core, self.before, self.after, self.change = core, before, after, gain

    def forward(self, given, t_s):
        return self.after(self.core(self.before(given), self.change(self.gain)))


def picture(rays=same, poses=same, after=same):
    def render(rays_in, T):
        (a, b, _), T = rays(rays_in.direction)[0], poses(T)
        wave = (a * X + T[..., 0, 3, None, None] + T[..., 1, 2, None, None] * Y).sin() * rays(rays_in.weight)
        return after((100 + 60 * (wave + b * (Y + T[..., 2, 3, None, None]).cos())).float())

    return lambda rays, T_world_cam: render(rays, T_world_cam)


def counted(frames, gain=1):
    change = 5 * gain * (frames + 1).log().diff(dim=1)
    return torch.stack([softplus(change), softplus(-change)], 2)


def field_of(px):
    return FlowField(px, torch.ones_like(px[:, 0], dtype=torch.bool), 0.02)


def moved(volume, gain=1):
    on, off = volume.counts.unbind(1)
    return torch.stack([(gain * on).sum(1) - off.mean(1), on[:, 0] * off[:, 1]], 1)


def flow_of(volume, gain=1):
    return field_of(moved(volume, gain))


def layer(**spoilt):
    return Stage(counted, **spoilt)


def network(before=same, **spoilt):
    return Stage(flow_of, before=lambda v: replace(v, counts=before(v.counts)), **spoilt)


def speed(before=same, **spoilt):
    return Stage(lambda field, gain: gain * before(field.flow_px).mean((2, 3)), **spoilt)


def error(estimate):
    return (estimate - 1).square().mean()


def chain(**parts):
    usual = of(camera=Camera(Lens()), mount=Mount(), render=picture(), events=layer(), flow=network(), bins=2)
    return System(**{**usual, "estimate": speed(), "objectives": {"error": error}, **parts})


def checked(batch=BATCH, only=None, may_cut=(), **parts):
    """``check`` of the chain with other parts, on a batch of its own; ``only`` variables of one stage."""
    system = chain(**parts)
    poses = None if batch.T_world_body is None else batch.T_world_body.clone()
    batch = replace(batch, T_world_body=poses, t_s=batch.t_s.clone())
    variables = [p for n, p in system.named_parameters() if n.startswith(only)] if only else None
    return system, check(system, batch, variables, may_cut=may_cut)


class Convolution(nn.Module):
    def __init__(self, zero=False, between=None):
        super().__init__()
        self.between = between or nn.Identity()
        self.first, self.last = nn.Conv2d(4, 4, 3, padding=1), nn.Conv2d(4, 2, 3, padding=1)
        if zero:
            nn.init.zeros_(self.last.weight)
            nn.init.zeros_(self.last.bias)

    def forward(self, volume):
        return field_of(self.last(self.between(self.first(volume.counts.flatten(1, 2))).tanh()))

    def method(self, volume):
        return self(volume)


def posed(cut, volume, T_world_cam):
    return flow_of(volume, cut(T_world_cam).mean())


def half_seen(cut, estimate, field):
    return error(cut(estimate)) + field.flow_px.mean()


# ---- what cuts a gradient, and what has none
CUTS = {
    "detach": lambda t: t.detach(),
    "data": lambda t: t.data,
    "numpy": lambda t: torch.from_numpy(t.detach().numpy().copy()),
    "list": lambda t: torch.tensor(t.tolist(), dtype=t.dtype),
    "no_grad": torch.no_grad()(lambda t: 1.0 * t),
}
HARD = {
    "round": torch.round,
    "above": lambda t: (t > t.mean()).to(t.dtype),
    "sign": lambda t: 2 + (t - t.mean()).sign(),
    "integers": lambda t: (8 * t).long().to(t.dtype),
}
BAD = {"hard sensor": ("events", of(events=events.HardSensor(SENSOR, 2)))}
for name, cut in {**CUTS, **HARD}.items():
    for own in (True, False):
        BAD[f"{name} of frames, {own}"] = ("events", of(events=layer(before=cut, own=own)))
        BAD[f"{name} of counts, {own}"] = ("flow", of(flow=network(before=cut, own=own)))
        BAD[f"{name} of flow, {own}"] = ("estimate", of(estimate=speed(before=cut, own=own)))
for name, cut in CUTS.items():
    parts = {
        "rays": ("render.*rays.dir", of(render=picture(rays=cut))),
        "poses": ("render.*T_world_cam", of(render=picture(poses=cut))),
        "picture": ("render", of(render=picture(after=cut))),
        "conic": ("camera.*the lens .conic", of(camera=Camera(Lens(one=cut)))),
        "mount": ("mount.*its own 'twist'", of(mount=Mount(after=cut))),
        "gain": ("events.*its own 'gain'", of(events=layer(gain=cut))),
        "weight": ("flow.*its own 'gain'", of(flow=network(gain=cut))),
        "pose": ("flow.*T_world_cam", of(flow=functools.partial(posed, cut))),
        "estimate": ("'a'.*'estimate'", of(objectives={"a": functools.partial(half_seen, cut)})),
    }
    BAD |= {f"{name} of {place}": case for place, case in parts.items()}


# ---- what stands wrongly at a junction
def changed(changes, value):
    """Name of an entry -> function of the whole."""
    return replace(value, **{name: change(value) for name, change in changes.items()})


def fields(**changes):
    return of(flow=lambda volume: changed(changes, flow_of(volume)))


def volume_of(frames):
    return EventVolume(counted(frames)[:, :2].transpose(1, 2), torch.ones(2), torch.ones(2))


def volumes(**changes):
    return of(events=lambda frames: changed(changes, volume_of(frames)))


def rays(**changes):
    return of(camera=Camera(Lens(), lambda rays: changed(changes, rays)))


def pixels(after):
    return of(render=picture(after=after))


def counts(after):
    return of(events=lambda frames: after(counted(frames)))


def truth(px, valid=True):
    seen = {"error": lambda field, truth: (field.flow_px - truth.flow_px.detach()).square().mean()}
    known = torch.ones(len(px), SIDE, SIDE, dtype=torch.bool) if valid else px[:, 0]
    return of(objectives=seen, batch=replace(BATCH, truth=FlowField(px, known, 0.02)))


PX = torch.ones(2, 2, SIDE, SIDE)
HALF = (..., slice(None, None, 2), slice(None, None, 2))
BAD |= {
    "flow [N, 2, 1, 1]": ("flow", fields(flow_px=lambda f: f.flow_px.mean((2, 3), keepdim=True))),
    "flow [N, 1, H, W]": ("flow", fields(flow_px=lambda f: f.flow_px[:, :1])),
    "flow [N, H, W, 2]": ("flow", fields(flow_px=lambda f: f.flow_px.movedim(1, 3))),
    "flow [2, H, W]": ("flow", fields(flow_px=lambda f: f.flow_px[0])),
    "flow [1, 2, H, W]": (
        "'flow' holds 1",
        fields(flow_px=lambda f: f.flow_px[:1], valid=lambda f: f.valid[:1]),
    ),
    "flow of half size": ("flow", fields(flow_px=lambda f: f.flow_px[HALF], valid=lambda f: f.valid[HALF])),
    "flow of integers": ("flow", fields(flow_px=lambda f: f.flow_px.long())),
    "flow as a list": ("flow", fields(flow_px=lambda f: f.flow_px.tolist())),
    "valid of floats": ("flow", fields(valid=lambda f: f.valid.float())),
    "valid [N, 1, H, W]": ("flow", fields(valid=lambda f: f.valid[:, None])),
    "valid on another device": ("flow", fields(valid=lambda f: f.valid.to("meta"))),
    "confidence [N, 1, H, W]": ("flow", fields(confidence=lambda f: f.flow_px[:, :1])),
    "covariance of two": ("flow", fields(covariance_px2=lambda f: f.flow_px)),
    "truth [N, 2, 1, 1]": ("truth", truth(PX[..., :1, :1])),
    "truth [N, 1, H, W]": ("truth", truth(PX[:, :1])),
    "truth [1, 2, H, W]": ("'truth' holds 1", truth(PX[:1])),
    "truth valid of floats": ("truth", truth(PX, valid=False)),
    "frames without T": ("render", pixels(lambda f: f[..., 0, :, :])),
    "frames T + 1": ("render", pixels(lambda f: torch.cat([f, f[..., :1, :, :]], -3))),
    "frames of colours": ("render", pixels(lambda f: f[..., None, :, :].expand(2, TIMES, 3, SIDE, SIDE))),
    "frames cropped": ("render", pixels(lambda f: f[..., :-1])),
    "frames of one drive": ("'frames' holds 1", pixels(lambda f: f[:1])),
    "frames of bytes": ("render", pixels(lambda f: f.to(torch.uint8))),
    "frames as arrays": ("render", pixels(lambda f: f.detach().numpy())),
    "frames on 0 to 1": ("scale is 0 to 255", pixels(lambda f: f / 255)),
    "counts of T": ("events", counts(lambda c: torch.cat([c, c[:, :1]], 1))),
    "counts of one polarity": ("events", counts(lambda c: c[:, :, :1])),
    "counts polarity first": ("events", counts(lambda c: c.transpose(1, 2))),
    "counts of half size": ("events", counts(lambda c: c[HALF])),
    "counts without N": ("events", counts(lambda c: c[0])),
    "counts of integers": ("events", counts(lambda c: c.long())),
    "counts below 0": ("0 or more", counts(lambda c: c - 1)),
    "counts as a list": ("events", counts(lambda c: c.tolist())),
    "volume of one polarity": ("events", volumes(counts=lambda v: v.counts[:, :1])),
    "volume of other bins": ("events", volumes(centroid_s=lambda v: torch.ones(3))),
    "volume of half size": ("events", volumes(counts=lambda v: v.counts[HALF])),
    "volume of one sample": ("'events' holds 1", volumes(counts=lambda v: v.counts[:1])),
    "volume below 0": ("0 or more", volumes(counts=lambda v: -v.counts)),
    "rays [3]": ("camera", rays(direction=lambda r: r.direction[0])),
    "rays of two weights": ("camera", rays(weight=lambda r: torch.ones(2))),
    "rays as a tensor": ("camera", of(camera=Camera(Lens(), lambda r: r.direction))),
    "mount [3, 4]": ("mount", of(mount=Mount(after=lambda T: T[:3]))),
    "mounts of three drives": ("mount", of(mount=Mount(after=lambda T: T.expand(3, 4, 4)))),
    "trajectory of T - 1": (
        "trajectory",
        of(trajectory=lambda: DRIVES[1:5], batch=Batch(None, T_S, "waves")),
    ),
    "times in ms": ("milliseconds", of(batch=replace(BATCH, t_s=1e3 * T_S))),
    "times that stand still": ("increase strictly", of(batch=replace(BATCH, t_s=0 * T_S))),
    "float64 network": ("float64 on cpu.*float32 on cpu.*'events'", of(flow=Convolution().double())),
    "weights without values": (
        "'flow.first.weight' is on the device meta",
        of(flow=Convolution().to("meta")),
    ),
}


# ---- weights that the system does not see
class Pipeline:
    def __init__(self):
        self.layers = {"first": [Convolution()]}

    def __call__(self, volume):
        return self.layers["first"][0](volume)


class Unlisted(nn.Module):
    def __init__(self):
        super().__init__()
        self.layers = [Convolution()]

    def forward(self, volume):
        return self.layers[0](volume)


def helper(volume):
    return NET(volume)


def wrapped(call):
    @functools.wraps(call)
    def inner(*given):
        return call(*given)

    return inner


NET, GAIN = Convolution(), nn.Parameter(torch.ones(()))
HIDDEN = {
    "closure": of(flow=wrapped(Convolution())),
    "global": of(flow=lambda volume: NET(volume)),
    "global of a function": of(flow=lambda volume: helper(volume)),
    "default": of(flow=lambda volume, net=NET: net(volume)),
    "object": of(flow=Pipeline()),
    "method of an object": of(flow=Pipeline().__call__),
    "list in a Module": of(flow=Unlisted()),
    "partial of a closure": of(flow=functools.partial(wrapped(NET))),
    "parameter": of(events=lambda frames: counted(frames, GAIN)),
    "mount": of(mount=wrapped(Mount())),
    "camera": of(camera=wrapped(functools.partial(Camera, Lens()))),
    "objective": of(objectives={"a": lambda volume: NET(volume).flow_px.mean()}),
}
BAD |= {f"hidden: {name}": ("holds a .*does not see", parts) for name, parts in HIDDEN.items()}


# ---- stages that touch what is not theirs, or cannot be called
def touching(change):
    return of(flow=lambda volume: (change(volume.counts), flow_of(volume))[1])


def placed(frames, t_s, /):
    return frames


BAD |= {
    "in place": ("in place", touching(lambda counts: counts.mul_(2.0))),
    "in place by item": ("in place", touching(lambda counts: counts.__setitem__((0, 0), 0.0))),
    "in place by data": ("in place", touching(lambda counts: counts.data.mul_(2.0))),
    "in place by numpy": ("in place", touching(lambda counts: counts.detach().numpy().__imul__(2.0))),
    "in place by a ReLU": ("in place", of(events=layer(before=nn.ReLU6(inplace=True)))),
    "in place on the batch": ("in place", of(mount=None, render=picture(poses=lambda T: T.mul_(1.01)))),
    "in place on times": ("in place", of(flow=lambda volume, t_s: (t_s.add_(1), flow_of(volume))[1])),
    "takes no input": ("flow.*takes no input", of(flow=lambda: None)),
    "takes keywords alone": ("estimate.*takes no input", of(estimate=lambda *, t_s: None)),
    "takes another first": ("names its first argument 't", of(flow=lambda truth, volume: None)),
    "more by position": ("'t_s' by position alone", of(events=placed)),
    "asks for what is not": ("asks for 'theta'", of(events=lambda frames, theta: frames)),
    "asks for what comes after": ("in a circle: '", of(events=lambda frames, field: frames)),
    "a class": ("is the class", of(flow=Convolution)),
    "a string": ("is a str", of(flow="refiner")),
    "no objective": ("at least one objective", of(objectives={})),
    "a gradient of no kind": ("gradient = 'exact'", of(gradient="exact")),
    "said to cut, of no stage": ("may_cut is", of(may_cut=("event",))),
    "one variable of 0": (
        "'estimate.gain' is exactly 0",
        of(estimate=Stage(lambda f, gain: f.flow_px.mean() + 0 * gain)),
    ),
}


# ---- unusual, and right
class Straight(torch.autograd.Function):
    @staticmethod
    def forward(ctx, value):
        return value.round()

    @staticmethod
    def backward(ctx, *grads):
        return grads[0]


class Cast(nn.Module):
    def forward(self, volume):
        return replace(volume, counts=volume.counts.double())


def half_cut(axis):
    return lambda t: torch.cat([t.narrow(axis, 0, 1).detach(), t.narrow(axis, 1, 1)], axis)


def seen(volume):
    return (volume.counts.sum((1, 2)) > 0.5)[:, None]


def iterated(volume):
    px = moved(volume)
    for _ in range(3):
        px = 0.5 * px.detach() + 0.5 * moved(volume)
    return field_of(px)


def newton(field):
    """One step of an inner problem, differentiated."""
    at = torch.zeros(2, 2, requires_grad=True)
    miss = (at - field.flow_px.mean((2, 3))).square().sum()
    return at.detach() - torch.autograd.grad(miss, at, create_graph=True)[0] / 2


def sure(volume, gain):
    px = moved(volume, gain)
    return replace(field_of(px), confidence=px.square().sum(1).sigmoid())


def weighted(field):
    return (field.flow_px.square().sum(1) * field.confidence.detach()).mean()


def keyword_only(*, volume):
    return flow_of(volume)


def normed():
    net = Convolution()
    nn.utils.parametrizations.weight_norm(net.first)
    return net


def frozen(module):
    return module.requires_grad_(False)


UNSEEN = wrapped(Convolution())
HARD_SENSOR = events.HardSensor(SENSOR, 2)
GOOD = {
    "as it is": of(),
    "one drive cut": of(events=layer(before=half_cut(0))),
    "one polarity cut": of(flow=network(before=half_cut(1))),
    "straight through": of(events=layer(before=Straight.apply)),
    "keyword alone": of(flow=keyword_only),
    "starred": of(flow=lambda *given: flow_of(given[0])),
    "any keywords": of(flow=lambda volume, **more: flow_of(volume)),
    "frames, and a mask of events": of(
        flow=lambda volume, frames: field_of(frames.diff(dim=1)[:, :2] * seen(volume))
    ),
    "a mask of its own input": of(flow=lambda volume: field_of(moved(volume) * seen(volume))),
    "an argument for its shape": of(flow=lambda volume, frames: flow_of(volume, frames.shape[1])),
    "iterated": of(flow=iterated),
    "checkpointed": of(flow=lambda volume: checkpoint(flow_of, volume, use_reentrant=False)),
    "confidence as a weight": of(flow=Stage(sure), objectives={"a": weighted}),
    "objective of confidence": of(flow=Stage(sure), objectives={"a": lambda field: field.confidence.mean()}),
    "a mask in the objective": of(
        objectives={"a": lambda volume, field: (field.flow_px * seen(volume)).mean()}
    ),
    "truth as a target": truth(PX),
    "zero-initialised": of(flow=Convolution(zero=True)),
    "dropout": of(flow=Convolution(between=nn.Dropout(0.5))),
    "batch norm": of(flow=Convolution(between=nn.BatchNorm2d(4))),
    "weight norm": of(flow=normed()),
    "in place behind a layer": of(flow=Convolution(between=nn.ReLU(inplace=True))),
    "in place on a copy": of(flow=network(before=lambda c: c.clone().mul_(2))),
    "casts by itself": of(flow=nn.Sequential(Cast(), Convolution().double())),
    "float64 element by element": of(events=layer(gain=torch.Tensor.double)),
    "a pair": of(
        flow=lambda volume: (moved(volume), moved(volume).exp()), estimate=lambda pair: pair[0] + pair[1]
    ),
    "a dictionary": of(flow=lambda volume: {"px": moved(volume)}, estimate=lambda field: field["px"].mean()),
    "an object": of(
        estimate=lambda f: SimpleNamespace(v=f.flow_px.mean()), objectives={"a": lambda estimate: estimate.v}
    ),
    "inner gradients": of(estimate=newton),
    "noise": of(events=layer(before=lambda f: f + torch.rand(f.shape))),
    "noise of the batch": of(
        events=lambda f, generator: counted(f + torch.rand(f.shape, generator=generator))
    ),
    "frozen, behind a function": of(flow=wrapped(frozen(Convolution()))),
    "behind a function, not optimised": of(flow=UNSEEN, only="lens"),
    "network alone behind a hard sensor": of(events=HARD_SENSOR, flow=Convolution(), only="flow"),
    "mount alone": of(camera=Camera(frozen(Lens())), only="mount"),
    "said to cut": of(flow=network(before=torch.Tensor.detach), may_cut=("flow",)),
    "no mount": of(mount=None),
    "a mount per drive": of(mount=Mount(after=lambda T: T.expand(2, 4, 4))),
    "rays without variables": of(camera=Camera(frozen(Lens())), render=picture(rays=torch.Tensor.detach)),
    "dim frames": of(render=picture(after=lambda f: f / 100)),
    "a smooth layer": of(events=events.layer("counts", SENSOR)),
    "hard counts with gradients": of(events=events.layer("memory", SENSOR)),
}


def test_they_are_a_hundred_and_thirty():
    assert len(BAD) >= 100
    assert len(GOOD) >= 30


@pytest.mark.parametrize("name", BAD)
def test_bad_stages_are_named(name):
    said, parts = BAD[name]
    with pytest.raises((CodesignError, UserWarning), match=f"(?s){said}"):
        checked(**parts)


@pytest.mark.parametrize("name", GOOD)
def test_unusual_stages_that_are_right_pass(name):
    torch.manual_seed(0)
    checked(**GOOD[name])[1].backward()


def of_network(network, volume, gain=1.0):
    return replace(network(volume), interval_s=0.02 * gain)


def brighter(mount, rays, T_world_cam):
    return mount()[0, 0].float() * picture()(rays, T_world_cam)


def mean_of(net, volume):
    return net(volume).flow_px.mean()


WRAPPED = [
    ("flow", 4, Convolution().forward),
    ("flow", 4, Convolution().method),
    ("flow", 4, functools.partial(Convolution())),
    ("flow", 4, functools.partial(Convolution().forward)),
    ("flow", 4, functools.partial(functools.partial(of_network, Convolution()), gain=2.0)),
    ("events", 2, events.layer("counts").volume),
    ("mount", 1, Mount().forward),
    ("camera", 2, functools.partial(Camera, Lens())),
    ("render", 1, functools.partial(brighter, Mount())),
    (
        "estimate",
        1,
        functools.partial(lambda field, scale: scale()[0, 0] * field.flow_px.mean(), scale=Mount()),
    ),
    ("objectives", 4, {"a": functools.partial(mean_of, Convolution())}),
]


@pytest.mark.parametrize(("part", "count", "given"), WRAPPED)
def test_methods_and_partials_bring_their_weights(part, count, given):
    names = [name for name, _ in checked(**{part: given})[0].named_parameters()]
    assert len([name for name in names if name.startswith(f"{part}.")]) == count


@pytest.mark.parametrize(
    ("name", "said"), [("event", "did you mean 'events'"), ("sensor", "no part 'sensor'")]
)
def test_typos_are_refused(name, said):
    with pytest.raises(CodesignError, match=said):
        setattr(chain(), name, layer())
