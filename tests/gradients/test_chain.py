"""Gradients along the whole chain, certified with the cases that studies/gradient_flow.py reports."""

import pytest
import torch

from codesign.optimise.descent import Descent
from studies.gradient_flow import cases as gradient_cases

SMOOTH = {label: (required, rows) for label, required, rows in gradient_cases.smooth_cases(0)}


@pytest.mark.parametrize(
    "label",
    [
        "lens rays, float64",
        "frames, plane, float64",
        "frames, room, float32",
        "true flow, float64",
        "event counts, smooth",
        "flow estimate, float64",
    ],
)
def test_junction_gradients_agree_with_differences(label):
    required, rows = SMOOTH[label]
    for row in rows():
        assert row.relative_error <= required["error"], row
        assert row.noise_floor <= required["error"], row  # otherwise the differences could not have judged


def test_straight_through_gradient_of_the_lens_points_where_the_hard_loss_falls():
    # 32 cases give a cosine of 0.997 to three curvatures (studies/gradient_flow.py); 10 keep the test short,
    # and the standard error
    # of their mean difference, about a sixth of its length, allows 0.9
    curvature = next(row for row in gradient_cases.hard_rows(0, 10) if row.name == "curvature")
    assert curvature.cosine >= 0.9, curvature
    assert curvature.signed_bias > -0.5, curvature  # the scale is right within a factor of two or three


def test_descent_finds_a_minimum_under_heavy_tailed_noise():
    # quadratic bowl at (2, -1) with Cauchy noise of scale 1 on every gradient: clipping must hold, the mean
    # would not exist
    generator = torch.Generator().manual_seed(0)
    goal = torch.tensor([2.0, -1.0], dtype=torch.float64)
    descent = Descent(torch.zeros(2, dtype=torch.float64), 0.3)
    for step in range(60):
        noise = torch.empty(4, 2, dtype=torch.float64).cauchy_(generator=generator)
        descent.step([descent.variables - goal + n for n in noise])
        if step % 5 == 4:
            descent.check(float((descent.variables - goal).square().sum()))
    assert float((descent.best - goal).norm()) < 0.4
