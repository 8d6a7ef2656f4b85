"""Images of warped events against moves worked out by hand, closed forms of affine maps, and finite
differences."""
# pyright: reportArgumentType=false, reportCallIssue=false

import pytest
import torch

from codesign.flow import contrast
from codesign.flow.warp import pixel_grid
from codesign.types import EventVolume
from tests.event_streams import stream_of
from tests.flow.test_losses import check_gradients
from tests.numbers import D, close, f64, rand64, randn64


def window(counts):
    """EventVolume of counts [B, 2, bins, H, W] whose bins lie at evenly spaced times from 0 to 1 of
    a window of 0.2 s; one bin at its start."""
    bins = counts.shape[2]
    times = torch.linspace(0, 0.2, bins, dtype=D), torch.full((bins,), 0.2 / bins, dtype=D)
    return EventVolume(counts, *times)


def lone(height, width, row, column, count=1.0):
    """Events of one pixel at the start of a window."""
    counts = torch.zeros(1, 2, 1, height, width, dtype=D)
    counts[0, 0, 0, row, column] = count
    return window(counts)


def centred(size):
    """x and y [2, size, size] from the middle."""
    return pixel_grid(size, size, torch.zeros((), dtype=D)) - (size - 1) / 2


def uniform(u, v, height, width):
    return f64([u, v])[None, :, None, None].repeat(1, 1, height, width)


def moving_dots():
    """An ON dot that goes 8 px right, an OFF dot that goes 8 px right and 2 events strong, in five
    bins."""
    counts = torch.zeros(1, 2, 5, 8, 16, dtype=D)
    k = torch.arange(5)
    counts[0, 0, k, 4, 3 + 2 * k] = 1
    counts[0, 1, k, 1, 2 + 2 * k] = 2
    return window(counts)


@pytest.mark.parametrize(("at", "moved"), [(0.0, 0), (0.5, 4), (1.0, 8)])
def test_dots_become_sharp_exactly_under_their_own_flow(at, moved):
    tracks = contrast.volume_tracks(moving_dots(), uniform(8.0, 0.0, 8, 16))
    expected = torch.zeros(1, 2, 8, 16, dtype=D)
    expected[0, 0, 4, 3 + moved], expected[0, 1, 1, 2 + moved] = 5, 10
    close(contrast.count_image(tracks, at), expected, atol=1e-12)
    mean_time = f64([0.5, 0.5])  # of 0, 1/4, 1/2, 3/4, 1
    counts, times = contrast.nearest_images(tracks, at)
    close(counts, expected, atol=1e-12)
    close(times[expected > 0], mean_time, atol=1e-12)
    assert not times[expected == 0].any()


def test_shares_of_an_event_between_pixels_and_what_leaves():
    volume = lone(3, 3, 1, 1, 4)
    for flow, image, left in (
        ((0.25, 0.5), [[0, 0, 0], [0, 1.5, 0.5], [0, 1.5, 0.5]], 0.0),
        ((1.25, 0.0), [[0, 0, 0], [0, 0, 3], [0, 0, 0]], 1.0),  # to column 2.25: a quarter leaves
        ((-1e6, 0.0), [[0] * 3] * 3, 4.0),
    ):
        tracks = contrast.volume_tracks(volume, uniform(*flow, 3, 3))
        assert contrast.count_image(tracks, 1.0)[0, 0].tolist() == image
        assert 4 - contrast.count_image(tracks, 1.0).sum() == left


def test_a_stream_uses_exact_time_stamps_and_both_ends_of_the_interval():
    # an edge that passes one pixel per millisecond; the event before and the one after are not of
    # the interval
    edge = (5000, 2, 1, 1), (6000, 3, 1, -1), (7000, 4, 1, 1), (8000, 5, 1, 1)
    stream = stream_of((4999, 0, 1, 1), *edge, (8001, 0, 1, 1), height_px=3, width_px=8)
    tracks = contrast.stream_tracks(stream, uniform(3.0, 0.0, 3, 8), 5000, 8000)
    image = contrast.count_image(tracks, 1.0)[0]
    assert image[:, 1, 5].tolist() == pytest.approx([3, 1])
    assert float(image.sum()) == pytest.approx(4)
    mean_times = contrast.nearest_images(tracks, 0.0)[1][0, :, 1, 2].tolist()
    assert mean_times == pytest.approx([(0 + 2 / 3 + 1) / 3, 1 / 3])


