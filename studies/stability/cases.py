"""Hard cases of every stage: what theory expects of values and gradients, beside what is seen."""

import math
from dataclasses import dataclass

import torch

from codesign import events, flow, lens, pose, render
from codesign.errors import DomainError
from codesign.types import EventVolume
from scenes import trajectories

GLASS = lens.Glass.from_indices(1.5, 1.5, 1.5)
AHEAD = (0.0, 0.0, 1.0)
THETA = 0.2


@dataclass(frozen=True)
class Check:
    """Something that theory knows: values that stand beside what is seen, and how far apart they
    may be."""

    what: str
    expected: torch.Tensor | float
    seen: torch.Tensor | float
    allowed: float = 1e-9

    @property
    def off(self) -> float:
        """Largest difference, over what is expected where that is above 1."""
        expected, seen = (
            torch.as_tensor(x, dtype=torch.float64).detach() for x in (self.expected, self.seen)
        )
        return float((seen - expected).abs().max() / expected.abs().max().clamp(min=1.0))

    @property
    def passed(self) -> bool:
        return self.off <= self.allowed


def flat_scene():
    twist = _twist()
    images = _render(_plane(amplitude=0.0), twist)
    yield Check("radiance", 100.0, images)
    yield Check("events at threshold 0.01", 0, events.memory(images.detach(), 0.01, 0.01)[0].sum())
    yield Check("gradient to the pose", 0, torch.autograd.grad(images.square().sum(), twist)[0])


def black_frames():
    frames = torch.zeros(4, 6, 6, dtype=torch.float64, requires_grad=True)
    soft = events.soft_counts(frames, THETA, THETA)
    yield Check("events", 0, events.memory(frames, THETA, THETA)[0].sum())
    linear = math.log(20) / 20
    yield Check(
        "slope of the linear part",
        linear,
        torch.autograd.grad(events.lin_log(frames).sum(), frames)[0],
    )
    slope = torch.autograd.grad((soft[:, 0] - soft[:, 1])[-1].sum(), frames)[0][-1]
    yield Check("the same per threshold", linear / THETA, slope)


def total_reflection():
    """The deficit n^2 (h c)^2 - 1 has the slope 2 n^2 h^2 c in the curvature c = -1/10 of the
    second surface."""
    geo = lens.GeoLens(
        [lens.Surface(math.inf, 5.0, GLASS, 99.0), lens.Surface(-10.0, 10.0, None, 9.9)], 4.0
    )
    out = geo.trace(_f64([(8.0, 0.0, -5.0)]), _f64([AHEAD]))
    yield Check("status", int(lens.Status.TOTAL_REFLECTION), int(out.status))
    yield Check("weight", 0, out.weight)
    yield Check("deficit", 1.5**2 * 0.64 - 1, out.deficit, 1e-6)
    slope = torch.autograd.grad(out.deficit.sum(), geo.curvature_per_mm)[0][1]
    yield Check("slope of the deficit to the curvature", 2 * 1.5**2 * 64 * -0.1, slope, 1e-6)


def all_rays_lost():
    """Deficits (h c)^2 - 1."""
    geo = lens.GeoLens(
        [lens.Surface(10.0, 5.0, GLASS, 9.0), lens.Surface(math.inf, 10.0, None, 9.0)], 4.0
    )
    out = geo.trace(_f64([(20.0, 0.0, -5.0), (0.0, 15.0, -5.0)]), _f64([AHEAD, AHEAD]))
    yield Check("weights", 0, out.weight)
    yield Check("deficits", _f64([3.0, 1.25]), out.deficit, 1e-6)
    slope = torch.autograd.grad(out.deficit.sum(), geo.curvature_per_mm)[0][0]
    yield Check("slope of the deficits", 2 * (400 + 225) * 0.1, slope, 1e-6)
    stop = lens.Surface(5.0, 10.0, GLASS, 4.99, is_stop=True)
    refused = 0
    try:
        lens.GeoLens([stop, lens.Surface(-5.0, 8.0, None, 4.99)], 8.0).camera_rays(
            _f64([(8.0, 0.0)]), _f64([(-1.0, 0.0)])
        )
    except DomainError:
        refused = 1
    yield Check("a camera refuses (1)", 1, refused)


