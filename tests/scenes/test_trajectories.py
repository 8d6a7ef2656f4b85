"""Camera paths: what they promise about place, view, speed and period."""

import math

import numpy as np
import pytest
import torch

from codesign.errors import DomainError, ShapeError
from codesign.mount import Mount
from codesign.pose import check_poses, inverse, look_at, se3_exp
from scenes import trajectories
from scenes.trajectories import Driving, Flying, Orbital, Swinging, Waves, body_at, minimum_snap, mounted

D = torch.float64


@pytest.fixture
def start():
    return look_at((0.3, -2.0, 1.1), (0.0, 0.0, 1.0))


def test_times_are_uniform_from_zero():
    torch.testing.assert_close(
        trajectories.times(5, 200.0),
        torch.tensor([0.0, 0.005, 0.01, 0.015, 0.02], dtype=D),
        rtol=0,
        atol=1e-17,
    )


@pytest.mark.parametrize(
    ("count", "rate", "sentence"),
    [
        (1, 100.0, "at least 2 frames"),
        (5, 0.0, "rate_hz = 0.0"),
        (5, -3.0, "rate_hz = -3.0"),
        (5, math.nan, "rate_hz = nan"),
    ],
)
def test_too_few_frames_and_impossible_rates_are_refused(count, rate, sentence):
    with pytest.raises(DomainError, match=sentence):
        trajectories.times(count, rate)


def test_translation_has_its_speed_along_the_camera_axes(start):
    t = trajectories.times(11, 50.0)
    path = trajectories.translation(start, (0.5, -0.2, 0.1), t)
    check_poses(path)
    torch.testing.assert_close(path[:, :3, :3], start[:3, :3].expand(11, 3, 3), rtol=0, atol=1e-15)
    velocity = path[:, :3, 3].diff(dim=0) * 50.0
    expected = 0.5 * start[:3, 0] - 0.2 * start[:3, 1] + 0.1 * start[:3, 2]
    torch.testing.assert_close(velocity, expected.expand(10, 3), rtol=0, atol=1e-12)


def test_body_twist_keeps_its_velocity_in_the_camera_and_batches(start):
    t = trajectories.times(9, 100.0)
    twists = torch.tensor([[0.3, 0.0, 0.1, 0.0, 0.5, 0.2], [0.0, 0.1, 0.0, 0.3, 0.0, 0.0]], dtype=D)
    paths = trajectories.body_twist(start, twists, t)
    assert paths.shape == (2, 9, 4, 4)
    for path in paths:
        check_poses(path)
        steps = torch.linalg.inv(path[:-1]) @ path[1:]  # the same small motion from every pose to the next
        torch.testing.assert_close(steps, steps[:1].expand_as(steps), rtol=0, atol=1e-14)
    turn = torch.linalg.inv(paths[0, 0]) @ paths[0, -1]
    angle = math.acos((float(turn[:3, :3].trace()) - 1) / 2)
    assert angle == pytest.approx(0.08 * math.hypot(0.5, 0.2), rel=1e-9)


def test_an_orbit_keeps_its_distance_and_looks_at_the_centre():
    centre = (0.5, -0.2, 1.0)
    radius = 2.0
    height = 0.7
    rate = 3.0
    t = trajectories.times(25, 20.0)
    path = trajectories.orbit(centre, radius, height, rate, t, phase_rad=0.4)
    check_poses(path)
    away = torch.tensor(centre, dtype=D) - path[:, :3, 3]
    torch.testing.assert_close(
        away.norm(dim=1), torch.full((25,), math.hypot(radius, height), dtype=D), rtol=1e-14, atol=0
    )
    torch.testing.assert_close(path[:, :3, 2], away / away.norm(dim=1, keepdim=True), rtol=0, atol=1e-14)
    torch.testing.assert_close(path[:, 2, 3], torch.full((25,), 1.7, dtype=D), rtol=0, atol=1e-15)
    bearing = torch.atan2(-away[:, 1], -away[:, 0])
    steps = torch.remainder(bearing.diff(), 2 * math.pi)
    torch.testing.assert_close(steps, torch.full((24,), rate / 20, dtype=D), rtol=1e-12, atol=0)
    assert float(bearing[0]) == pytest.approx(0.4)