@pytest.mark.parametrize("zoom", [0.2, -0.2])
def test_tracks_are_carried_back_to_the_pixel_they_start_from(zoom):
    # flow zoom x0 of the start: at time tau the point is at x = x0 (1 + tau zoom), so its flow is
    # zoom x / (1 + tau zoom); k steps give the geometric series to order k, whose next term is zoom
    # x (tau zoom)^(k + 1)
    flow = zoom * centred(17)[None]
    volume = window(torch.ones(1, 2, 3, 17, 17, dtype=D))
    inside = (..., slice(3, 14), slice(3, 14))
    tau = f64([0.0, 0.5, 1.0])[:, None, None]
    exact = (flow[0, :, None] / (1 + tau * zoom))[inside]
    for steps in (0, 1, 3):
        tracks = contrast.volume_tracks(volume, flow, steps)
        found = tracks.flow_px.unflatten(2, (3, 17, 17))[0][inside]
        left = (exact * (-tau * zoom) ** (steps + 1)).abs().amax((0, 2, 3))
        close((found - exact).abs().amax((0, 2, 3)), left, atol=1e-12)


def test_the_smooth_spread_is_alike_wherever_an_event_falls():
    place = torch.arange(9, dtype=D)
    for u, v in [(0.0, 0.0), (0.3, -0.2), (0.5, 0.5), (1.7, -1.1)]:
        tracks = contrast.volume_tracks(lone(9, 9, 4, 4), uniform(u, v, 9, 9))
        image = contrast.smooth_image(tracks, 1.0)[0, 0]
        assert float(image.sum()) == pytest.approx(1)
        for shares, centre in ((image.sum(0), 4 + u), (image.sum(1), 4 + v)):
            assert float((shares * place).sum()) == pytest.approx(centre)
            # of the quadratic B-spline, at every offset
            assert float((shares * (place - centre) ** 2).sum()) == pytest.approx(0.25)


def test_area_change_of_an_affine_flow_is_its_determinant():
    matrix = f64([[0.3, -0.4], [0.2, -0.5]])
    flow = torch.einsum("ij,jhw->ihw", matrix, centred(6))[None]
    tracks = contrast.volume_tracks(window(torch.ones(1, 2, 3, 6, 6, dtype=D)), flow)
    away = f64([0.8, 0.3, -0.2])[:, None, None]  # from the bins to 0.8
    exact = torch.linalg.det(torch.eye(2, dtype=D) + away * matrix)[:, None, None].expand(3, 6, 6)
    found = contrast.area_change(contrast.warp_jacobian(tracks, 3, 0.8))[0]
    close(found, exact, atol=1e-12)


@pytest.mark.parametrize("carry_steps", [0, 1])
@pytest.mark.parametrize(
    "image",
    [
        contrast.count_image,
        contrast.smooth_image,
        lambda tracks, at: contrast.area_change(contrast.warp_jacobian(tracks, 3, at)),
    ],
)
def test_gradcheck_in_counts_and_flow(image, carry_steps, generator):
    def call(counts, flow):
        return image(contrast.volume_tracks(window(counts), flow, carry_steps), 0.8)

    counts = 0.5 + rand64(generator, 1, 2, 3, 4, 4)
    flow = 1.5 * randn64(generator, 1, 2, 4, 4)
    check_gradients(call, counts, flow)


def test_the_smooth_image_has_no_jump_in_its_gradient():
    # an event that crosses the border between two pixels, and the centre line of one: bilinear
    # shares jump there, the B-spline does not
    weights = torch.arange(9, dtype=D).square()

    def jump(image, place):
        slopes = []
        for u in (place - 1e-9, place + 1e-9):
            flow = uniform(u, 0.0, 1, 9).requires_grad_()
            found = image(contrast.volume_tracks(lone(1, 9, 0, 4), flow), 1.0)[0, 0, 0]
            slopes.append(float(torch.autograd.grad((found * weights).sum(), flow)[0][0, 0, 0, 4]))
        return abs(slopes[1] - slopes[0])

    for place in (0.5, 1.0):
        assert jump(contrast.smooth_image, place) <= 1e-7  # curvature 2 times 2e-9
    assert jump(contrast.count_image, 1.0) == pytest.approx(2)
