"""Hard cases at the ends of the range: thresholds, image sizes, motions, curvatures, distances. Form as in
studies.stability.cases."""

import torch

from codesign import events, lens, pose, render
from codesign.lens.pinhole import Pinhole
from scenes import trajectories
from studies.stability.cases import AHEAD, GLASS, Outcome, _f64, _plane, _poses, _render, _zero_twist


def _ramp(theta):
    """Memory counts of a brightening pixel (frames 100 to 200), their sum, and its slope to the last
    frame."""
    frames = torch.linspace(100, 200, 5, dtype=torch.float64).reshape(5, 1, 1).requires_grad_()
    total = events.memory(frames, theta, theta)[0].sum()
    (slope,) = torch.autograd.grad(total, frames)
    return float(total.detach()), slope.flatten()


def smallest_threshold():
    total, slope = _ramp(1e-3)
    error = max(
        abs(total - 693), abs(float(slope[-1]) * 200 * 1e-3 - 1), float(slope[1:-1].abs().max())
    )  # ln 2 = 0.69315
    return Outcome(
        "threshold 1e-3: ln(2)/1e-3 = 693 events, slope 1/(200 · 1e-3) = 5 to the last frame, 0 to those "
        "between",
        f"{total:g} events, slope {float(slope[-1]):g}",
        error,
        error <= 1e-9,
    )


def largest_threshold():
    total, slope = _ramp(10.0)
    error = max(total, float(slope.abs().max()))
    return Outcome(
        "threshold 10: no event, and no slope, since ln(2) stays below half a threshold",
        f"{total:g} events, slope {float(slope[-1]):g}",
        error,
        error <= 1e-9,
    )


def one_pixel():
    """One pixel of one sample looks along the axis: its value and its motion are those of the texture at one
    point."""
    world = _plane()
    twist = _zero_twist()
    image = _render(world, twist, size_px=1, samples=1, count=1)
    (grad,) = torch.autograd.grad(image.sum(), twist)
    value = 100 * float((world.amplitude * world.phase.cos()).sum().exp())
    slope = value * float(-(world.amplitude * world.phase.sin() * 2 * torch.pi * world.frequency[:, 0]).sum())
    error = max(abs(float(image.detach()) / value - 1), abs(float(grad[0]) / slope - 1))
    flow = render.true_flow(
        render.Camera(Pinhole(20.0), 1, 1, 0.5, 1, 0), world, _poses(torch.zeros(6, dtype=torch.float64), 2)
    )[0]
    moved = -0.01 / 2.0 * 20.0 / 0.5  # px: 10 mm at 2 m behind 20 mm focal length and 0.5 mm pixels
    error = max(error, abs(float(flow[0, 0]) / moved - 1), abs(float(flow[0, 1])))
    return Outcome(
        f"radiance {value:.6g}, slope {slope:.6g} per metre, flow {moved:g} px",
        f"{float(image.detach()):.6g}, {float(grad[0]):.6g}, {float(flow[0, 0]):.6g}",
        error,
        error <= 1e-9,
    )


def static_camera():
    """Frames of a camera at rest are equal bit for bit; a common change of the pose moves all frames alike,
    so the smooth counts stay 0 and so does their gradient."""
    twist = _zero_twist()
    images = _render(_plane(), twist, twist_per_frame=(0.0,) * 6)
    fired = events.memory(images.detach(), 1e-3, 1e-3)[0].sum()
    soft = events.soft_counts(images, 0.2, 0.2)
    (grad,) = torch.autograd.grad((soft[:, 0] - soft[:, 1]).sum(), twist)
    error = max(
        float(fired),
        float(images.detach().diff(dim=0).abs().max()),
        float(soft.detach().sum()),
        float(grad.abs().max()),
    )
    return Outcome(
        "equal frames, no events at threshold 1e-3, gradient of the signed counts 0",
        f"largest departure {error:.1e}",
        error,
        error <= 1e-9,
    )