@pytest.mark.parametrize(("path", "axis"), [(trajectories.radial, 2), (trajectories.vertical, 1)])
def test_oscillations_have_their_amplitude_period_and_axis(path, axis, start):
    amplitude = 0.05
    frequency = 4.0
    t = trajectories.times(1001, 1000.0)  # four periods, 250 frames each
    poses = path(start, amplitude, frequency, t)
    check_poses(poses)
    moved = (poses[:, :3, 3] - start[:3, 3]) @ start[:3, :3]  # along the camera's axes
    shift = moved[:, axis]
    # the crest lies within half a frame: cos(pi / 250)
    assert float(shift.max()) == pytest.approx(amplitude, rel=1e-4)
    assert float(shift.min()) == pytest.approx(-amplitude, rel=1e-4)
    torch.testing.assert_close(shift[250:], shift[:-250], rtol=0, atol=1e-14)  # the period
    assert float(moved[:, [i for i in range(3) if i != axis]].abs().max()) <= 1e-15
    speed = float((shift[1] - shift[0]) * 1000)
    assert speed == pytest.approx(2 * math.pi * frequency * amplitude, rel=2e-4)  # steepest at the start


def test_an_axis_may_have_any_length_but_zero(start):
    t = trajectories.times(5, 100.0)
    long, short = (
        trajectories.oscillation(start, axis, 0.1, 3.0, t) for axis in ((3, 0, 4), (0.6, 0.0, 0.8))
    )
    torch.testing.assert_close(long, short, rtol=0, atol=1e-15)
    with pytest.raises(DomainError, match="axis"):
        trajectories.oscillation(start, (0, 0, 0), 0.1, 3.0, t)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


FAMILIES = {
    "orbital": lambda: Orbital((0.2, 0.5, 1.0), 1.5, 0.6, -0.8, 0.3, radius_swing=0.2, rate_swing=0.4),
    "radial": lambda: Swinging.radial(body_at((0.1, -1.0, 1.2), (0.0, 1.0, 1.0)), 0.2, 0.7),
    "vertical": lambda: Swinging.vertical(body_at((0.1, -1.0, 1.2), (0.0, 1.0, 1.0)), 0.2, 0.7),
    "driving": lambda: Driving(seeded(1), 5.0, 0.6, 0.5, x_m=0.3, yaw_rad=0.4),
    "flying": lambda: Flying.random(seeded(2), 5.0, (-1.0, -1.0, 0.8), (1.0, 0.0, 1.6), (0.0, 1.0, 1.0)),
}


@pytest.mark.parametrize("family", FAMILIES)
def test_poses_are_rigid_and_the_velocity_leads_from_one_to_the_next(family):
    path = FAMILIES[family]()
    t = torch.linspace(0.013, 4.9, 157, dtype=D)
    check_poses(path(t))
    step = 1e-4
    # a twist constant over the step differs from the path by the third derivative: step^3 / 24 times (2 pi 9
    # Hz)^3 * 0.008 rad and the like
    ahead = path(t - step / 2) @ se3_exp(step * path.velocity(t))
    torch.testing.assert_close(ahead, path(t + step / 2), rtol=0, atol=1e-9)


@pytest.mark.bits
@pytest.mark.parametrize("family", FAMILIES)
def test_the_same_seed_gives_the_same_path_and_order_of_times_does_not_matter(family):
    t = torch.linspace(0, 4.9, 31, dtype=D)
    one = FAMILIES[family]()
    two = FAMILIES[family]()
    assert torch.equal(one(t), two(t))
    shuffled = torch.randperm(31, generator=seeded())
    # metres up to 5 and turns: sums of some ten products and waves, each within eps = 2.2e-16 of 5
    torch.testing.assert_close(one(t[shuffled]), one(t)[shuffled], rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("t", "error", "sentence"),
    [
        ([0.0, math.nan], DomainError, "finite seconds"),
        ([5.1], DomainError, "from 0 to 5 s"),
        ([-0.1], DomainError, "from 0 to 5 s"),
        ([], ShapeError, "list of times"),
        ([[0.0]], ShapeError, "list of times"),
    ],
)
def test_impossible_times_are_refused(t, error, sentence):
    with pytest.raises(error, match=sentence):
        Driving(seeded(), 5.0)(torch.tensor(t, dtype=D))


