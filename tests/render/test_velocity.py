"""Camera velocity from poses: constant twists come back, world axes by differences, and the
logarithm against the matrix logarithm."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import logm

from codesign.pose import se3_exp
from codesign.render import camera_velocity
from codesign.render.truth import se3_log
from scenes import trajectories
from tests.numbers import close, f64, randn64

TWIST = f64([0.3, -0.2, 0.5, 0.7, -1.1, 0.4])


def start():
    return se3_exp(f64([1.0, -2.0, 0.5, 0.4, 0.8, -0.6]))


def test_a_constant_twist_comes_back_at_any_spacing():
    t_s = f64([0.0, 0.001, 0.01, 0.3, 0.5, 1.7])  # turns of 1e-3 to 1.6 rad
    body, _ = camera_velocity(trajectories.body_twist(start(), TWIST, t_s), t_s)
    truth = TWIST.expand(5, 6)
    assert (body - truth)[1:].abs().max() <= 1e-13
    # positions of 2 m round to 4e-16 m over 1 ms
    assert (body - truth)[0].abs().max() <= 1e-12


def test_velocity_in_world_axes_is_that_of_the_centre_and_the_spin_at_the_middle():
    # by central differences of the position and of the rotation about the middle time: they bend by
    # (1e-4)^2 of the motion
    t_s = f64([0.2, 0.6])
    _, world = camera_velocity(trajectories.body_twist(start(), TWIST, t_s), t_s)
    around = trajectories.body_twist(start(), TWIST, f64([0.4 - 1e-4, 0.4, 0.4 + 1e-4]))
    velocity = (around[2, :3, 3] - around[0, :3, 3]) / 2e-4
    spin = (around[2, :3, :3] - around[0, :3, :3]) / 2e-4 @ around[1, :3, :3].T
    omega = torch.stack([spin[2, 1], spin[0, 2], spin[1, 0]])
    close(world[0], torch.cat([velocity, omega]), atol=1e-7)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-4, 9.9e-3, 1.01e-2, 0.5, 1.5, 1.6, 2.9])
def test_logarithm_is_that_of_the_matrix(angle, generator):
    axis = torch.nn.functional.normalize(randn64(generator, 3), dim=0)
    twist = torch.cat([randn64(generator, 3), angle * axis])
    found = se3_log(se3_exp(twist)[None])[0]
    # the angle comes of a sine that is small near half a turn
    close(found, twist, atol=2e-15 / max(math.sin(angle), 0.1))
    L = torch.from_numpy(np.real(logm(se3_exp(twist).numpy())))
    close(found, torch.stack([*L[:3, 3], L[2, 1], L[0, 2], L[1, 0]]), atol=1e-12)


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-5, 4e-3, 0.5])
def test_gradcheck(scale, generator):
    twist = (scale * randn64(generator, 2, 6)).requires_grad_()
    # the identity, by way of the group
    assert torch.autograd.gradcheck(lambda w: se3_log(se3_exp(w)), twist, atol=1e-8)
