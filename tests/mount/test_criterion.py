"""Information with the covariance of an estimator, and what is made of it, against least squares written out
by hand."""

import math

import numpy as np
import pytest
import torch

from codesign import lens, render
from codesign.mount import (
    PLANAR,
    EgoVelocity,
    Mount,
    Surroundings,
    expected_error,
    flow_precision,
    observability,
    sight,
    sight_units,
    velocity_from_flow,
)
from codesign.types import FlowField

D = torch.float64
HEIGHT = 0.5
FOCAL_PX = 8.0 / 0.5


@pytest.fixture(scope="module")
def camera():
    return render.Camera(lens.Pinhole(8.0), 6, 4, 0.5, 1)


@pytest.fixture(scope="module")
def down():
    return Mount((0.0, 0.0, HEIGHT), (0.0, 0.0, 0.0), pitch_rad=math.pi / 2)().detach()


def rows_by_hand():
    """[48, 3]: flow of six by four pixels over ground straight below, to forward, left and yaw, as textbooks
    have it; x components and y components of one pixel after another."""
    rows = []
    for row in range(4):
        for column in range(6):
            x, y = column - 2.5, row - 1.5
            rows.append([0.0, FOCAL_PX / HEIGHT, -y])
            rows.append([FOCAL_PX / HEIGHT, 0.0, x])
    return np.array(rows)


def some_covariances(generator, count):
    root = torch.randn(count, 2, 2, generator=generator, dtype=D)
    full = root @ root.mT + 0.1 * torch.eye(2, dtype=D)
    return full, torch.stack([full[:, 0, 0], full[:, 0, 1], full[:, 1, 1]], -1)


def test_precision_is_the_inverse(generator):
    full, packed = some_covariances(generator, 20)
    confidence = torch.rand(20, generator=generator, dtype=D)
    torch.testing.assert_close(flow_precision(packed), torch.linalg.inv(full), rtol=1e-12, atol=0)
    floored = confidence[:, None, None] * torch.linalg.inv(full + 0.09 * torch.eye(2, dtype=D))
    torch.testing.assert_close(flow_precision(packed, confidence, 0.3), floored, rtol=1e-12, atol=0)


