"""Flow errors against values worked out by hand."""

import math

import pytest
import torch

from codesign.errors import DomainError, ShapeError
from codesign.flow import metrics

D = torch.float64


def field(pairs):
    """[2, 1, N] from a list of (u, v)."""
    return torch.tensor(pairs, dtype=D).T[:, None]


FOUND = field([(3.0, 4.0), (0.0, 0.0), (103.5, 0.0), (10.0, 4.5), (1.0, 1.0)])
TRUTH = field([(0.0, 0.0), (0.0, 0.0), (100.0, 0.0), (10.0, 0.0), (1.0, 1.0)])
ERRORS = [5.0, 0.0, 3.5, 4.5, 0.0]


def test_endpoint_errors_and_their_mean():
    assert metrics.endpoint_error(FOUND, TRUTH).tolist() == [ERRORS]
    assert metrics.aee(FOUND, TRUTH).item() == pytest.approx(13.0 / 5)
    mask = torch.tensor([[True, False, False, True, False]])
    assert metrics.aee(FOUND, TRUTH, mask).item() == pytest.approx(9.5 / 2)


def test_a_batch_is_averaged_over_pixels_not_over_samples():
    found, truth = torch.stack([FOUND, TRUTH]), torch.stack([TRUTH, TRUTH])
    mask = torch.tensor([[[True, False, False, False, False]], [[True, True, True, False, False]]])
    assert metrics.aee(found, truth, mask).item() == pytest.approx(5.0 / 4)


def test_an_outlier_needs_both_three_pixels_and_five_per_cent():
    # 5 px of 0: yes. 3.5 px of 100 (3.5 %): no. 4.5 px of 10: yes. 2.9 px of 1: no (below 3 px)
    found, truth = torch.cat([FOUND, field([(3.9, 0.0)])], 2), torch.cat([TRUTH, field([(1.0, 0.0)])], 2)
    assert metrics.outlier_percent(found, truth).item() == pytest.approx(100 * 2 / 6)
    assert metrics.outlier_percent(field([(3.0, 0.0)]), field([(0.0, 0.0)])).item() == 0  # exactly 3 px is not above


def test_share_of_errors_above_a_number_of_pixels():
    assert metrics.npe(FOUND, TRUTH, 1.0).item() == pytest.approx(60.0)
    assert metrics.npe(FOUND, TRUTH, 4.0).item() == pytest.approx(40.0)
    assert metrics.npe(FOUND, TRUTH, 5.0).item() == pytest.approx(0.0)


def test_angular_error_in_closed_form():
    # (0, 0, 1) to (1, 0, 1) is 45 degrees; (1, 0, 1) to (-1, 0, 1) is 90; (1, 0, 1) to (0, 1, 1) is 60
    pairs = [((0.0, 0.0), (1.0, 0.0), 45.0), ((1.0, 0.0), (-1.0, 0.0), 90.0), ((1.0, 0.0), (0.0, 1.0), 60.0), ((2.0, 3.0), (2.0, 3.0), 0.0)]
    for a, b, degrees in pairs:
        assert metrics.angular_error_deg(field([a]), field([b])).item() == pytest.approx(degrees, abs=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, D])
def test_small_angles_keep_their_digits(dtype):
    # acos of a rounded cosine would lose all of them: 1e-6 rad changes a cosine by 5e-13
    found = metrics.angular_error_deg(field([(1e-6, 0.0)]).to(dtype), field([(0.0, 0.0)]).to(dtype)).item()
    assert found == pytest.approx(math.degrees(1e-6), rel=1e-6)


def test_gradients_at_zero_error_are_zero_not_nan():
    flow = TRUTH.clone().requires_grad_()
    for value in (metrics.aee(flow, TRUTH), metrics.angular_error_deg(flow, TRUTH)):
        (grad,) = torch.autograd.grad(value, flow)
        assert not grad.any()
    flow = FOUND.clone().requires_grad_()
    (grad,) = torch.autograd.grad(metrics.aee(flow, TRUTH), flow)
    assert grad[:, 0, 0].tolist() == pytest.approx([0.6 / 5, 0.8 / 5])  # the unit vector of the error over five pixels


def test_empty_masks_and_wrong_shapes_are_refused():
    nothing = torch.zeros(1, 5, dtype=torch.bool)
    for measure in (metrics.aee, metrics.outlier_percent, metrics.angular_error_deg, lambda f, t, m: metrics.npe(f, t, 3.0, m)):
        with pytest.raises(DomainError, match="selects no pixel"):
            measure(FOUND, TRUTH, nothing)
    with pytest.raises(ShapeError, match=r"\[\.\.\., 2, H, W\]"):
        metrics.aee(FOUND, TRUTH[:, :, :3])
    with pytest.raises(ShapeError, match=r"\[\.\.\., 2, H, W\]"):
        metrics.aee(torch.zeros(3, 4, 4), torch.zeros(3, 4, 4))
    with pytest.raises(ShapeError, match=r"mask.*\(4, 4\)"):
        metrics.aee(FOUND, TRUTH, torch.ones(4, 4, dtype=torch.bool))
    with pytest.raises(ShapeError, match=r"\[\.\.\., 2, H, W\]"):
        metrics.angular_error_deg(torch.zeros(3, 4, 4), torch.zeros(3, 4, 4))
