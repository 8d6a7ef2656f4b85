"""Flow errors against values worked out by hand."""
# pyright: reportCallIssue=false

import math

import pytest
import torch

from codesign.errors import DomainError
from codesign.events.stream import ordered
from codesign.flow import metrics
from codesign.flow.export import evenly_timed
from codesign.types import FlowField
from tests.numbers import f64


def field(pairs):
    """[2, 1, N] from a list of (u, v)."""
    return f64(pairs).T[:, None]


FOUND = field([(3.0, 4.0), (0.0, 0.0), (103.5, 0.0), (10.0, 4.5), (1.0, 1.0)])
TRUTH = field([(0.0, 0.0), (0.0, 0.0), (100.0, 0.0), (10.0, 0.0), (1.0, 1.0)])
ERRORS = [5.0, 0.0, 3.5, 4.5, 0.0]
LONG = torch.tensor([[True, False, False, True, False]])


@pytest.mark.parametrize(
    ("found", "right"),
    [
        (metrics.endpoint_error(FOUND, TRUTH).sum(), sum(ERRORS)),
        (metrics.aee(FOUND, TRUTH), 13 / 5),
        (metrics.aee(FOUND, TRUTH, LONG), 9.5 / 2),
        # over the pixels of all samples, not over samples
        (
            metrics.aee(
                torch.stack([FOUND, TRUTH]), TRUTH.expand(2, 2, 1, 5), torch.stack([LONG, ~LONG])
            ),
            9.5 / 5,
        ),
        (metrics.zero_flow_error(TRUTH, LONG), 5),
        # 5 px of 0 and 4.5 px of 10 are outliers, 3.5 px of 100 (3.5 %) are none
        (metrics.outlier_percent(FOUND, TRUTH), 40),
        (metrics.outlier_percent(FOUND, TRUTH, share=0.0), 60),
        (metrics.outlier_percent(FOUND, TRUTH, pixels=0.0, share=0.04), 40),
        (metrics.npe(FOUND, TRUTH, 4.0), 40),
        (metrics.npe(FOUND, TRUTH, 5.0), 0),
        # between (u, v, 1) of the one and of the other
        (metrics.angular_error_deg(field([(0.0, 0.0)]), field([(1.0, 0.0)])), 45),
        (metrics.angular_error_deg(field([(1.0, 0.0)]), field([(-1.0, 0.0)])), 90),
        (metrics.angular_error_deg(field([(1.0, 0.0)]), field([(0.0, 1.0)])), 60),
    ],
)
def test_errors_worked_out_by_hand(found, right):
    assert float(found) == pytest.approx(right, abs=1e-12)


def test_small_angles_keep_their_digits():
    # acos of a rounded cosine would lose all of them: 1e-6 rad changes a cosine by 5e-13
    found = metrics.angular_error_deg(
        field([(1e-6, 0.0)]).float(), field([(0.0, 0.0)]).float()
    ).item()
    assert found == pytest.approx(math.degrees(1e-6), rel=1e-6)


def test_gradients_at_zero_error_are_zero_not_nan():
    flow = TRUTH.clone().requires_grad_()
    for value in (metrics.aee(flow, TRUTH), metrics.angular_error_deg(flow, TRUTH)):
        assert not torch.autograd.grad(value, flow)[0].any()
    flow = FOUND.clone().requires_grad_()
    (grad,) = torch.autograd.grad(metrics.aee(flow, TRUTH), flow)
    # the unit vector of the error over five pixels
    assert grad[:, 0, 0].tolist() == pytest.approx([0.6 / 5, 0.8 / 5])


def test_masks_of_events_and_truth():
    counts = torch.zeros(2, 2, 3, 1, 4)
    counts[0, 0, 1, 0, 0] = 0.25  # a part of an event
    counts[0, 1, 2, 0, 2] = 3
    counts[1, 1, 0, 0, 3] = 1
    valid = torch.tensor([1, 1, 0, 1]).expand(2, 1, 4) == 1
    found = metrics.masks(evenly_timed(counts), FlowField(counts[:, :, 0], valid, 3.0))
    assert found["events"].int().tolist() == [[[1, 0, 1, 0]], [[0, 0, 0, 1]]]
    assert found["both"].int().tolist() == [[[1, 0, 0, 0]], [[0, 0, 0, 1]]]


