"""Stages cut, misshapen, hidden and altered at every junction of one small smooth chain, alone and
together."""

import functools
import random
import re
import warnings
from dataclasses import replace
from types import SimpleNamespace

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
of = dict


def same(value):
    return value


class Numbers(nn.Module):
    """A lens or a mount: numbers, changed on their way out."""

    def __init__(self, change=same, **numbers):
        super().__init__()
        self.change = change
        for name, value in numbers.items():
            self.register_parameter(name, nn.Parameter(torch.as_tensor(value)))

    def forward(self):
        return self.change(se3_exp(self.twist))


def glass(change=same):
    return Numbers(change, efl_mm=1.3, conic=0.4)


def held(change=same):
    return Numbers(change, twist=0.1 * torch.arange(1, 7, dtype=D))


class Camera:
    seed = 0

    def __init__(self, lens, change=same):
        self.lens, self.change, self.film = lens, change, SimpleNamespace(shape=(SIDE, SIDE))

    def with_seed(self, seed):
        return self

    def with_lens(self, lens):
        return Camera(lens, self.change)

    def rays(self):
        tilt = torch.stack([self.lens.efl_mm, self.lens.change(self.lens.conic), torch.ones(())])
        return self.change(Rays(torch.zeros(1, 3), (tilt / tilt.norm())[None], tilt[1:2].sigmoid()))


class Stage(nn.Module):
    """What it gets, changed, through a function and a gain of its own, changed."""

    def __init__(self, core, before=same, own=True, gain=same):
        super().__init__()
        self.gain = nn.Parameter(torch.ones(())) if own else 1.0
        self.core, self.before, self.change = core, before, gain

    def forward(self, given, t_s):
        return self.core(self.before(given), self.change(self.gain))

    def method(self, given):
        return self(given, T_S)


def picture(rays=same, poses=same, after=same):
    def render(rays_in, T):
        (a, b, _), T = rays(rays_in.direction)[0], poses(T)
        wave = (a * X + T[..., 0, 3, None, None] + T[..., 1, 2, None, None] * Y).sin() * rays(
            rays_in.weight
        )
        return after((100 + 60 * (wave + b * (Y + T[..., 2, 3, None, None]).cos())).float())

    return lambda rays, T_world_cam: render(rays, T_world_cam)


def counted(frames, gain=1):
    change = 5 * gain * (frames + 1).log().diff(dim=1)
    return torch.stack([softplus(change), softplus(-change)], 2)


def volume_of(frames, gain=1):
    bins = counted(frames, gain)[:, :2].transpose(1, 2)
    return EventVolume(bins, torch.ones(2), torch.ones(2))


def moved(volume, gain=1):
    on, off = volume.counts.unbind(1)
    return torch.stack([(gain * on).sum(1) - off.mean(1), on[:, 0] * off[:, 1]], 1)


def field_of(px):
    return FlowField(px, torch.ones_like(px[:, 0], dtype=torch.bool), 0.02)


def flow_of(volume, gain=1):
    return field_of(moved(volume, gain))


def mean_flow(field, gain=1):
    return gain * field.flow_px.mean((2, 3))


def error(estimate):
    return (estimate - 1).square().mean()


def entry(name, change):
    return lambda value: replace(value, **{name: change(getattr(value, name))})


def layer(**spoilt):
    return Stage(counted, **spoilt)


def network(before=same, **spoilt):
    return Stage(flow_of, entry("counts", before), **spoilt)


def speed(before=same, **spoilt):
    return Stage(mean_flow, entry("flow_px", before), **spoilt)


def checked(batch=BATCH, only=None, may_cut=(), **parts):
    """``check`` of the chain with other parts, on a batch of its own; ``only`` variables of one
    stage."""
    usual = of(camera=Camera(glass()), mount=held(), render=picture(), events=layer())
    usual |= of(flow=network(), bins=2, estimate=speed(), objectives={"error": error})
    system = System(**{**usual, **parts})
    poses = None if batch.T_world_body is None else batch.T_world_body.clone()
    batch = replace(batch, T_world_body=poses, t_s=batch.t_s.clone())
    variables = [p for name, p in system.named_parameters() if only and name.startswith(only)]
    return system, check(system, batch, variables if only else None, may_cut=may_cut)


