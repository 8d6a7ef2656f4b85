"""Optimisers against problems of the literature, scipy, and their own interrupted runs (which must repeat to
the last bit)."""

import io
import itertools
import json
import math

import numpy as np
import pytest
import scipy.optimize
import torch

from codesign import lens
from codesign.errors import DomainError, NonFiniteError, ShapeError
from codesign.grad.jacobian import by_autograd, by_differences, column_scales, principal_modes
from codesign.lens.design.modes import make_design
from codesign.optimise import least_squares
from codesign.optimise.adam import ScaledAdam
from codesign.optimise.history import Entry, History
from codesign.optimise.least_squares import DampedLeastSquares, StopRules

D = torch.float64


def vector(*values):
    return torch.tensor(values, dtype=D)


def rosenbrock(x):
    return torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def powell_singular(x):
    return torch.stack(
        [x[0] + 10 * x[1], 5**0.5 * (x[2] - x[3]), (x[1] - 2 * x[2]) ** 2, 10**0.5 * (x[0] - x[3]) ** 2]
    )


def freudenstein_roth(x):
    return torch.stack(
        [-13 + x[0] + ((5 - x[1]) * x[1] - 2) * x[1], -29 + x[0] + ((x[1] + 1) * x[1] - 14) * x[1]]
    )


TIMES = torch.linspace(0.1, 4, 40, dtype=D)


def decay(x):
    """Misfit of a e^(-b t) + c to a curve that it cannot follow."""
    return x[0] * torch.exp(-x[1] * TIMES) + x[2] - (1 / (1 + TIMES) + 0.02 * torch.sin(9 * TIMES))


