"""Camera paths: what they promise about place, view, speed and period."""

import math

import numpy as np
import pytest
import torch
from torch import pi

from codesign.mount import Mount
from codesign.pose import check_poses, inverse, look_at, se3_exp
from scenes import trajectories
from scenes.trajectories import (
    Driving,
    Flying,
    Orbital,
    Swinging,
    Waves,
    body_at,
    minimum_snap,
    mounted,
)
from tests import refusals
from tests.numbers import D, close, f64, randn64, seeded

START = look_at((0.3, -2.0, 1.1), (0.0, 0.0, 1.0))
BODY = body_at((0.1, -1.0, 1.2), (0.0, 1.0, 1.0))
MOUNT = Mount((0.1, 0.0, 0.2), (0.2, 0.1, 0.1), yaw_rad=0.3, pitch_rad=0.2, roll_rad=0.1)


def driving(**options):
    return Driving(seeded(1), 5.0, 0.6, 0.5, x_m=0.3, yaw_rad=0.4, **options)


def flying():
    return Flying.random(seeded(2), 5.0, (-1.0, -1.0, 0.8), (1.0, 0.0, 1.6), (0.0, 1.0, 1.0))


FAMILIES = {
    "orbital": lambda: Orbital(
        (0.2, 0.5, 1.0), 1.5, 0.6, -0.8, 0.3, radius_swing=0.2, rate_swing=0.4
    ),
    "radial": lambda: Swinging.radial(BODY, 0.2, 0.7),
    "vertical": lambda: Swinging.vertical(BODY, 0.2, 0.7),
    "driving": driving,
    "flying": flying,
    "mounted": lambda: mounted(driving(), MOUNT().detach()),
}


@pytest.mark.bits
@pytest.mark.parametrize("family", FAMILIES)
def test_a_path_is_rigid_led_by_its_velocity_and_the_same_for_the_same_seed(family):
    path = FAMILIES[family]()
    t = torch.linspace(0.013, 4.9, 157, dtype=D)
    poses = path(t)
    check_poses(poses)
    step = 1e-4
    # a twist constant over the step differs from the path by the third derivative: step^3 / 24
    # times (2 pi 9 Hz)^3 * 0.008 rad and the like
    close(
        inverse(path(t - step / 2)) @ path(t + step / 2),
        se3_exp(step * path.velocity(t)),
        atol=1e-9,
    )
    assert torch.equal(FAMILIES[family]()(t), poses)
    order = torch.randperm(157, generator=seeded())
    # metres up to 5 and turns: sums of some ten products and waves, each within eps = 2.2e-16 of 5
    close(path(t[order]), poses[order], atol=1e-14)


def test_times_and_body_twists_are_even_steps_in_the_cameras_own_axes():
    t = trajectories.times(9, 200.0)
    close(t, 0.005 * torch.arange(9, dtype=D), atol=1e-17)
    twists = f64([[0.3, 0.0, 0.1, 0.0, 0.5, 0.2], [0.0, 0.1, 0.0, 0.3, 0.0, 0.0]])
    rates = torch.zeros(2, 4, 4, dtype=D)
    rates[:, :3, :3] = torch.linalg.cross(twists[:, None, 3:], torch.eye(3, dtype=D)[None]).mT
    rates[:, :3, 3] = twists[:, :3]
    expected = START @ torch.linalg.matrix_exp(t[:, None, None] * rates[:, None])
    close(trajectories.body_twist(START, twists, t), expected, atol=1e-14)
    velocity = torch.tensor([0.5, -0.2, 0.1], dtype=torch.float64, requires_grad=True)
    path = trajectories.translation(START, velocity, t)
    way = path[-1, :3, 3] - START[:3, 3]
    (slope,) = torch.autograd.grad(way.square().sum() / 2, velocity)
    close(slope, velocity.detach() * t[-1] ** 2, rtol=1e-12)
    path = trajectories.translation(START, (0.5, -0.2, 0.1), t)
    close(path[:, :3, :3], START[:3, :3].expand(9, 3, 3), atol=1e-15)
    expected = 0.5 * START[:3, 0] - 0.2 * START[:3, 1] + 0.1 * START[:3, 2]
    close(path[:, :3, 3] - START[:3, 3], t[:, None] * expected, atol=1e-14)