def test_orbits_have_their_radius_rate_and_view():
    orbit = Orbital(
        (0.5, -0.2, 1.0),
        2.0,
        0.7,
        1.3,
        0.4,
        radius_swing=0.25,
        rate_swing=0.5,
        radius_period_s=1.7,
        rate_period_s=2.9,
    )
    t = torch.linspace(0, 8, 801, dtype=D)
    away = orbit(t)[:, :3, 3] - torch.tensor([0.5, -0.2, 1.0], dtype=D)
    radius = away[:, :2].norm(dim=1)
    torch.testing.assert_close(radius, 2.0 * (1 + 0.25 * (2 * math.pi * t / 1.7).sin()), rtol=1e-14, atol=0)
    torch.testing.assert_close(orbit(t)[:, :3, 0], -away / away.norm(dim=1, keepdim=True), rtol=0, atol=1e-14)
    assert float(orbit(t)[:, 2, 1].abs().max()) == 0  # level: the left axis is horizontal
    bearing = torch.remainder(torch.atan2(away[:, 1], away[:, 0]).diff(), 2 * math.pi) / 0.01
    middle = (t[1:] + t[:-1]) / 2
    # h^2/24 of (2 pi / 2.9)^2
    torch.testing.assert_close(
        bearing, 1.3 * (1 + 0.5 * (2 * math.pi * middle / 2.9).cos()), rtol=1e-4, atol=0
    )
    # without swings: the closed form of a circle, and of its velocity
    plain = Orbital((0.0, 0.0, 0.0), 2.0, 0.0, 1.3)
    rate = 1.3
    torch.testing.assert_close(
        plain.velocity(t),
        torch.tensor([0, -2.0 * rate, 0, 0, 0, rate], dtype=D).expand(801, 6),
        rtol=0,
        atol=1e-13,
    )


@pytest.mark.parametrize(
    "values",
    [
        {"radius_m": 0.0},
        {"rate_rad_s": 0.0},
        {"radius_swing": 1.0},
        {"rate_swing": -0.1},
        {"rate_period_s": math.nan},
    ],
)
def test_orbits_refuse_what_is_none(values):
    with pytest.raises(DomainError, match="must be"):
        Orbital((0, 0, 0), **{"radius_m": 1.0, "height_m": 0.5, "rate_rad_s": 1.0, **values})


def test_swings_keep_their_axis_and_speed_limit():
    start = body_at((0.3, -1.0, 1.2), (0.1, 1.0, 0.9))
    t = torch.linspace(0, 5, 2001, dtype=D)
    for swing, axis in (
        (Swinging.radial(start, 0.3, 0.8), start[:3, 0]),
        (Swinging.vertical(start, 0.3, 0.8), torch.tensor([0, 0, 1.0], dtype=D)),
    ):
        shift = swing(t)[:, :3, 3] - start[:3, 3]
        along = shift @ axis
        torch.testing.assert_close(along, 0.3 * (2 * math.pi * 0.8 * t).sin(), rtol=0, atol=1e-14)
        torch.testing.assert_close(shift, along[:, None] * axis, rtol=0, atol=1e-14)
        speed = swing.velocity(t)[:, :3].norm(dim=1)
        assert float(speed.max()) == pytest.approx(2 * math.pi * 0.8 * 0.3, rel=1e-6)
        assert float(swing.velocity(t)[:, 3:].abs().max()) == 0


def test_waves_integrate_and_multiply_exactly_and_stay_in_bounds():
    one = Waves.random(seeded(3), 0.7, 0.2, 0.1, 2.0)
    two = Waves.random(seeded(4), -0.3, 0.5, 0.2, 1.0, 4)
    t = torch.linspace(-3, 9, 97, dtype=D)
    torch.testing.assert_close(one.times(two)(t), one(t) * two(t), rtol=0, atol=1e-15)
    # differences of frequencies are 0
    torch.testing.assert_close(one.times(one)(t), one(t) ** 2, rtol=0, atol=1e-15)
    nodes, weights = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(200))
    numeric = ((one.times(one))(t[:, None] * (nodes + 1) / 2) * weights).sum(1) * t / 2
    torch.testing.assert_close(one.times(one).integral(t), numeric, rtol=0, atol=1e-12)
    assert float((one(torch.linspace(0, 100, 20001, dtype=D)) - 0.7).abs().max()) <= 0.2 + 1e-15