class TestDampedLeastSquares:
    @pytest.mark.parametrize(
        "jacobian", [by_autograd, by_differences(1e-7), by_differences(1e-5, central=True)]
    )
    def test_rosenbrock_reaches_its_zero(self, jacobian):
        solver = DampedLeastSquares(rosenbrock, vector(-1.2, 1.0), jacobian)
        found = solver.run(200)
        # a zero of the residuals: what the Jacobian lacks only slows the way there
        torch.testing.assert_close(found, vector(1, 1), rtol=0, atol=1e-9)

    def test_powell_singular_function(self):
        """The Jacobian is singular at the minimum 0: convergence is linear, a factor of two per step in x,
        never a breakdown."""
        solver = DampedLeastSquares(
            powell_singular, vector(3, -1, 0, 1), stop=StopRules(steps=200, gradient=0, step=0, loss=0)
        )
        found = solver.run()
        assert float(found.abs().max()) <= 1e-4
        assert solver.loss <= 1e-16  # fourth powers of 1e-4

    def test_a_linear_problem_takes_one_step(self, generator):
        A = torch.randn(9, 4, dtype=D, generator=generator)
        b = torch.randn(9, dtype=D, generator=generator)
        solver = DampedLeastSquares(lambda x: A @ x - b, torch.zeros(4, dtype=D), damping=1e-15)
        solver.step()
        truth = torch.linalg.lstsq(A, b).solution
        # condition of A some 10, damping 1e-15
        torch.testing.assert_close(solver.variables, truth, rtol=1e-12, atol=1e-12)

    @pytest.mark.parametrize(
        ("problem", "start"),
        [(freudenstein_roth, (0.5, -2.0)), (decay, (1.0, 1.0, 0.0)), (rosenbrock, (-1.2, 1.0))],
    )
    def test_minima_agree_with_scipy(self, problem, start):
        solver = DampedLeastSquares(problem, vector(*start))
        found = solver.run(1000)

        def plain(x):
            return problem(torch.from_numpy(np.asarray(x))).numpy()

        truth = scipy.optimize.least_squares(
            plain, start, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=10000
        )
        # a minimum with a residual is known to the root of rounding by its loss, 1e-8, and better by its
        # gradient
        assert solver.loss == pytest.approx(truth.cost, rel=1e-12, abs=1e-25)
        torch.testing.assert_close(found, torch.from_numpy(truth.x), rtol=1e-5, atol=1e-6)

    @pytest.mark.parametrize(
        ("lower", "upper"), [((-5, -5), (0.8, 5)), ((-5, 1.5), (5, 5)), ((-1.5, 0.5), (0.5, 3))]
    )
    def test_bounded_minima_agree_with_scipy(self, lower, upper):
        solver = DampedLeastSquares(rosenbrock, vector(-1.2, 1.9), lower=vector(*lower), upper=vector(*upper))
        found = solver.run(500)

        def plain(x):
            return rosenbrock(torch.from_numpy(np.asarray(x))).numpy()

        truth = scipy.optimize.least_squares(
            plain, (-1.2, 1.9), bounds=(lower, upper), xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=10000
        )
        assert bool((found >= vector(*lower)).all())
        assert bool((found <= vector(*upper)).all())
        # scipy's interior steps stop just short of a bound
        assert solver.loss == pytest.approx(truth.cost, rel=1e-6, abs=1e-12)
        torch.testing.assert_close(found, torch.from_numpy(truth.x), rtol=1e-4, atol=1e-5)

    def test_a_hinge_row_gives_the_minimum_of_the_penalised_problem(self):
        """min (x - 3)^2 + w^2 max(0, x - 1)^2 lies at (3 + w^2) / (1 + w^2)."""
        solver = DampedLeastSquares(
            lambda x: torch.stack([x[0] - 3, 10 * (x[0] - 1).clamp_min(0)]), vector(0.0)
        )
        assert solver.run(100).item() == pytest.approx((3 + 100) / 101, rel=1e-9)

    def test_residuals_that_are_not_finite_are_failed_steps(self):
        """log(x) = -5 from x = 2: the full step lands below 0, where the logarithm is NaN."""
        seen = []

        def residuals(x):
            seen.append(float(x.detach()[0]))
            return torch.log(x) + 5

        solver = DampedLeastSquares(residuals, vector(2.0), damping=1e-12)
        while not solver.stopped and len(solver.history) < 200:
            solver.step()
            assert bool(solver.variables.isfinite().all())
            assert solver.variables.item() > 0
        assert min(seen) < 0  # it did step over the edge
        assert not all(solver.history.column("accepted"))
        assert solver.variables.item() == pytest.approx(math.exp(-5), rel=1e-9)

    def test_the_loss_never_rises_and_the_history_says_what_happened(self):
        solver = DampedLeastSquares(freudenstein_roth, vector(15.0, -2.0))
        calls = []
        solver.run(50, progress=calls.append)
        losses = solver.history.column("loss")
        assert all(b <= a for a, b in itertools.pairwise(losses))
        assert calls == solver.history.entries
        x = vector(15.0, -2.0)
        r = freudenstein_roth(x)
        J = by_autograd(freudenstein_roth, x, r)
        assert losses[0] == pytest.approx(float(r.square().sum()) / 2, rel=1e-14)
        assert solver.history[0].gradient == pytest.approx(float((J.T @ r).norm()), rel=1e-12)
        assert solver.stopped in ("gradient", "step", "loss", "damping")

    def test_steps_do_not_depend_on_the_units_of_the_variables(self):
        units = vector(1e-3, 1e4, 7.0)
        plain = DampedLeastSquares(decay, vector(1, 1, 0.1))
        other = DampedLeastSquares(lambda u: decay(units * u), vector(1, 1, 0.1) / units)
        for _ in range(6):
            plain.step()
            other.step()
            # the same in exact arithmetic
            torch.testing.assert_close(units * other.variables, plain.variables, rtol=1e-9, atol=1e-12)

    @pytest.mark.parametrize(("problem", "start"), [(rosenbrock, (-1.2, 1.0)), (decay, (1.0, 1.0, 0.0))])
    def test_no_floor_where_steps_succeed_however_the_units_differ(self, problem, start):
        start = vector(*start)
        units = vector(1e-4, 1e4, 1.0)[: start.numel()]
        plain = DampedLeastSquares(problem, start)
        other = DampedLeastSquares(lambda u: problem(units * u), start / units)
        plain.run(200)
        other.run(200)
        assert other.floor == 0
        assert other.loss == pytest.approx(plain.loss, rel=1e-9, abs=1e-20)  # the same minimum

    def test_a_null_mode_does_not_hold_the_others(self):
        """The column of z is 1e-6, its step -1e6, and z^2 grows at once: by its own damping x and y wait for
        1e6 of it. The minimum is at z = -5e-7 where the derivative of (1 + 1e-6 z + z^2)^2 is 0."""

        def residuals(v):
            x, y, z = v
            return torch.stack([x - 1, 10 * (y - 2) + (x - 1) ** 2, 1 + 1e-6 * z + z * z])

        solver = DampedLeastSquares(residuals, vector(3, 3, 0))
        found = solver.run(40)
        torch.testing.assert_close(found, vector(1, 2, -5e-7), rtol=0, atol=3e-5)
        # x - 1 within (2e-9 / 2)^0.5; 0.509 without the floor
        assert solver.loss == pytest.approx(0.5, rel=1e-9)

    def test_modes_of_a_lens_that_no_ray_sees_do_not_stall_it(self, monkeypatch):
        """The double Gauss has a plane stop in air: its curvature, and how the gap around it is shared, blur
        nothing, and their columns of J are rounding. Without the floor most runs stall, which ones is
        rounding too: hence eight starts, 1e-13 apart."""
        geo = lens.load("double-gauss")
        fields = (0.0, 0.12, 0.22)
        design = make_design(geo, fields, 0.005)
        starts = 1e-13 * torch.randn(8, 21, dtype=D, generator=torch.Generator().manual_seed(0))

        def residuals(x):
            candidate = design.lens(x)
            points, weight = lens.spots(candidate, fields, grid=6)
            weight = weight[..., None]
            blur = points - (points * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True)
            return torch.cat([(blur * weight).reshape(-1) / 0.05, 3 * design.penalty(candidate).reshape(1)])

        def left(start):
            """Loss after 40 steps over that at the start."""
            solver = DampedLeastSquares(residuals, start, by_differences(1e-6))
            solver.run(40)
            return solver.loss / solver.history[0].loss

        assert all(left(start) < 0.02 for start in starts[:3])
        monkeypatch.setattr(least_squares, "FLOOR", 0.0)
        assert any(left(start) > 0.9 for start in starts)

    @pytest.mark.bits
    @pytest.mark.parametrize("route", ["json", "torch"])
    def test_a_resumed_run_repeats_the_uninterrupted_one_to_the_last_bit(self, route):
        def make():
            return DampedLeastSquares(powell_singular, vector(3, -1, 0, 1), by_differences(1e-7))

        whole = make()
        first = make()
        whole.run(25)
        first.run(11)
        resumed = make().resume(carried(first.state(), route))
        resumed.run(14)
        assert resumed.history.rows() == whole.history.rows()
        assert torch.equal(resumed.variables, whole.variables)
        assert any(not e.accepted for e in whole.history.entries) or len(whole.history) == 25

    def test_wrong_input_is_refused(self):
        with pytest.raises(ShapeError, match="vector"):
            DampedLeastSquares(rosenbrock, torch.zeros(2, 2, dtype=D))
        with pytest.raises(DomainError, match="start"):
            DampedLeastSquares(rosenbrock, vector(math.nan, 0))
        with pytest.raises(DomainError, match="outside its bounds"):
            DampedLeastSquares(rosenbrock, vector(0, 0), lower=vector(1, 1))
        with pytest.raises(DomainError, match="residuals at the start"):
            DampedLeastSquares(lambda x: torch.log(x), vector(-1.0))
        with pytest.raises(ShapeError, match="state has 2"):
            DampedLeastSquares(powell_singular, vector(3, -1, 0, 1)).resume(
                DampedLeastSquares(rosenbrock, vector(0, 0)).state()
            )


