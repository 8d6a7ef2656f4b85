"""Damped least squares against problems of the literature, scipy, and its own interrupted runs
(which must repeat to the last bit); Jacobians and their scales against derivatives by hand."""

import io
import itertools
import json
import math

import pytest
import scipy.optimize
import torch

from codesign.grad.jacobian import by_autograd, by_differences, column_scales, principal_modes
from codesign.optimise.least_squares import DampedLeastSquares, StopRules
from tests import refusals
from tests.numbers import D, close, f64, randn64

FREE = (-math.inf, math.inf)
TIMES = torch.linspace(0.1, 4, 40, dtype=D)


def vector(*values):
    return f64(values)


def rosenbrock(x):
    return torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def powell_singular(x):
    return torch.stack(
        [
            x[0] + 10 * x[1],
            5**0.5 * (x[2] - x[3]),
            (x[1] - 2 * x[2]) ** 2,
            10**0.5 * (x[0] - x[3]) ** 2,
        ]
    )


def freudenstein_roth(x):
    return torch.stack(
        [-13 + x[0] + ((5 - x[1]) * x[1] - 2) * x[1], -29 + x[0] + ((x[1] + 1) * x[1] - 14) * x[1]]
    )


def decay(x):
    """Misfit of a e^(-b t) + c to a curve that it cannot follow."""
    return x[0] * torch.exp(-x[1] * TIMES) + x[2] - (1 / (1 + TIMES) + 0.02 * torch.sin(9 * TIMES))


@pytest.mark.parametrize(
    "jacobian", [by_autograd, by_differences(1e-7), by_differences(1e-5, central=True)]
)
def test_rosenbrock_reaches_its_zero(jacobian):
    found = DampedLeastSquares(rosenbrock, vector(-1.2, 1.0), jacobian).run(200)
    # a zero of the residuals: what the Jacobian lacks only slows the way there
    close(found, vector(1, 1), atol=1e-9)


def test_a_singular_minimum_is_reached_linearly():
    # Powell: a factor of two per step in x, never a breakdown
    stop = StopRules(steps=200, gradient=0, step=0, loss=0)
    solver = DampedLeastSquares(powell_singular, vector(3, -1, 0, 1), stop=stop)
    assert float(solver.run().abs().max()) <= 1e-4
    assert solver.loss <= 1e-16  # fourth powers of 1e-4


def test_a_linear_problem_takes_one_step(generator):
    A = randn64(generator, 9, 4)
    b = randn64(generator, 9)
    solver = DampedLeastSquares(lambda x: A @ x - b, torch.zeros(4, dtype=D), damping=1e-15)
    solver.step()
    truth = torch.linalg.lstsq(A, b).solution
    # condition of A some 10, damping 1e-15
    close(solver.variables, truth, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("problem", "start", "lower", "upper"),
    [
        (freudenstein_roth, (0.5, -2.0), *FREE),
        (decay, (1.0, 1.0, 0.0), *FREE),
        (rosenbrock, (-1.2, 1.9), (-5, -5), (0.8, 5)),
        (rosenbrock, (-1.2, 1.9), (-5, 1.5), (5, 5)),
        (rosenbrock, (-1.2, 1.9), (-1.5, 0.5), (0.5, 3)),
    ],
)
def test_minima_agree_with_scipy(problem, start, lower, upper):
    low, high = (f64(side).expand(len(start)) for side in (lower, upper))
    solver = DampedLeastSquares(problem, vector(*start), lower=low, upper=high)
    found = solver.run(1000)
    assert bool(((low <= found) & (found <= high)).all())

    def plain(x):
        return problem(torch.as_tensor(x)).numpy()

    options = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "max_nfev": 10000}
    free = bool(low.isinf().all())
    truth = scipy.optimize.least_squares(
        plain, start, **options, **({"method": "lm"} if free else {"bounds": (lower, upper)})
    )
    # a minimum with a residual is known to the root of rounding by its loss, 1e-8; scipy's interior
    # steps stop just short of a bound
    assert solver.loss == pytest.approx(truth.cost, rel=1e-12 if free else 1e-6, abs=1e-12)
    close(found, torch.from_numpy(truth.x), rtol=1e-5 if free else 1e-4, atol=1e-5)


def test_residuals_that_are_not_finite_are_failed_steps():
    """log(x) = -5 from x = 2: the full step lands below 0, where the logarithm is NaN."""
    seen = []

    def residuals(x):
        seen.append(float(x.detach()[0]))
        return torch.log(x) + 5

    solver = DampedLeastSquares(residuals, vector(2.0), damping=1e-12)
    found = solver.run(200, progress=lambda entry: seen.append(float(solver.variables)) or entry)
    assert min(seen) < 0  # it did step over the edge
    assert not all(entry.accepted for entry in solver.history)
    assert found.item() == pytest.approx(math.exp(-5), rel=1e-9)


