"""Gradients along the whole chain, certified with the cases that
``studies.gradient_flow --cases chain`` reports."""

import pytest

from studies.gradient_flow import chain

JUNCTIONS = [label for label in chain.JUNCTIONS if not label.startswith("final loss")]


@pytest.mark.parametrize("label", JUNCTIONS)
def test_junction_gradients_agree_with_differences(label):
    asked, rows = chain.JUNCTIONS[label]
    for row in rows(0):
        assert row.relative_error <= asked.most["relative_error"], row
        # otherwise the differences could not have judged
        assert row.noise_floor <= asked.most["relative_error"], row


def test_straight_through_gradient_of_the_lens_points_where_the_hard_loss_falls():
    # 32 cases give a cosine of 0.997 to three curvatures; 10 keep the test short, and the standard
    # error of their mean difference, about a sixth of its length, allows 0.9
    curvature, _ = chain.hard_rows(0, 10, moved=["curvature"])
    assert curvature.cosine >= 0.9, curvature
    # the scale is right within a factor of two or three
    assert curvature.signed_bias > -0.5, curvature