def test_orbits_have_their_radius_rate_and_view():
    centre = (0.5, -0.2, 1.0)
    orbit = Orbital(centre, 2.0, 0.7, 1.3, 0.4, 0.25, 0.5, radius_period_s=1.7, rate_period_s=2.9)
    t = torch.linspace(0, 8, 801, dtype=D)
    poses = orbit(t)
    away = poses[:, :3, 3] - f64(centre)
    close(away[:, :2].norm(dim=1), 2 * (1 + 0.25 * (2 * pi * t / 1.7).sin()), rtol=1e-14)
    close(away[:, 2], torch.full_like(t, 0.7), atol=1e-15)
    close(poses[:, :3, 0], -away / away.norm(dim=1, keepdim=True), atol=1e-14)
    # level: the left axis is horizontal, up is up
    assert poses[:, 2, 1].abs().max() == 0
    assert poses[:, 2, 2].min() > 0
    bearing = torch.atan2(away[:, 1], away[:, 0])
    assert float(bearing[0]) == pytest.approx(0.4)
    rate = torch.remainder(bearing.diff(), 2 * pi) / 0.01
    middle = (t[1:] + t[:-1]) / 2
    # h^2 / 24 of (2 pi / 2.9)^2
    close(rate, 1.3 * (1 + 0.5 * (2 * pi * middle / 2.9).cos()), rtol=1e-4)
    # without swings: the closed form of a circle's velocity
    circle = Orbital((0.0, 0.0, 0.0), 2.0, 0.0, 1.3).velocity(t)
    close(circle, f64([0, -2.6, 0, 0, 0, 1.3]).expand(801, 6), atol=1e-13)


def test_swings_keep_their_axis_and_speed_limit():
    t = torch.linspace(0, 5, 2001, dtype=D)
    for swing, axis in (
        (Swinging.radial(BODY, 0.3, 0.8), BODY[:3, 0]),
        (Swinging.vertical(BODY, 0.3, 0.8), f64([0, 0, 1.0])),
    ):
        shift = 0.3 * (2 * pi * 0.8 * t).sin()
        close(swing(t)[:, :3, 3] - BODY[:3, 3], shift[:, None] * axis, atol=1e-14)
        velocity = swing.velocity(t)
        assert float(velocity[:, :3].norm(dim=1).max()) == pytest.approx(
            2 * pi * 0.8 * 0.3, rel=1e-6
        )
        assert velocity[:, 3:].abs().max() == 0


def gauss(count):
    """Nodes in (0, 1) and weights."""
    nodes, weights = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(count))
    return (nodes + 1) / 2, weights / 2


def test_waves_integrate_and_multiply_exactly_and_stay_in_bounds():
    one = Waves.random(seeded(3), 0.7, 0.2, 0.1, 2.0)
    two = Waves.random(seeded(4), -0.3, 0.5, 0.2, 1.0, 4)
    t = torch.linspace(-3, 9, 97, dtype=D)
    close(one.times(two)(t), one(t) * two(t), atol=1e-15)
    # differences of frequencies are 0
    square = one.times(one)
    nodes, weights = gauss(200)
    numeric = (one(t[:, None] * nodes) ** 2 * weights).sum(1) * t
    close(square.integral(t), numeric, atol=1e-12)
    far = (one(torch.linspace(0, 100, 20001, dtype=D)) - 0.7).abs().max()
    assert 0.15 < far <= 0.2 + 1e-15
    assert ((one.rate_rad_s >= 0.2 * pi) & (one.rate_rad_s <= 4 * pi)).all()


def test_a_robot_without_slip_obeys_its_wheels():
    still = {"heave_m": 0, "pitch_rad": 0, "roll_rad": 0, "slip": 0.0, "side_slip_s": 0.0}
    robot = driving(track_m=0.25, y_m=-0.1, **still)
    t = torch.linspace(0, 5, 501, dtype=D)
    left, right = (wheel(t) for wheel in robot._wheels)
    twist = robot.velocity(t)
    close(twist[:, 0], (left + right) / 2, atol=1e-12)
    close(twist[:, 5], (right - left) / 0.25, atol=1e-12)
    # no sideways, no vertical velocity, no roll, no pitch
    assert twist[:, 1:5].abs().max() < 1e-12
    # the path by integrating the wheels alone
    nodes, weights = gauss(64)
    yaw = robot._yaw(5 * nodes)
    step = 5 * weights * sum(wheel(5 * nodes) for wheel in robot._wheels) / 2
    end = f64([0.3, -0.1]) + torch.stack([step @ yaw.cos(), step @ yaw.sin()])
    poses = robot(t)
    close(poses[-1, :2, 3], end, atol=1e-12)
    ahead = (0.3 + math.cos(0.4), -0.1 + math.sin(0.4), 0.3)
    close(poses[0], body_at((0.3, -0.1, 0.3), ahead), atol=1e-15)