def test_a_robot_without_slip_obeys_its_wheels():
    robot = Driving(
        seeded(5),
        6.0,
        0.7,
        0.4,
        slip=0.0,
        side_slip_s=0.0,
        track_m=0.25,
        x_m=0.2,
        y_m=-0.1,
        yaw_rad=0.9,
        heave_m=0,
        pitch_rad=0,
        roll_rad=0,
    )
    t = torch.linspace(0, 6, 601, dtype=D)
    left, right = robot.wheel_speeds(t).unbind(1)
    twist = robot.velocity(t)
    torch.testing.assert_close(twist[:, 0], (left + right) / 2, rtol=0, atol=1e-12)
    torch.testing.assert_close(twist[:, 5], (right - left) / 0.25, rtol=0, atol=1e-12)
    assert float(twist[:, 1:5].abs().max()) < 1e-12  # no sideways, no vertical velocity, no roll, no pitch
    # the path by integrating the wheels alone, Gauss and Legendre over the whole time to 1e-13
    nodes, weights = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(64))
    at = 3 * (nodes + 1)
    yaw = robot.heading_rad(at)
    speed = robot.wheel_speeds(at).mean(1)
    end = torch.stack(
        [0.2 + 3 * (weights * speed * yaw.cos()).sum(), -0.1 + 3 * (weights * speed * yaw.sin()).sum()]
    )
    torch.testing.assert_close(robot(t[-1:])[0, :2, 3], end, rtol=0, atol=1e-12)
    torch.testing.assert_close(robot(t[:1])[0, :2, 3], torch.tensor([0.2, -0.1], dtype=D), rtol=0, atol=1e-15)


def test_slip_slows_and_slides_outwards_and_the_shake_stays_in_its_bounds():
    robot = Driving(
        seeded(6),
        6.0,
        0.7,
        0.8,
        slip=0.1,
        side_slip_s=0.05,
        turn_swing_rad_s=0.2,
        heave_m=0.004,
        pitch_rad=0.01,
        roll_rad=0.02,
        height_m=0.3,
    )
    t = torch.linspace(0, 6, 2001, dtype=D)
    forward, left, turn = robot.ground_velocity(t).unbind(1)
    rolled = robot.wheel_speeds(t)
    assert bool((forward <= rolled.mean(1) + 1e-15).all())
    assert bool((forward >= 0.9 * rolled.mean(1) - 1e-15).all())
    torch.testing.assert_close(left, -0.05 * forward * turn, rtol=0, atol=1e-15)
    assert float(left.max()) < 0  # every turn is to the left: it slides to the right
    poses = robot(t)
    assert float((poses[:, 2, 3] - 0.3).abs().max()) <= 0.004
    assert float((poses[:, 2, 0]).abs().max()) <= math.sin(0.01) + 1e-12
    assert float((poses[:, 2, 1]).abs().max()) <= math.sin(0.02) + 1e-12
    assert float((poses[:, 2, 3] - 0.3).abs().max()) > 0.001  # and it does shake


def snap_by_quadratic_programme(points, times_s):
    """Least integral of squared snap in another basis (monomials of time itself), with continuity only up to
    jerk, by its KKT system."""
    segments = len(times_s) - 1
    terms = 8
    cost = np.zeros((segments * terms, segments * terms))
    rows = []
    right = []

    def power(t, order):
        return [math.perm(k, order) * t ** (k - order) if k >= order else 0.0 for k in range(terms)]

    for m, length in enumerate(np.diff(times_s)):
        nodes, weights = np.polynomial.legendre.leggauss(8)  # squared cubics: exact
        for node, weight in zip((nodes + 1) * length / 2, weights * length / 2, strict=True):
            row = np.array(power(node, 4))
            cost[m * terms : (m + 1) * terms, m * terms : (m + 1) * terms] += 2 * weight * np.outer(row, row)

    def condition(parts, value):
        row = np.zeros(segments * terms)
        for m, t, order, sign in parts:
            row[m * terms : (m + 1) * terms] += sign * np.array(power(t, order))
        rows.append(row)
        right.append(value)

    for m, length in enumerate(np.diff(times_s)):
        condition([(m, 0.0, 0, 1)], points[m])
        condition([(m, length, 0, 1)], points[m + 1])
    for order in (1, 2, 3):
        condition([(0, 0.0, order, 1)], np.zeros(points.shape[1]))
        condition([(segments - 1, times_s[-1] - times_s[-2], order, 1)], np.zeros(points.shape[1]))
        for m in range(segments - 1):
            condition(
                [(m, times_s[m + 1] - times_s[m], order, 1), (m + 1, 0.0, order, -1)],
                np.zeros(points.shape[1]),
            )
    a = np.array(rows)
    b = np.array(right)
    kkt = np.block([[cost, a.T], [a, np.zeros((len(a), len(a)))]])
    return np.linalg.lstsq(
        kkt, np.concatenate([np.zeros((segments * terms, points.shape[1])), b]), rcond=None
    )[0][: segments * terms].reshape(segments, terms, -1)