STAGES = {"events": layer, "flow": network, "estimate": speed}
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
CUT_AT = {
    "rays": lambda cut: ("render.*rays.dir", of(render=picture(rays=cut))),
    "poses": lambda cut: ("render.*T_world_cam", of(render=picture(poses=cut))),
    "picture": lambda cut: ("render", of(render=picture(after=cut))),
    "conic": lambda cut: ("camera.*the lens .conic", of(camera=Camera(glass(cut)))),
    "mount": lambda cut: ("mount.*its own 'twist'", of(mount=held(cut))),
    "gain": lambda cut: ("events.*its own 'gain'", of(events=layer(gain=cut))),
    "weight": lambda cut: ("flow.*its own 'gain'", of(flow=network(gain=cut))),
    "factor": lambda cut: ("estimate.*its own 'gain'", of(estimate=speed(gain=cut))),
}
THROUGH = {
    f"{part}, {own}": lambda cut, part=part, make=make, own=own: (
        part,
        {part: make(before=cut, own=own)},
    )
    for part, make in STAGES.items()
    for own in (True, False)
}
SHAPES = {
    "first alone": lambda t: t[0],
    "an axis more": lambda t: t[None],
    "one more": lambda t: torch.cat([t, t[:, :1]], 1) if t.ndim > 1 else torch.cat([t, t]),
    "integers": lambda t: t.long(),
    "list": lambda t: t.tolist(),
    "array": lambda t: t.detach().numpy(),
    "on meta": lambda t: t.to("meta"),
    "cropped": lambda t: t[..., :-1],
    "turned": lambda t: t.movedim(1, -1) if t.ndim > 2 else t.flatten()[:, None],
}
SHAPED_AT = {
    "frames": lambda change: ("render|frames", of(render=picture(after=change))),
    "counts": lambda change: ("events", of(events=lambda frames: change(counted(frames)))),
    "volume": lambda change: (
        "events",
        of(events=lambda frames: entry("counts", change)(volume_of(frames))),
    ),
    **{
        name: lambda change, part=part: (
            "flow",
            of(flow=lambda volume: entry(part, change)(flow_of(volume))),
        )
        for name, part in (("flow", "flow_px"), ("valid", "valid"))
    },
    "rays": lambda change: ("camera", of(camera=Camera(glass(), entry("direction", change)))),
    "mount": lambda change: ("mount", of(mount=held(change))),
}
IN_PLACE = {
    "in place": lambda t: t.mul_(1.1),
    "by item": lambda t: t.__setitem__((0, 0), 0.0),
    "by data": lambda t: t.data.mul_(1.1),
    "by numpy": lambda t: t.detach().numpy().__imul__(1.1),
}
TOUCHED_AT = {
    "frames": lambda touch: (
        "in place",
        of(events=lambda frames: (touch(frames), counted(frames))[1]),
    ),
    "volume": lambda touch: ("in place", of(flow=lambda v: (touch(v.counts), flow_of(v))[1])),
    "field": lambda touch: ("in place", of(estimate=lambda f: (touch(f.flow_px), mean_flow(f))[1])),
}


def closed(call):
    return functools.wraps(call)(lambda *given: call(*given))


HIDINGS = {
    "closure": lambda module: closed(module),
    "default": lambda module: lambda given, net=module: net(given),
    "list": lambda module: lambda given, held=[module]: held[0](given),
    "partial of a closure": lambda module: functools.partial(closed(module)),
}
HIDDEN_AT = {
    part: lambda hide, part=part, make=make: ("does not see", {part: hide(make().method)})
    for part, make in STAGES.items()
}
PRODUCTS = ((CUTS, CUT_AT), (CUTS | HARD, THROUGH), (SHAPES, SHAPED_AT), (IN_PLACE, TOUCHED_AT))
# axes before, a square film
RIGHT = ("an axis more at frames", "an axis more at mount", "turned at valid")
BAD = {
    f"{how} at {place}": spoil(change)
    for ways, places in (*PRODUCTS, (HIDINGS, HIDDEN_AT))
    for how, change in ways.items()
    for place, spoil in places.items()
    if f"{how} at {place}" not in RIGHT
}


class Convolution(nn.Sequential):
    """A network of counts, with a layer between its two."""

    def __init__(self, between=None):
        first, last = nn.Conv2d(4, 4, 3, padding=1), nn.Conv2d(4, 2, 3, padding=1)
        super().__init__(first, between or nn.Identity(), last)

    def forward(self, volume):
        return field_of(super().forward(volume.counts.flatten(1, 2)).tanh())

    def method(self, volume):
        return self(volume)


