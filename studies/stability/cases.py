"""Hard cases of every stage. Each returns what theory expects, what is seen, one number, and whether they
agree, in value and in gradient."""

import math
from dataclasses import dataclass

import torch

from codesign import events, flow, lens, pose, render
from codesign.errors import DomainError
from codesign.types import EventVolume
from scenes import trajectories

GLASS = lens.Glass.from_indices(1.5, 1.5, 1.5)
AHEAD = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Outcome:
    """expected, seen: in words. number: the size of the disagreement (or what the words name). passed:
    whether it is small enough."""

    expected: str
    seen: str
    number: float
    passed: bool


def _f64(rows):
    return torch.tensor(rows, dtype=torch.float64)


def _plane(amplitude=0.3, mean=100.0):
    stand = torch.eye(4, dtype=torch.float64)
    stand[2, 3] = 2.0
    return render.TexturedPlane([[3.0, 1.0], [-2.0, 4.0]], [amplitude, amplitude], [0.3, 1.1], mean, stand)


def _poses(twist, count=3, twist_per_frame=(0.01, 0.0, 0.0, 0.0, 0.0, 0.0)):
    """Poses of a moving camera, all changed by one learnable twist."""
    steps = torch.arange(count, dtype=torch.float64)
    return trajectories.body_twist(
        torch.eye(4, dtype=torch.float64), _f64(twist_per_frame), steps
    ) @ pose.se3_exp(twist)


def _render(world, twist, size_px=8, samples=4, **options):
    return render.frames(
        render.Camera(lens.Pinhole(20.0), size_px, size_px, 0.5, samples, 0), world, _poses(twist, **options)
    )


def _zero_twist():
    return torch.zeros(6, dtype=torch.float64, requires_grad=True)


def flat_scene():
    twist = _zero_twist()
    images = _render(_plane(amplitude=0.0), twist)
    (grad,) = torch.autograd.grad(images.square().sum(), twist)
    fired = events.memory(images.detach(), 0.01, 0.01)[0].sum()
    images = images.detach()
    worst = max(float((images - 100).abs().max()), float(grad.abs().max()), float(fired))
    return Outcome(
        "radiance 100 everywhere, no events at threshold 0.01, pose gradient 0",
        f"largest departure {worst:.1e}",
        worst,
        worst <= 1e-9,
    )


def black_frames():
    frames = torch.zeros(4, 6, 6, dtype=torch.float64, requires_grad=True)
    level = events.lin_log(frames)
    counts = events.memory(frames, 0.2, 0.2)[0]
    soft = events.soft_counts(frames, 0.2, 0.2)
    (slope,) = torch.autograd.grad(level.sum(), frames)
    (through,) = torch.autograd.grad((soft[:, 0] - soft[:, 1])[-1].sum(), frames)
    error = max(
        float(counts.detach().sum()),
        float((slope - math.log(20) / 20).abs().max()),
        float((through[-1] - math.log(20) / 20 / 0.2).abs().max()),
    )
    return Outcome(
        "no events; gradient that of the linear part, ln(20)/20 per threshold",
        f"largest departure {error:.1e}",
        error,
        error <= 1e-12,
    )


def total_reflection():
    geo = lens.GeoLens([lens.Surface(math.inf, 5.0, GLASS, 99.0), lens.Surface(-10.0, 10.0, None, 9.9)], 4.0)
    out = geo.trace(_f64([(8.0, 0.0, -5.0)]), _f64([AHEAD]))
    wanted = 1.5**2 * 0.64 - 1  # sin = 0.8 inside the glass
    grads = torch.autograd.grad(out.deficit.sum(), [geo.curvature_per_mm, geo.thickness_mm])
    slope = float(
        grads[0][1]
    )  # deficit n^2 (h c)^2 - 1 in the curvature of the second surface: 2 n^2 h^2 c, with c = -1/10
    truth = 2 * 1.5**2 * 64 * -0.1
    error = max(
        abs(float(out.deficit.detach()) - wanted),
        abs(slope / truth - 1),
        float(out.weight.detach().abs()),
        abs(int(out.status) - int(lens.Status.TOTAL_REFLECTION)),
    )
    seen = f"{lens.Status(int(out.status)).name}, weight {float(out.weight.detach()):g}, deficit {float(out.deficit.detach()):.6g}, slope {slope:.6g}"
    return Outcome(
        f"TOTAL_REFLECTION, weight 0, deficit {wanted:.6g}, slope to the curvature {truth:.6g}",
        seen,
        error,
        error <= 1e-6,
    )