@pytest.mark.parametrize(
    "measure",
    [
        metrics.aee,
        metrics.outlier_percent,
        metrics.angular_error_deg,
        lambda f, t, m=None: metrics.npe(f, t, 3.0, m),
    ],
)
def test_nan_is_no_inlier(measure):
    flow = FOUND.clone()
    flow[0, 0, 1] = math.nan
    with pytest.raises(DomainError, match="NaN or infinite at 1 of 5 pixels"):
        measure(flow, TRUTH)
    mask = torch.tensor([[True, False, True, True, True]])
    assert measure(flow, TRUTH, mask).item() == measure(FOUND, TRUTH, mask).item()


# events alone


def line(steps, width, height=3):
    """A vertical line that starts at column 2 and moves a pixel to the right per 1000 us; one event
    per pixel it comes to."""
    k = torch.arange(steps).repeat_interleave(height)
    y = torch.arange(height).repeat(steps)
    return ordered(1000 * k, 2 + k, y, torch.ones_like(k), height, width), 1000 * (steps - 1)


def constant(u, width, height=3):
    return f64([u, 0.0])[:, None, None].expand(2, height, width)


@pytest.mark.parametrize(("steps", "width"), [(5, 12), (9, 16)])
def test_a_moving_line_in_closed_form(steps, width):
    # unwarped: n of w columns hold 1; warped: one of them n. Variances n/w - (n/w)^2 and n^2/w -
    # (n/w)^2
    stream, end_us = line(steps, width)
    flow = constant(steps - 1.0, width)
    sharper = steps * (width - 1) / (width - steps)
    for at in (0.0, 0.4, 1.0):
        assert metrics.fwl(stream, flow, 0, end_us, at) == pytest.approx(sharper)
    assert metrics.fwl(stream, flow[None].float(), 0, end_us) == pytest.approx(sharper, rel=1e-6)
    # mean squares of the times: of k / (n - 1) before, (2n - 1) / (6 (n - 1)); of their mean after,
    # 1/4
    assert metrics.rsat(stream, flow, 0, end_us) == pytest.approx(
        1.5 * (steps - 1) / (2 * steps - 1)
    )
    for measure in (metrics.fwl, metrics.rsat):
        assert measure(stream, 0 * flow, 0, end_us) == 1


def test_events_that_leave_count_in_the_denominator_only():
    # from column 2 + k at time k/4 to column 2 + k + (1 - k/4) u; for u = 8 that is 10 - k:
    # mirrored, and as sharp as before
    stream, end_us = line(5, 12)
    assert metrics.fwl(stream, constant(8.0, 12), 0, end_us) == pytest.approx(1)
    # u = 40: to 42 - 9 k = 42, 33, 24, 15, 6: one stays. Variances 1/12 - 1/144 and 5/12 - 25/144
    assert metrics.fwl(stream, constant(40.0, 12), 0, end_us) == pytest.approx(11 / 35)
    # the last, at time 1; before, 9 / 24
    assert metrics.rsat(stream, constant(40.0, 12), 0, end_us) == pytest.approx(1 / (9 / 24))
    with pytest.raises(DomainError, match="every event out of the image"):
        # at 4/5 of the window it leaves too
        metrics.rsat(stream, constant(40.0, 12), 0, end_us + 1000)


def test_polarities_share_an_image_in_fwl_but_not_in_rsat():
    # ON at column 1, time 0, OFF at column 2, time 1, flow 1: both end on column 2
    columns = ([0, 10], [1, 2], [0, 0], [1, -1])
    stream = ordered(*(torch.tensor(column) for column in columns), 1, 4)
    flow = constant(1.0, 4, 1)
    assert metrics.fwl(stream, flow, 0, 10) == pytest.approx((4 / 4 - 1 / 4) / (2 / 4 - 1 / 4))
    # (0 + 1) / 1 pixel against (0 + 1) / 2 pixels
    assert metrics.rsat(stream, flow, 0, 10) == pytest.approx(2)


@pytest.mark.parametrize("measure", [metrics.aee, metrics.angular_error_deg])
def test_truth_that_is_nan_where_it_is_masked_leaves_gradients_alone(measure):
    truth = torch.ones(2, 3, 3)
    known = torch.full((3, 3), True)
    known[1, 1] = False
    slopes = []
    for unknown in (1.0, float("nan")):
        flow_px = torch.zeros(2, 3, 3, requires_grad=True)
        measure(flow_px, torch.where(known, truth, unknown), known).backward()
        slopes.append(flow_px.grad)
    assert torch.equal(*slopes)
    assert slopes[1][:, 1, 1].abs().max() == 0 < slopes[1].abs().max()


def test_long_flows_in_half_precision_have_lengths():
    long = torch.full((2, 2, 2), 200.0, dtype=torch.float16)
    assert metrics.outlier_percent(0 * long, long) == 100.0