def identity_twist():
    world = _plane()
    twist = _twist()
    (grad,) = torch.autograd.grad(_render(world, twist).square().mean(), twist)
    truth = _differences(lambda x: _render(world, x).square().mean(), twist.detach(), 1e-5)
    yield Check("exp(0)", torch.eye(4), pose.se3_exp(torch.zeros(6, dtype=torch.float64)), 0)
    yield Check("gradient over differences", 0, (grad - truth).norm() / truth.norm(), 1e-6)


def half_turn():
    """A camera turned by almost half a turn and back again."""
    twist = _f64([0.1, -0.2, 0.3, 3.1, 0.1, -0.2]).requires_grad_()
    there = pose.se3_exp(twist)
    back = pose.inverse(there) @ there
    yield Check("a pose and its inverse", torch.eye(4), back, 1e-12)
    (grad,) = torch.autograd.grad((back * torch.arange(16.0).reshape(4, 4)).sum(), twist)
    yield Check("their gradient", 0, grad, 1e-12)


def zero_events():
    counts = torch.zeros(1, 2, 5, 16, 16, dtype=torch.float64, requires_grad=True)
    edges = torch.linspace(0, 0.1, 6, dtype=torch.float64)
    field = flow.estimate_lk(EventVolume(counts, (edges[1:] + edges[:-1]) / 2, edges.diff()))
    yield Check("flow", 0, field.flow_px, 0)
    yield Check("valid pixels", 0, field.valid.sum(), 0)
    # the flow is quadratic in the counts
    yield Check("gradient", 0, torch.autograd.grad(field.flow_px.sum(), counts)[0], 0)


def tiny_flow():
    """A pattern that moves 5e-4 px over the interval: the smooth volume gives that flow, not zero
    and not noise. All of it brightens, so that events come whatever the motion."""
    motion = torch.tensor(5e-4, dtype=torch.float64, requires_grad=True)
    x = torch.arange(48, dtype=torch.float64)
    t_s = torch.linspace(0, 0.1, 11, dtype=torch.float64)
    down = torch.cos(2 * math.pi * x / 12)[:, None] * 0.3

    def estimate(shift):
        at = (x - shift * (t_s / 0.1)[:, None])[:, None, :]
        glow = 1.2 ** (4 * t_s / 0.1)
        frames = 60 * (torch.cos(2 * math.pi * at / 16) * 0.3 + down).exp() ** glow[:, None, None]
        volume = events.from_counts(events.soft_counts(frames, THETA, THETA), t_s, 5)
        return flow.estimate_lk(volume, "constant").flow_px[0, 0].mean()

    found = estimate(motion)
    (slope,) = torch.autograd.grad(found, motion)
    rest = motion.detach()
    difference = (estimate(rest + 1e-3) - estimate(rest - 1e-3)) / 2e-3
    yield Check("slope over differences", 1, slope / difference, 0.01)
    yield Check(
        "change over slope times motion", 1, (found - estimate(0 * rest)) / (slope * motion), 0.01
    )


def smallest_threshold():
    """Frames 100 to 200: ln(2)/1e-3 = 693 events; slope 1/(200 · 1e-3) to the last frame, 0 to
    those between."""
    total, slope = _ramp(1e-3)
    yield Check("events", 693, total)
    yield Check("slopes to the later frames", _f64([0, 0, 0, 5]), slope[1:])


def largest_threshold():
    """ln(2) stays below half a threshold."""
    total, slope = _ramp(10.0)
    yield Check("events", 0, total)
    yield Check("slopes", 0, slope)