def test_information_and_velocity_are_those_of_least_squares_by_hand(camera, down, generator):
    full, packed = some_covariances(generator, 24)
    depth = torch.full((24,), HEIGHT, dtype=D)
    rows = rows_by_hand()
    noise = np.zeros((48, 48))
    for k, block in enumerate(full.numpy()):
        noise[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = block
    by_hand = rows.T @ np.linalg.inv(noise) @ rows
    weight = flow_precision(packed)
    found = observability.information(camera, depth, down, weight)
    # rows by differences of chief rays are good to 1e-9
    torch.testing.assert_close(found, torch.from_numpy(by_hand), rtol=1e-8, atol=0)
    flow = torch.randn(1, 2, 4, 6, generator=generator, dtype=D)
    measured = flow[0].permute(1, 2, 0).reshape(48).numpy()
    solved = np.linalg.solve(by_hand, rows.T @ np.linalg.inv(noise) @ measured)
    velocity = velocity_from_flow(flow, camera, depth, down, weight)[0]
    torch.testing.assert_close(velocity, torch.from_numpy(solved), rtol=1e-8, atol=1e-10)
    # scalar weights are matrices with one number twice
    scalar = torch.rand(24, generator=generator, dtype=D)
    torch.testing.assert_close(
        observability.information(camera, depth, down, scalar[:, None, None] * torch.eye(2, dtype=D)),
        observability.information(camera, depth, down, scalar),
    )


def test_it_is_what_the_estimator_of_the_task_expects(camera, down, generator):
    """EgoVelocity with equal points and no outliers expects the inverse of this information and its prior."""
    _, packed = some_covariances(generator, 24)
    field = FlowField(
        torch.zeros(1, 2, 4, 6, dtype=D),
        torch.ones(1, 4, 6, dtype=torch.bool),
        0.02,
        torch.ones(1, 4, 6, dtype=D),
        packed.T.reshape(1, 3, 4, 6),
    )
    stage = EgoVelocity(prior=(1.0, 2.0, 3.0), every_px=1, floor_px=0.3, outlier=None)
    motion = stage(field, camera, None, down, down[None])
    share = 3 / 24  # a window counts as three points
    weight = share * 0.02**2 * flow_precision(packed, floor=0.3)
    depth = torch.full((24,), HEIGHT, dtype=D)
    known = observability.information(camera, depth, down, weight, prior=(1.0, 2.0, 3.0))
    torch.testing.assert_close(motion.covariance[0], torch.linalg.inv(known), rtol=1e-8, atol=1e-12)
    plain = observability.information(camera, depth, down, weight)
    unit = torch.tensor([0.1, 0.2, 0.3], dtype=D)
    expected = (motion.covariance[0].diagonal() / unit**2).mean().sqrt()
    assert float(expected_error(plain, unit, (1.0, 2.0, 3.0))) == pytest.approx(float(expected), rel=1e-8)


def test_expected_error_is_what_estimates_miss_on_average(generator):
    """Velocities drawn from the prior, measured with noise, estimated by the mean of what they can be."""
    rows = torch.randn(7, 3, generator=generator, dtype=D)
    prior = torch.tensor([0.5, 1.0, 2.0], dtype=D)
    unit = torch.tensor([0.1, 0.1, 0.3], dtype=D)
    draws = 20000
    velocity = prior * torch.randn(draws, 3, generator=generator, dtype=D)
    measured = velocity @ rows.T + torch.randn(draws, 7, generator=generator, dtype=D)
    information = rows.T @ rows
    estimate = measured @ rows @ torch.linalg.inv(information + torch.diag(prior**-2))
    rms = ((estimate - velocity) / unit).square().mean().sqrt()
    # three squared errors a draw: relative error 1 / sqrt(2 * draws) of one alone, five of them
    assert float(expected_error(information, unit, prior)) == pytest.approx(float(rms), rel=5 / 200)


def test_gradient_of_the_criterion_to_mount_and_lens(generator):
    mount = Mount((0.1, 0.05, 0.4), (0.1, 0.1, 0.1), pitch_rad=0.9)
    around = Surroundings((0.0, 0.0, 0.0), deviation_px_s=20.0)

    def error(numbers, focal):
        camera = render.Camera(lens.Pinhole(focal), 12, 8, 0.4, 1)
        information, _ = around.information(camera, mount(numbers))
        return expected_error(information, sight_units(around), (1.0,) * 6)

    numbers = (0.2 * torch.randn(6, generator=generator, dtype=D)).requires_grad_()
    focal = torch.tensor(4.0, dtype=D, requires_grad=True)
    # rows are differences of chief rays, good to 1e-9 over steps of 1e-6
    assert torch.autograd.gradcheck(error, (numbers, focal), eps=1e-5, atol=1e-5, rtol=1e-4)


def test_sight_of_independent_velocities():
    found = sight(torch.diag(torch.tensor([400.0, 25.0, 0.0], dtype=D)), (0.1, 0.2, 0.1), PLANAR)
    assert found.deviation.tolist() == [0.05, 0.2, math.inf]
    assert found.alone.tolist() == [0.05, 0.2, math.inf]
    assert found.weakest_deviation == math.inf
    assert found.weakest_named() == "+1.00 yaw"
    assert (found.blind(), found.blind(0.6), found.blind(0.1)) == (
        ["yaw"],
        ["left", "yaw"],
        ["forward", "left", "yaw"],
    )


def test_sight_of_two_that_look_alike():
    """Forward and pitch seen by their sum alone, each measured a little: the difference shows least."""
    together = torch.tensor([[1.0, 1.0], [1.0, 1.0]], dtype=D) * 100 + torch.eye(2, dtype=D)
    found = sight(together, (1.0, 1.0), (0, 4))
    inverse = torch.linalg.inv(together)
    torch.testing.assert_close(found.deviation, inverse.diagonal().sqrt())
    torch.testing.assert_close(found.alone, torch.full((2,), 101.0, dtype=D).rsqrt())
    assert found.weakest_named() in ("+0.71 forward -0.71 pitch", "-0.71 forward +0.71 pitch")
    assert found.weakest_deviation == pytest.approx(1.0)