def all_rays_lost():
    geo = lens.GeoLens([lens.Surface(10.0, 5.0, GLASS, 9.0), lens.Surface(math.inf, 10.0, None, 9.0)], 4.0)
    out = geo.trace(_f64([(20.0, 0.0, -5.0), (0.0, 15.0, -5.0)]), _f64([AHEAD, AHEAD]))
    (slope,) = torch.autograd.grad(out.deficit.sum(), geo.curvature_per_mm)
    truth = 2 * (400 + 225) * 0.1  # deficit (h c)^2 - 1 each
    error = max(
        float(out.weight.detach().sum()),
        abs(float(slope[0]) / truth - 1),
        float((out.deficit.detach() - _f64([3.0, 1.25])).abs().max()),
    )
    ball = lens.GeoLens(
        [lens.Surface(5.0, 10.0, GLASS, 4.99, is_stop=True), lens.Surface(-5.0, 8.0, None, 4.99)], 8.0
    )
    try:
        ball.camera_rays(_f64([(8.0, 0.0)]), _f64([(-1.0, 0.0)]))
        said = "camera says nothing"
    except DomainError:
        said = "camera refuses"
    return Outcome(
        "weights 0, deficits 3 and 1.25, slope 125; a camera refuses with a sentence",
        f"slope {float(slope[0]):.6g}, {said}",
        error,
        error <= 1e-6 and said == "camera refuses",
    )


def identity_twist():
    """At twist 0: the pose is the identity, and the gradient is the one differences give on either side."""
    world = _plane()
    twist = _zero_twist()
    (grad,) = torch.autograd.grad(_render(world, twist).square().mean(), twist)
    step = 1e-5
    found = []
    for axis in torch.eye(6, dtype=torch.float64):
        ahead, back = (float(_render(world, sign * step * axis).square().mean()) for sign in (1, -1))
        found.append((ahead - back) / (2 * step))
    error = float((grad - _f64(found)).norm() / _f64(found).norm())
    rest = float((pose.se3_exp(torch.zeros(6, dtype=torch.float64)) - torch.eye(4)).abs().max())
    return Outcome(
        "exp(0) is the identity; gradient equals central differences to 1e-6",
        f"identity to {rest:.0e}, gradient to {error:.1e}",
        error,
        rest == 0 and error <= 1e-6,
    )


def zero_events():
    counts = torch.zeros(1, 2, 5, 16, 16, dtype=torch.float64, requires_grad=True)
    edges = torch.linspace(0, 0.1, 6, dtype=torch.float64)
    field = flow.estimate_lk(EventVolume(counts, (edges[1:] + edges[:-1]) / 2, edges.diff()))
    (grad,) = torch.autograd.grad(field.flow_px.sum(), counts)
    size = max(float(field.flow_px.detach().abs().max()), float(grad.abs().max()))
    return Outcome(
        "flow 0, marked invalid, gradient 0 (the flow is quadratic in the counts)",
        f"largest {size:.1e}, valid pixels {int(field.valid.sum())}",
        size,
        size == 0 and not field.valid.any(),
    )


def tiny_flow():
    """A pattern that moves 5e-4 px over the interval: the smooth volume must give that flow, not zero and not
    noise."""
    motion = torch.tensor(5e-4, dtype=torch.float64, requires_grad=True)
    x = torch.arange(48, dtype=torch.float64)
    t_s = torch.linspace(0, 0.1, 11, dtype=torch.float64)

    def frames(shift):
        at = (x - shift * (t_s / 0.1)[:, None])[:, None, :]
        glow = 1.2 ** (4 * t_s / 0.1)  # all of it brightens, so that events come whatever the motion
        return (
            60
            * (torch.cos(2 * math.pi * at / 16) * 0.3 + torch.cos(2 * math.pi * x / 12)[:, None] * 0.3).exp()
            ** glow[:, None, None]
        )

    def estimate(shift):
        volume = events.from_counts(events.soft_counts(frames(shift), 0.2, 0.2), t_s, 5)
        return flow.estimate_lk(volume, "constant").flow_px[0, 0].mean()

    rest = float(estimate(torch.zeros(1, dtype=torch.float64)[0]))
    found = estimate(motion)
    (slope,) = torch.autograd.grad(found, motion)
    moved = (float(found.detach()) - rest) / float(motion.detach())
    h = 1e-3
    difference = float(estimate(motion.detach() + h) - estimate(motion.detach() - h)) / (2 * h)
    error = max(abs(moved / float(slope) - 1), abs(float(slope) / difference - 1))
    seen = f"change {moved:.4f} and derivative {float(slope):.4f} per px, differences {difference:.4f}"
    return Outcome(
        "moving 5e-4 px changes the flow by its derivative times the motion, which differences confirm to 1 "
        "%",
        seen,
        error,
        error <= 0.01,
    )
