"""The lin-log front end against its closed form."""

import math

import torch

from codesign.events import lin_log


def test_values_and_slopes_on_both_sides_of_the_joint():
    frames = torch.tensor(
        [0.0, 1.0, 10.0, 20.0, 20.0 + 1e-9, 100.0, 255.0, 1e4], dtype=torch.float64, requires_grad=True
    )
    level = lin_log(frames)
    slope = math.log(20) / 20
    truth = [0, slope, 10 * slope, math.log(20), math.log(20), math.log(100), math.log(255), math.log(1e4)]
    torch.testing.assert_close(level, torch.tensor(truth, dtype=torch.float64), rtol=0, atol=1e-10)
    level.sum().backward()
    torch.testing.assert_close(
        frames.grad,
        torch.tensor([slope] * 4 + [0.05, 0.01, 1 / 255, 1e-4], dtype=torch.float64),
        rtol=1e-9,
        atol=0,
    )


def test_gradient_away_from_the_joint_against_differences_in_both_orders():
    frames = torch.tensor([0.5, 19.0, 21.0, 200.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lin_log, (frames,))
    assert torch.autograd.gradgradcheck(lin_log, (frames,))