@pytest.fixture(scope="module")
def waypoints():
    generator = seeded(7)
    return torch.randn(6, 3, generator=generator, dtype=D), torch.tensor(
        [0.0, 0.8, 2.1, 2.9, 4.4, 5.0], dtype=D
    )


def test_minimum_snap_is_the_solution_of_the_quadratic_programme(waypoints):
    points, t = waypoints
    path = minimum_snap(points, t)
    reference = snap_by_quadratic_programme(points.numpy(), t.numpy())
    # per second, as the reference has them
    mine = path.coefficient.numpy() / np.diff(t.numpy())[:, None, None] ** np.arange(8)[:, None]
    at = np.linspace(0, 1, 9)
    for m, length in enumerate(np.diff(t.numpy())):
        basis = (at[:, None] * length) ** np.arange(8)
        # the monomial basis costs it eight digits
        np.testing.assert_allclose(basis @ mine[m], basis @ reference[m], rtol=0, atol=1e-7)


def test_minimum_snap_passes_its_points_and_has_six_continuous_derivatives(waypoints):
    points, t = waypoints
    path = minimum_snap(points, t)
    torch.testing.assert_close(path(t), points, rtol=0, atol=1e-11)
    lengths = t.diff()
    before = path.coefficient[:-1]
    after = path.coefficient[1:]
    for order in range(7):
        factor = torch.tensor([math.perm(k, order) for k in range(8)], dtype=D)
        end = (factor[:, None] * before).sum(1) / lengths[:-1, None] ** order
        start = math.factorial(order) * after[:, order] / lengths[1:, None] ** order
        torch.testing.assert_close(end, start, rtol=1e-9, atol=1e-9 * float(start.abs().max()))
    for order in (1, 2, 3):
        assert float(path(t[[0, -1]], order).abs().max()) < 1e-8
    seventh = (before[:, 7] / lengths[:-1, None] ** 7 - after[:, 7] / lengths[1:, None] ** 7).abs().max()
    assert float(seventh) > 1  # and no more than six


def test_perturbations_of_a_minimum_snap_path_raise_its_snap(waypoints):
    points, t = waypoints
    path = minimum_snap(points, t)
    nodes, weights = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(24))
    cost = cross = bump = 0.0
    generator = seeded(8)
    for start, length in zip(t[:-1], t.diff(), strict=True):
        at = start + length * (nodes + 1) / 2
        weight = weights * length / 2
        snap = path(at, 4)
        cost = cost + (weight[:, None] * snap**2).sum()
        # u^4 (1 - u)^4: zero with three derivatives at both ends of the segment, fourth derivative in closed
        # form
        u = (nodes + 1) / 2
        amplitude = torch.randn(1, 3, generator=generator, dtype=D)
        fourth = (24 - 480 * u + 2160 * u**2 - 3360 * u**3 + 1680 * u**4)[:, None] * amplitude / length**4
        cross = cross + (weight[:, None] * snap * fourth).sum()
        bump = bump + (weight[:, None] * fourth**2).sum()
    assert float(path.cost()) == pytest.approx(float(cost), rel=1e-11)
    # stationary: so a perturbation adds its own snap and nothing else
    assert abs(float(cross)) < 1e-9 * float((cost * bump) ** 0.5)
    # a waypoint's velocity changed while all points are kept: solved again from there, the sum of two paths
    # costs more
    middle = path(torch.tensor([2.5], dtype=D))
    detour = minimum_snap(
        torch.cat([points[:3], middle + 0.01, points[3:]]),
        torch.cat([t[:3], torch.tensor([2.5], dtype=D), t[3:]]),
    )
    through = minimum_snap(
        torch.cat([points[:3], middle, points[3:]]), torch.cat([t[:3], torch.tensor([2.5], dtype=D), t[3:]])
    )
    assert float(detour.cost()) > float(path.cost())
    # a point of the path changes nothing
    assert float(through.cost()) == pytest.approx(float(path.cost()), rel=1e-9)