def one_pixel():
    """One pixel of one sample looks along the axis: its value and its motion are those of the
    texture at one point; 10 mm at 2 m behind 20 mm focal length and 0.5 mm pixels."""
    world = _plane()
    twist = _twist()
    image = _render(world, twist, size_px=1, samples=1, count=1)
    value = 100 * (world.amplitude * world.phase.cos()).sum().exp()
    slope = (
        -value * (world.amplitude * world.phase.sin() * 2 * torch.pi * world.frequency[:, 0]).sum()
    )
    yield Check("radiance", value, image)
    yield Check("slope per metre", slope, torch.autograd.grad(image.sum(), twist)[0][0])
    camera = render.Camera(lens.Pinhole(20.0), 1, 1, 0.5, 1, 0)
    poses = _poses(torch.zeros(6, dtype=torch.float64), 2)
    found = render.true_flow(camera, world, poses)[0].flatten()
    yield Check("flow, px", _f64([-0.01 / 2.0 * 20.0 / 0.5, 0]), found)


def static_camera():
    """A common change of the pose moves all frames alike, so smooth counts stay 0 and so does their
    gradient."""
    twist = _twist()
    images = _render(_plane(), twist, twist_per_frame=(0.0,) * 6)
    yield Check("differences of frames", 0, images.diff(dim=0), 0)
    yield Check("events at threshold 1e-3", 0, events.memory(images.detach(), 1e-3, 1e-3)[0].sum())
    soft = events.soft_counts(images, THETA, THETA)
    yield Check("smooth counts", 0, soft.sum())
    yield Check("gradient", 0, torch.autograd.grad((soft[:, 0] - soft[:, 1]).sum(), twist)[0])


def turning_point():
    """A camera that goes and comes back: hard counts balance to within one event per pixel. ON -
    OFF moves by whole multiples of 1/C per log level (all pixels are above 20), and not with a
    common brightening."""
    theta = 0.05
    t_s = trajectories.times(21, 200.0)
    path = trajectories.Swinging(torch.eye(4, dtype=torch.float64), (0.0, 1.0, 0.0), 0.05, 10.0)(
        t_s
    )
    camera = render.Camera(lens.Pinhole(20.0), 8, 8, 0.5, 4, 0)
    images = render.frames(camera, _plane(), path).requires_grad_()
    counts, level = events.memory(images, theta, theta)
    signed = counts[:, 0] - counts[:, 1]
    unit = torch.autograd.grad(signed.sum(), images)[0] * images * theta
    yield Check("events beyond 100 (1)", 1, float(counts.sum() > 100))
    yield Check("ON less OFF per pixel", 0, signed.sum(0), 1)
    drift = (level[0] - events.lin_log(images[:1])[0]) / theta
    yield Check("drift of the level, thresholds", 0, drift, 1 + 1e-9)
    yield Check("slopes, off whole numbers", 0, unit - unit.round())
    yield Check("slope to a common brightening", 0, unit.sum(0))


def strong_surfaces():
    """A ball lens: rays meet its second half beyond the centre. Paraxial focus R n / (2 (n - 1))
    from the centre (Hecht, Optics, ch. 6)."""
    height = 1e-4
    focus_mm = 1.5 * 5.0 / (2 * 0.5)
    surfaces = [
        lens.Surface(5.0, 10.0, GLASS, 4.99),
        lens.Surface(-5.0, focus_mm - 5.0, None, 4.99),
    ]
    ball = lens.GeoLens(surfaces, 2.0)
    beside = _f64([(4.0, 0.0, -9.0)])
    out = ball.trace(torch.cat([_f64([(height, 0, -9.0)]), beside]), _f64([AHEAD, AHEAD]))
    yield Check("rays lost", 0, (out.status != 0).sum())
    yield Check("focus, heights", 0, out.position_mm[0, 0] / height, 1e-8)
    (slope,) = torch.autograd.grad(out.position_mm[1, 0], ball.curvature_per_mm)

    def landing(curvature):
        return (
            ball.replace(curvature_per_mm=curvature).trace(beside, _f64([AHEAD])).position_mm[0, 0]
        )

    truth = _differences(landing, ball.curvature_per_mm.detach(), 1e-7)
    yield Check(
        "derivative 0.8 R off the axis, over differences",
        0,
        (slope - truth).norm() / truth.norm(),
        1e-6,
    )


