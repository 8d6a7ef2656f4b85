"""Gradients along the whole chain, certified with the cases that studies/gradient_flow.py reports."""

import pytest

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
    # and the standard error of their mean difference, about a sixth of its length, allows 0.9
    curvature = next(row for row in gradient_cases.hard_rows(0, 10) if row.name == "curvature")
    assert curvature.cosine >= 0.9, curvature
    assert curvature.signed_bias > -0.5, curvature  # the scale is right within a factor of two or three