def test_two_points_give_the_rest_to_rest_polynomial():
    path = minimum_snap([[0.0], [2.0]], [0.0, 3.0])
    t = torch.linspace(0, 3, 31, dtype=D)
    u = t / 3
    torch.testing.assert_close(
        path(t)[:, 0], 2 * (35 * u**4 - 84 * u**5 + 70 * u**6 - 20 * u**7), rtol=0, atol=1e-13
    )


@pytest.mark.parametrize(
    ("t", "sentence"),
    [([0.0, 1.0, 1.0], "increase strictly"), ([0.0, 1.0, math.nan], "NaN"), ([0.0, 0.001, 5.0], "100 times")],
)
def test_minimum_snap_refuses_times_it_cannot_use(t, sentence):
    with pytest.raises(DomainError, match=sentence):
        minimum_snap(torch.zeros(3, 3, dtype=D), t)


def test_a_flight_obeys_newton_and_its_rates_are_those_of_differential_flatness():
    flight = FAMILIES["flying"]()
    t = torch.linspace(0.01, 4.7, 301, dtype=D)
    pose = flight(t)
    acceleration = flight.path(t, 2)[:, :3]
    jerk = flight.path(t, 3)[:, :3]
    up = pose[:, :3, 2]
    gravity = torch.tensor([0.0, 0.0, 9.81], dtype=D)
    thrust = flight.thrust_m_s2(t)
    torch.testing.assert_close(thrust[:, None] * up, acceleration + gravity, rtol=0, atol=1e-12)
    # Mellinger and Kumar, eq. 7 and below: the change of thrust direction gives roll and pitch rate
    change = (jerk - (up * jerk).sum(1, keepdim=True) * up) / thrust[:, None]
    rates = flight.velocity(t)[:, 3:]
    torch.testing.assert_close(rates[:, 0], -(change * pose[:, :3, 1]).sum(1), rtol=0, atol=1e-12)
    torch.testing.assert_close(rates[:, 1], (change * pose[:, :3, 0]).sum(1), rtol=0, atol=1e-12)
    # of the forward axis, which lies in the plane of heading and thrust
    heading = torch.atan2(pose[:, 1, 0], pose[:, 0, 0])
    across = torch.stack([-heading.sin(), heading.cos(), torch.zeros_like(heading)], 1)
    yaw = flight.path(t)[:, 3]
    left = torch.stack([-yaw.sin(), yaw.cos(), torch.zeros_like(yaw)], 1)
    # small tilts: forward stays near the heading
    assert float((pose[:, :3, 0] * left).sum(1).abs().max()) < 0.3
    assert float((across * left).sum(1).min()) > 0.9
    # hovering ends: level, at rest
    ends = flight(torch.tensor([0.0, flight.span_s[1]], dtype=D))
    torch.testing.assert_close(ends[:, :3, 2], torch.tensor([[0.0, 0, 1]] * 2, dtype=D), rtol=0, atol=1e-9)


def test_flights_into_free_fall_are_refused():
    with pytest.raises(DomainError, match="free fall"):
        Flying([[0, 0, 0], [0, 0, 8.0], [0, 0, 0]], [0.0, 0, 0], [0.0, 1.0, 2.0])


def test_a_mounted_camera_is_the_body_times_the_mount_and_passes_gradients_on():
    path = FAMILIES["driving"]()
    t = torch.linspace(0.1, 4.5, 23, dtype=D)
    mount = Mount((0.1, 0.0, 0.2), (0.2, 0.1, 0.1), yaw_rad=0.3, pitch_rad=0.2, roll_rad=0.1)
    camera = mounted(path, mount())
    torch.testing.assert_close(camera(t), path(t) @ mount(), rtol=0, atol=1e-15)
    step = 1e-4
    twist = camera.velocity(t).detach()
    ahead = inverse(camera(t - step / 2).detach()) @ camera(t + step / 2).detach()
    torch.testing.assert_close(ahead, se3_exp(step * twist), rtol=0, atol=1e-9)
    weight = torch.randn(23, 4, 4, generator=seeded(9), dtype=D)
    numbers = mount.numbers.detach().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda n: (
            (mounted(path, mount(n))(t) * weight).sum() + mounted(path, mount(n)).velocity(t).square().sum()
        ),
        (numbers,),
    )
    with pytest.raises(ShapeError, match="one pose"):
        mounted(path, torch.eye(3, dtype=D))