class TestScaledAdam:
    def test_the_first_steps_by_hand(self):
        """Loss x^2 / 2 with scale 2: u' = -0.1 sign at first (Kingma and Ba), so x moves by 0.2; then the
        averages by hand."""
        solver = ScaledAdam(lambda x: x.square().sum() / 2, vector(5.0), vector(2.0), step_size=0.1)
        solver.step()
        assert solver.variables.item() == pytest.approx(5 - 0.2, rel=1e-12)
        g1 = 2 * 5.0
        g2 = 2 * 4.8
        mean = (0.9 * 0.1 * g1 + 0.1 * g2) / (1 - 0.9**2)
        square = (0.999 * 0.001 * g1**2 + 0.001 * g2**2) / (1 - 0.999**2)
        solver.step()
        assert solver.variables.item() == pytest.approx(4.8 - 2 * 0.1 * mean / square**0.5, rel=1e-12)

    def test_it_takes_the_steps_of_torch_adam(self):
        """An independent program: torch.optim.Adam on the scaled variables."""
        scales = vector(0.3, 2.0)
        start = vector(-1.2, 1.0)
        mine = ScaledAdam(lambda x: rosenbrock(x).square().sum(), start, scales, step_size=0.05)
        u = torch.zeros(2, dtype=D, requires_grad=True)
        theirs = torch.optim.Adam([u], lr=0.05, eps=1e-12)
        for _ in range(30):
            mine.step()
            theirs.zero_grad()
            rosenbrock(start + scales * u).square().sum().backward()
            theirs.step()
        torch.testing.assert_close(mine.variables, (start + scales * u).detach(), rtol=1e-9, atol=1e-9)

    def test_scales_from_the_jacobian_mend_bad_units(self, generator):
        """A quadratic with columns of size 1e-3 and 1e3: the same path in scaled units as with columns of
        size 1."""
        A = torch.linalg.qr(torch.randn(6, 2, dtype=D, generator=generator))[0]
        units = vector(1e-3, 1e3)
        target = torch.randn(6, dtype=D, generator=generator)

        def loss(x):
            return (A @ (x * units) - target).square().sum()

        solver = ScaledAdam(loss, vector(0, 0), column_scales(A * units), step_size=0.05)
        best = solver.run(800)
        truth = float((target - A @ (A.T @ target)).square().sum())
        assert float(loss(best)) == pytest.approx(truth, rel=1e-4)

    @pytest.mark.bits
    @pytest.mark.parametrize("route", ["json", "torch"])
    def test_a_resumed_run_repeats_the_uninterrupted_one_to_the_last_bit(self, route):
        def make():
            return ScaledAdam(lambda x: rosenbrock(x).square().sum(), vector(-1.2, 1.0), vector(0.5, 1.0))

        whole = make()
        first = make()
        whole.run(40)
        first.run(17)
        resumed = make().resume(carried(first.state(), route))
        resumed.run(23)
        assert resumed.history.rows() == whole.history.rows()
        assert torch.equal(resumed.variables, whole.variables)
        assert torch.equal(resumed.best, whole.best)

    def test_a_loss_that_is_not_finite_is_a_failed_step(self):
        """5 x - log x has its minimum at 0.2; from 0.5 a first step of 1.7 lands at -1.2, where the logarithm
        is NaN."""
        solver = ScaledAdam(
            lambda x: -torch.log(x).sum() + 5 * x.sum(), vector(0.5), step_size=1.7, betas=(0.5, 0.9)
        )
        for _ in range(300):
            solver.step()
            assert bool(solver.variables.isfinite().all())
        assert not all(solver.history.column("accepted"))
        assert solver.best.item() == pytest.approx(0.2, rel=1e-2)
        with pytest.raises(NonFiniteError):
            ScaledAdam(lambda x: torch.log(x).sum(), vector(-1.0))