def strong_surfaces():
    """A ball lens: rays meet its second half beyond the centre. Paraxial focus R n / (2 (n - 1)) from the
    centre (Hecht, Optics, ch. 6)."""
    radius = 5.0
    n = 1.5
    height = 1e-4
    ball = lens.GeoLens(
        [
            lens.Surface(radius, 2 * radius, GLASS, 4.99),
            lens.Surface(-radius, n * radius / (2 * (n - 1)) - radius, None, 4.99),
        ],
        2.0,
    )
    out = ball.trace(_f64([(height, 0, -9.0), (4.0, 0.0, -9.0)]), _f64([AHEAD, AHEAD]))
    focus = abs(float(out.position_mm[0, 0].detach())) / height
    (slope,) = torch.autograd.grad(out.position_mm[1, 0], ball.curvature_per_mm)
    found = []
    for k in range(2):
        shift = 1e-7
        at = []
        for sign in (1, -1):
            moved = ball.curvature_per_mm.detach().clone()
            moved[k] += sign * shift
            at.append(
                float(
                    ball.replace(curvature_per_mm=moved)
                    .trace(_f64([(4.0, 0.0, -9.0)]), _f64([AHEAD]))
                    .position_mm[0, 0]
                    .detach()
                )
            )
        found.append((at[0] - at[1]) / (2 * shift))
    error = float((slope - _f64(found)).norm() / _f64(found).norm())
    lost = int((out.status != 0).sum())
    return Outcome(
        "focus at R n / (2 (n - 1)); derivative of a ray 0.8 R off the axis equals differences to 1e-6",
        f"focus to {focus:.1e} of the height, derivative to {error:.1e}, {lost} rays lost",
        max(error, focus),
        error <= 1e-6 and focus <= 1e-8 and lost == 0,
    )


def far_object_single_precision():
    """A parallel beam that starts 10 km away in float32 lands where float64 puts it from 5 mm away, and moves
    alike with the curvatures."""
    near = _f64([(x, y, -5.0) for x, y in ((0.0, 0.0), (2.0, 0.0), (0.0, -3.0), (1.5, 2.5))])
    towards = _f64([AHEAD] * 4)

    def traced(dtype, origin):
        geo = lens.load("double-gauss", dtype)
        out = geo.trace(origin.to(dtype), towards.to(dtype))
        (slope,) = torch.autograd.grad(out.position_mm[:, :2].sum(), geo.curvature_per_mm)
        return out.position_mm.detach().double(), slope.double()

    truth, slope = traced(torch.float64, near)
    found, other = traced(torch.float32, near * _f64([1.0, 1.0, 2e6]))
    error = float((found - truth).abs().max())
    bend = float((other - slope).norm() / slope.norm())
    return Outcome(
        "position to 3e-5 mm, curvature gradient to 1e-4",
        f"{error:.1e} mm, gradient {bend:.1e}",
        error,
        error <= 3e-5 and bend <= 1e-4,
    )


def half_turn():
    """A camera turned by almost half a turn and back again: exp and inverse undo each other, and the gradient
    of that nothing is 0."""
    twist = _f64([0.1, -0.2, 0.3, 3.1, 0.1, -0.2]).requires_grad_()
    there = pose.se3_exp(twist)
    back = pose.inverse(there) @ there
    (grad,) = torch.autograd.grad((back * torch.arange(16.0).reshape(4, 4)).sum(), twist)
    error = max(float((back.detach() - torch.eye(4)).abs().max()), float(grad.abs().max()))
    return Outcome(
        "a pose and its inverse give the identity; gradient 0",
        f"largest departure {error:.1e}",
        error,
        error <= 1e-12,
    )


def turning_point():
    """A camera that goes and comes back: hard counts balance to within one event per pixel."""
    t_s = trajectories.times(21, 200.0)
    path = trajectories.vertical(torch.eye(4, dtype=torch.float64), 0.05, 10.0, t_s)  # one period
    images = render.frames(render.Camera(Pinhole(20.0), 8, 8, 0.5, 4, 0), _plane(), path).requires_grad_()
    counts, level = events.memory(images, 0.05, 0.05)
    (slope,) = torch.autograd.grad((counts[:, 0] - counts[:, 1]).sum(), images)
    images = images.detach()
    counts = counts.detach()
    level = level.detach()
    unit = slope * images * 0.05  # all pixels are above 20, so dL/dI = 1/I: slopes in counts per threshold
    whole = float((unit - unit.round()).abs().max())
    shift = float(unit.sum(0).abs().max())  # brightening all frames alike changes no count
    balance = float((counts[:, 0] - counts[:, 1]).sum(0).abs().max())
    drift = float((level[0] - events.lin_log(images[:1])[0]).abs().max()) / 0.05
    return Outcome(
        "per pixel ON and OFF differ by at most one and the level returns to within one threshold; ON - OFF "
        "moves by whole multiples of 1/C per log level, and not with a common brightening",
        f"{float(counts.sum()):g} events, largest difference {balance:g}, level {drift:.2g} thresholds, "
        f"slopes off by {max(whole, shift):.1e}",
        balance,
        float(counts.sum()) > 100 and balance <= 1 and drift <= 1 + 1e-9 and max(whole, shift) <= 1e-9,
    )
