"""Gradients along the whole chain, certified with the cases that
``studies.gradient_flow --cases chain`` reports."""

from studies.gradient_flow import chain


def test_ray_gradients_agree_with_differences():
    for row in chain.rays_rows():
        assert row.relative_error <= 1e-6, row
        # otherwise the differences could not have judged
        assert row.noise_floor <= 1e-6, row


def test_straight_through_gradient_of_the_lens_points_where_the_hard_loss_falls():
    # 32 cases give a cosine of 0.997 to three curvatures; 10 keep the test short, and the standard
    # error of their mean difference, about a sixth of its length, allows 0.9
    curvature, _ = chain.hard_rows(0, 10, moved=["curvature"])
    assert curvature.cosine >= 0.9, curvature
    # the scale is right within a factor of two or three
    assert curvature.signed_bias > -0.5, curvature