def test_jacobians_against_derivatives_by_hand():
    x = vector(-1.2, 1.0)
    truth = torch.tensor([[-20 * -1.2, 10.0], [-1.0, 0.0]], dtype=D)
    torch.testing.assert_close(by_autograd(rosenbrock, x, rosenbrock(x)), truth, rtol=1e-14, atol=0)
    # forward: half the second derivative (20) times the step, and rounding 1e-15 over it; central: exact on a
    # quadratic but for rounding
    torch.testing.assert_close(by_differences(1e-6)(rosenbrock, x, rosenbrock(x)), truth, rtol=0, atol=1.1e-5)
    torch.testing.assert_close(
        by_differences(1e-4, central=True)(rosenbrock, x, rosenbrock(x)), truth, rtol=0, atol=1e-10
    )


def test_differences_use_the_side_where_the_residuals_exist():
    x = vector(1.0)

    def near_edge(at):
        return torch.sqrt(1 - at) + at  # NaN above 1

    at = vector(1 - 1e-7)
    slope = by_differences(1e-5)(near_edge, at, near_edge(at))
    truth = (near_edge(at) - near_edge(at - 1e-5)) / 1e-5
    torch.testing.assert_close(slope[:, 0], truth, rtol=1e-6, atol=0)
    assert not bool(
        by_differences(1e-5)(lambda at: torch.where(at == x, at, math.nan), x, x).isfinite().all()
    )


def test_principal_modes_have_effects_at_right_angles_of_size_one(generator):
    J = torch.randn(20, 5, dtype=D, generator=generator) * vector(1, 3, 0.1, 10, 1)
    modes = J @ principal_modes(J)
    torch.testing.assert_close(modes.T @ modes, torch.eye(5, dtype=D), rtol=0, atol=1e-11)
    held = principal_modes(J, limit=0.05)
    assert float(held.abs().max()) <= 0.05 * (1 + 1e-12)
    torch.testing.assert_close(J @ torch.diag(column_scales(J)), J / J.norm(dim=0), rtol=1e-12, atol=0)


def test_history_reads_back():
    history = History([Entry(1.5, 0.1, 0.2, 1e-3, True), Entry(1.4, 0.1, 0.0, 2e-3, False)])
    assert History.of(json.loads(json.dumps(history.rows()))).entries == history.entries
    assert history.column("accepted") == [True, False]


def carried(state, route):
    """A state after a trip through JSON text or torch.save."""
    if route == "json":
        return json.loads(json.dumps(state))
    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=True)