def far_object():
    """A parallel beam that starts 10 km away in float32 lands where float64 puts it from 5 mm away,
    and moves alike with the curvatures."""
    near = _f64([(x, y, -5.0) for x, y in ((0.0, 0.0), (2.0, 0.0), (0.0, -3.0), (1.5, 2.5))])

    def traced(dtype, origin):
        geo = lens.load("double-gauss", dtype)
        out = geo.trace(origin.to(dtype), _f64([AHEAD] * 4).to(dtype))
        (slope,) = torch.autograd.grad(out.position_mm[:, :2].sum(), geo.curvature_per_mm)
        return out.position_mm.detach().double(), slope.double()

    truth, slope = traced(torch.float64, near)
    found, other = traced(torch.float32, near * _f64([1.0, 1.0, 2e6]))
    yield Check("position less that of float64, mm", 0, found - truth, 3e-5)
    yield Check("curvature gradient over float64", 0, (other - slope).norm() / slope.norm(), 1e-4)


CASES = {
    "flat scene": flat_scene,
    "black frames": black_frames,
    "total reflection": total_reflection,
    "all rays lost": all_rays_lost,
    "pose twist zero": identity_twist,
    "pose near half a turn": half_turn,
    "zero events": zero_events,
    "flow below 1e-3 px": tiny_flow,
    "threshold 1e-3": smallest_threshold,
    "threshold 10": largest_threshold,
    "one-pixel image": one_pixel,
    "static camera": static_camera,
    "motion there and back": turning_point,
    "very strong surfaces": strong_surfaces,
    "object 10 km away, float32": far_object,
}


def _f64(rows):
    return torch.tensor(rows, dtype=torch.float64)


def _plane(amplitude=0.3):
    stand = torch.eye(4, dtype=torch.float64)
    stand[2, 3] = 2.0
    return render.TexturedPlane(
        [[3.0, 1.0], [-2.0, 4.0]], [amplitude, amplitude], [0.3, 1.1], 100.0, stand
    )


def _poses(twist, count=3, twist_per_frame=(0.01, 0.0, 0.0, 0.0, 0.0, 0.0)):
    """Poses of a moving camera, all changed by one learnable twist."""
    start = torch.eye(4, dtype=torch.float64)
    steps = torch.arange(count, dtype=torch.float64)
    return trajectories.body_twist(start, _f64(twist_per_frame), steps) @ pose.se3_exp(twist)


def _render(world, twist, size_px=8, samples=4, **options):
    camera = render.Camera(lens.Pinhole(20.0), size_px, size_px, 0.5, samples, 0)
    return render.frames(camera, world, _poses(twist, **options))


def _twist():
    return torch.zeros(6, dtype=torch.float64, requires_grad=True)


@torch.no_grad()
def _differences(function, at, step):
    """Central differences of a number, entry by entry."""
    units = step * torch.eye(at.numel(), dtype=at.dtype)
    return torch.stack([function(at + unit) - function(at - unit) for unit in units]) / (2 * step)


def _ramp(theta):
    """Memory counts of a brightening pixel (frames 100 to 200), their sum, and its slopes to the
    frames."""
    frames = torch.linspace(100, 200, 5, dtype=torch.float64).reshape(5, 1, 1).requires_grad_()
    total = events.memory(frames, theta, theta)[0].sum()
    return total, torch.autograd.grad(total, frames)[0].flatten()