def test_slip_slows_and_slides_outwards_and_the_shake_stays_in_its_bounds():
    shake = {"heave_m": 0.004, "pitch_rad": 0.01, "roll_rad": 0.02}
    robot = driving(slip=0.1, side_slip_s=0.05, turn_swing_rad_s=0.2, **shake)
    t = torch.linspace(0, 5, 2001, dtype=D)
    forward, left, turn = robot._ground(t).unbind(1)
    share = forward / (sum(wheel(t) for wheel in robot._wheels) / 2)
    assert 0.9 - 1e-15 <= share.min() < 0.97
    assert 0.93 < share.max() <= 1 + 1e-15
    close(left, -0.05 * forward * turn, atol=1e-15)
    # every turn is to the left: it slides to the right
    assert left.max() < 0
    poses = robot(t)
    for swing, bound in (
        (poses[:, 2, 3] - 0.3, 0.004),
        (poses[:, 2, 0], math.sin(0.01)),
        (poses[:, 2, 1], math.sin(0.02)),
    ):
        assert 0.5 * bound < swing.abs().max() <= bound + 1e-12


def test_minimum_snap_obeys_euler_and_lagrange():
    """Degree 7 through the points, rest at both ends and six continuous derivatives: these
    conditions have one solution, and it is the one of least snap."""
    points = randn64(seeded(7), 6, 3)
    path = minimum_snap(points, f64([0.0, 0.8, 2.1, 2.9, 4.4, 5.0]))
    t = path.knots_s
    close(path(t), points, atol=1e-11)
    for order in (1, 2, 3):
        assert path(t[[0, -1]], order).abs().max() < 1e-8
    for order in range(8):
        powers = [math.perm(k, order) for k in range(8)]
        each = path.coefficient / t.diff()[:, None, None] ** order
        end = torch.einsum("mkd,k->md", each, f64(powers))[:-1]
        start = math.factorial(order) * each[1:, order]
        if order < 7:
            close(end, start, rtol=1e-9, atol=1e-9 * float(start.abs().max()))
        else:
            assert (end - start).abs().max() > 1
    line = minimum_snap([[0.0], [2.0]], [0.0, 3.0])
    t = torch.linspace(0, 3, 31, dtype=D)
    u = t / 3
    rest_to_rest = 2 * (35 * u**4 - 84 * u**5 + 70 * u**6 - 20 * u**7)
    close(line(t)[:, 0], rest_to_rest, atol=1e-13)


def test_a_flight_obeys_newton_and_its_rates_are_those_of_differential_flatness():
    flight = flying()
    t = torch.linspace(0.01, 4.7, 301, dtype=D)
    pose = flight(t)
    acceleration, jerk = (flight.path(t, order)[:, :3] for order in (2, 3))
    forward, left, up = pose[:, :3, :3].unbind(2)
    thrust = flight._thrust(t).norm(dim=1)
    gravity = f64([0.0, 0.0, 9.81])
    close(thrust[:, None] * up, acceleration + gravity, atol=1e-12)
    # Mellinger and Kumar, eq. 7 and below: the change of thrust direction gives roll and pitch rate
    change = (jerk - (up * jerk).sum(1, keepdim=True) * up) / thrust[:, None]
    rates = flight.velocity(t)[:, 3:]
    close(rates[:, 0], -(change * left).sum(1), atol=1e-12)
    close(rates[:, 1], (change * forward).sum(1), atol=1e-12)
    # eq. 5 there: the left axis is across the heading, and forward is ahead
    yaw = flight.path(t)[:, 3]
    heading = torch.stack([yaw.cos(), yaw.sin(), torch.zeros_like(yaw)], 1)
    assert (left * heading).sum(1).abs().max() < 1e-12
    assert (forward * heading).sum(1).min() > 0.9
    # hovering ends: level, at rest
    ends = flight(f64([0.0, flight.span_s[1]]))
    close(ends[:, :3, 2], f64([[0.0, 0, 1]] * 2), atol=1e-9)


def test_a_mounted_camera_passes_gradients_to_its_mount():
    path = driving()
    t = torch.linspace(0.1, 4.5, 7, dtype=D)
    close(mounted(path, MOUNT())(t), path(t) @ MOUNT(), atol=1e-15)
    weight = randn64(seeded(9), 7, 4, 4)

    def read(numbers):
        camera = mounted(path, MOUNT(numbers))
        return (camera(t) * weight).sum() + camera.velocity(t).square().sum()

    assert torch.autograd.gradcheck(read, (MOUNT.numbers.detach().requires_grad_(),))


DROP = [[0, 0, 0], [0, 0, 8.0], [0, 0, 0]]


@refusals.table(__file__, "paths")
def test_what_is_no_path_is_refused(row):
    row.holds(globals())