def test_the_loss_never_rises_and_the_history_says_what_happened():
    x = vector(15.0, -2.0)
    solver = DampedLeastSquares(freudenstein_roth, x)
    calls = []
    solver.run(50, progress=calls.append)
    assert calls == solver.history
    losses = [entry.loss for entry in solver.history]
    assert all(b <= a for a, b in itertools.pairwise(losses))
    r = freudenstein_roth(x)
    assert losses[0] == pytest.approx(float(r.square().sum()) / 2, rel=1e-14)
    slope = by_autograd(freudenstein_roth, x, r).T @ r
    assert calls[0].gradient == pytest.approx(float(slope.norm()), rel=1e-12)
    assert solver.stopped in ("gradient", "step", "loss", "damping")


@pytest.mark.parametrize(
    ("problem", "start"), [(rosenbrock, (-1.2, 1.0)), (decay, (1.0, 1.0, 0.1))]
)
def test_steps_do_not_depend_on_the_units_of_the_variables(problem, start):
    start = vector(*start)
    units = vector(1e-4, 1e4, 7.0)[: start.numel()]
    plain = DampedLeastSquares(problem, start)
    other = DampedLeastSquares(lambda u: problem(units * u), start / units)
    for _ in range(6):
        plain.step()
        other.step()
        # the same in exact arithmetic
        close(units * other.variables, plain.variables, rtol=1e-9, atol=1e-12)
    plain.run(200)
    other.run(200)
    assert other.floor == 0
    assert other.loss == pytest.approx(plain.loss, rel=1e-9, abs=1e-20)  # the same minimum


def test_a_null_mode_does_not_hold_the_others():
    """The column of z is 1e-6, its step -1e6, and z^2 grows at once: by its own damping x and y
    wait for 1e6 of it. The minimum is at z = -5e-7 where the derivative of (1 + 1e-6 z + z^2)^2 is
    0."""

    def residuals(v):
        x, y, z = v
        return torch.stack([x - 1, 10 * (y - 2) + (x - 1) ** 2, 1 + 1e-6 * z + z * z])

    solver = DampedLeastSquares(residuals, vector(3, 3, 0))
    found = solver.run(40)
    close(found, vector(1, 2, -5e-7), atol=3e-5)
    # x - 1 within (2e-9 / 2)^0.5; 0.509 without the floor
    assert solver.loss == pytest.approx(0.5, rel=1e-9)


@pytest.mark.bits
@pytest.mark.parametrize("route", ["json", "torch"])
def test_a_resumed_run_repeats_the_uninterrupted_one_to_the_last_bit(route):
    def make():
        return DampedLeastSquares(powell_singular, vector(3, -1, 0, 1), by_differences(1e-7))

    whole = make()
    first = make()
    whole.run(25)
    first.run(11)
    resumed = make().resume(carried(first.state(), route))
    resumed.run(14)
    assert resumed.history == whole.history
    assert torch.equal(resumed.variables, whole.variables)


def carried(state, route):
    """A state after a trip through JSON text or torch.save."""
    if route == "json":
        return json.loads(json.dumps(state))
    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=True)


@refusals.table(__file__, "least squares")
def test_wrong_input_is_refused(row):
    row.holds(globals())


@torch.no_grad()
def test_jacobians_against_derivatives_by_hand():
    x = vector(-1.2, 1.0)
    truth = f64([[-20 * -1.2, 10.0], [-1.0, 0.0]])
    # forward: half the second derivative (20) times the step, and rounding 1e-15 over it; central:
    # exact on a quadratic but for rounding
    for jacobian, atol in (
        (by_autograd, 1e-13),
        (by_differences(1e-6), 1.1e-5),
        (by_differences(1e-4, central=True), 1e-10),
    ):
        close(jacobian(rosenbrock, x, rosenbrock(x)), truth, atol=atol)


def test_differences_use_the_side_where_the_residuals_exist():
    def near_edge(at):
        return torch.sqrt(1 - at) + at  # NaN above 1

    at = vector(1 - 1e-7)
    slope = by_differences(1e-5)(near_edge, at, near_edge(at))
    truth = (near_edge(at) - near_edge(at - 1e-5)) / 1e-5
    close(slope[:, 0], truth, rtol=1e-6)
    alone = by_differences(1e-5)(lambda x: torch.where(x == at, x, math.nan), at, at)
    assert not bool(alone.isfinite().all())


def test_principal_modes_have_effects_at_right_angles_of_size_one(generator):
    J = randn64(generator, 20, 5) * vector(1, 3, 0.1, 10, 1)
    modes = J @ principal_modes(J)
    close(modes.T @ modes, torch.eye(5, dtype=D), atol=1e-11)
    assert float(principal_modes(J, limit=0.05).abs().max()) <= 0.05 * (1 + 1e-12)
    close(J @ torch.diag(column_scales(J)), J / J.norm(dim=0), rtol=1e-12)