def zeroed(net):
    nn.init.zeros_(net[2].weight)
    nn.init.zeros_(net[2].bias)
    return net


def half_cut(axis):
    return lambda t: torch.cat([t.narrow(axis, 0, 1).detach(), t.narrow(axis, 1, 1)], axis)


def seen(volume):
    return (volume.counts.sum((1, 2)) > 0.5)[:, None]


HARD_SENSOR = events.HardSensor(events.SensorModel(theta_on=0.05, theta_off=0.05), 2)
GOOD = {
    "one drive cut": of(events=layer(before=half_cut(0))),
    "one polarity cut": of(flow=network(before=half_cut(1))),
    "keyword alone": of(flow=lambda *, volume: flow_of(volume)),
    "starred": of(flow=lambda *given: flow_of(given[0])),
    "any keywords": of(flow=lambda volume, **more: flow_of(volume)),
    "a mask of events": of(
        flow=lambda volume, frames: field_of(frames.diff(dim=1)[:, :2] * seen(volume))
    ),
    "an argument for its shape": of(flow=lambda volume, frames: flow_of(volume, frames.shape[1])),
    "checkpointed": of(flow=lambda volume: checkpoint(flow_of, volume, use_reentrant=False)),
    "truth as a target": of(
        objectives={
            "a": lambda field, truth: (field.flow_px - truth.flow_px.detach()).square().mean()
        },
        batch=replace(BATCH, truth=field_of(torch.ones(2, 2, SIDE, SIDE))),
    ),
    "zero-initialised": of(flow=zeroed(Convolution())),
    "dropout": of(flow=Convolution(nn.Dropout(0.5))),
    "in place behind a layer": of(flow=Convolution(nn.ReLU(inplace=True))),
    "in place on a copy": of(flow=network(before=lambda c: c.clone().mul_(2))),
    "float64 element by element": of(events=layer(gain=torch.Tensor.double)),
    "a pair": of(
        flow=lambda v: (moved(v), moved(v).exp()), estimate=lambda pair: pair[0] + pair[1]
    ),
    "noise": of(events=layer(before=lambda f: f + torch.rand(f.shape))),
    "frozen, behind a function": of(flow=closed(network().requires_grad_(False).method)),
    "network alone behind a hard sensor": of(events=HARD_SENSOR, flow=Convolution(), only="flow"),
    "mount alone": of(camera=Camera(glass().requires_grad_(False)), only="mount"),
    "said to cut": of(flow=network(before=torch.Tensor.detach), may_cut=("flow",)),
    "no mount": of(mount=None),
    "a mount per drive": of(mount=held(lambda T: T.expand(2, 4, 4))),
    "a lens without variables": of(camera=Camera(glass().requires_grad_(False))),
    "dim frames": of(render=picture(after=lambda f: f / 100)),
    "hard counts with gradients": of(
        events=events.layer("memory", HARD_SENSOR.sensor), render=picture()
    ),
}


def outcome(parts, said):
    """None where ``check`` says what it should (nothing where ``said`` is None); else what it
    said."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            checked(**parts)[1].backward()
    except (CodesignError, UserWarning) as sentence:
        return None if said and re.search(said, str(sentence)) else f"said {sentence}"
    return None if said is None else "nothing was said"


def measure(count: int, seed: int, say=print) -> tuple[dict[str, float], list[str]]:
    """Chains of one to three bad parts, and as many of right ones: how many are named, and how many
    pass."""
    draw = random.Random(seed)
    findings = []
    named = passed = 0
    neutral = [parts for parts in GOOD.values() if not {"only", "may_cut", "batch"} & set(parts)]
    for _ in range(count):
        names = draw.sample(list(BAD), draw.randint(1, 3))
        spoilt = functools.reduce(of.__or__, [BAD[name][1] for name in names])
        said = outcome(spoilt, "(?s)" + "|".join(BAD[name][0] for name in names))
        named += said is None
        findings += [] if said is None else [f"{' + '.join(names)}: {said}"]
        right = {}
        for extra in draw.sample(neutral, 3):
            right |= {} if set(extra) & set(right) else extra
        said = outcome(right, None)
        passed += said is None
        findings += [] if said is None else [f"right, with {', '.join(right)}: {said}"]
    for finding in findings:
        say(finding)
    return of(
        stages_bad=count, stages_named=named, stages_right=count, stages_right_passed=passed
    ), findings
