"""Images of warped events against moves worked out by hand, closed forms of affine maps, and finite
differences."""

import math

import pytest
import torch

from codesign.errors import DomainError, ShapeError
from codesign.events.stream import ordered
from codesign.flow import contrast
from codesign.types import EventVolume

D = torch.float64


def window(counts):
    """EventVolume of counts [B, 2, bins, H, W] whose bins lie at evenly spaced times from 0 to 1 of a window
    of 0.2 s."""
    bins = counts.shape[2]
    return EventVolume(
        counts, torch.linspace(0, 0.2, bins, dtype=D), torch.full((bins,), 0.2 / bins, dtype=D)
    )


def uniform(u, v, height, width):
    return torch.tensor([u, v], dtype=D)[None, :, None, None].expand(1, 2, height, width).contiguous()


def moving_dots():
    """An ON dot that goes 8 px right, an OFF dot that goes 8 px right and 2 events strong, in five bins."""
    counts = torch.zeros(1, 2, 5, 8, 16, dtype=D)
    for k in range(5):
        counts[0, 0, k, 4, 3 + 2 * k] = 1
        counts[0, 1, k, 1, 2 + 2 * k] = 2
    return window(counts)


@pytest.mark.parametrize(("at", "moved"), [(0.0, 0), (0.5, 4), (1.0, 8)])
def test_dots_become_sharp_exactly_under_their_own_flow(at, moved):
    tracks = contrast.volume_tracks(moving_dots(), uniform(8.0, 0.0, 8, 16))
    expected = torch.zeros(1, 2, 8, 16, dtype=D)
    expected[0, 0, 4, 3 + moved], expected[0, 1, 1, 2 + moved] = 5, 10
    torch.testing.assert_close(contrast.count_image(tracks, at), expected, rtol=0, atol=1e-12)
    mean_time = torch.tensor([0.5, 0.5], dtype=D)  # of 0, 1/4, 1/2, 3/4, 1
    torch.testing.assert_close(contrast.time_image(tracks, at)[expected > 0], mean_time, rtol=0, atol=1e-12)
    counts, times = contrast.nearest_images(tracks, at)
    torch.testing.assert_close(counts, expected, rtol=0, atol=1e-12)
    torch.testing.assert_close(times[expected > 0], mean_time, rtol=0, atol=1e-12)
    assert not times[expected == 0].any()


def test_shares_of_an_event_between_pixels_and_what_leaves():
    counts = torch.zeros(1, 2, 1, 3, 3, dtype=D)
    counts[0, 0, 0, 1, 1] = 4
    volume = EventVolume(counts, torch.zeros(1, dtype=D), torch.ones(1, dtype=D))  # seen at the start
    tracks = contrast.volume_tracks(volume, uniform(0.25, 0.5, 3, 3))
    image = contrast.count_image(tracks, 1.0)[0, 0]
    assert image.tolist() == [[0, 0, 0], [0, 1.5, 0.5], [0, 1.5, 0.5]]
    assert float(contrast.leaving(tracks, 1.0)) == 0
    tracks = contrast.volume_tracks(volume, uniform(1.25, 0.0, 3, 3))  # to column 2.25: a quarter leaves
    assert contrast.count_image(tracks, 1.0)[0, 0, 1].tolist() == [0, 0, 3]
    assert contrast.leaving(tracks, 1.0).tolist() == [1.0]
    assert contrast.leaving(contrast.volume_tracks(volume, uniform(-1e6, 0.0, 3, 3)), 1.0).tolist() == [4.0]


def test_a_stream_uses_exact_time_stamps_and_both_ends_of_the_interval():
    # an edge that passes one pixel per millisecond; the event before and the one after are not of the
    # interval
    t_us = torch.tensor([4999, 5000, 6000, 7000, 8000, 8001])
    stream = ordered(
        t_us, torch.tensor([0, 2, 3, 4, 5, 0]), torch.full((6,), 1), torch.tensor([1, 1, -1, 1, 1, 1]), 3, 8
    )
    tracks = contrast.stream_tracks(stream, uniform(3.0, 0.0, 3, 8), 5000, 8000)
    image = contrast.count_image(tracks, 1.0)[0]
    assert image[:, 1, 5].tolist() == pytest.approx([3, 1])
    assert float(image.sum()) == pytest.approx(4)
    assert contrast.time_image(tracks, 0.0)[0, :, 1, 2].tolist() == pytest.approx(
        [(0 + 2 / 3 + 1) / 3, 1 / 3]
    )


@pytest.mark.parametrize("zoom", [0.2, -0.2])
def test_tracks_are_carried_back_to_the_pixel_they_start_from(zoom):
    # flow zoom x0 of the start: at time tau the point is at x = x0 (1 + tau zoom), so its flow is zoom x / (1
    # + tau zoom); k steps give the geometric series to order k, whose next term is zoom x (tau zoom)^(k + 1)
    height = width = 17
    y, x = torch.meshgrid(*[torch.arange(17, dtype=D) - 8] * 2, indexing="ij")
    flow = zoom * torch.stack([x, y])[None]
    volume = window(torch.ones(1, 2, 3, height, width, dtype=D))
    inside = slice(3, 14)
    for steps in (0, 1, 2, 3):
        found = contrast.volume_tracks(volume, flow, steps).flow_px.unflatten(2, (3, height, width))[
            0, :, :, inside, inside
        ]
        for k, tau in enumerate((0.0, 0.5, 1.0)):
            exact = (flow[0] / (1 + tau * zoom))[:, inside, inside]
            left = (exact * (-tau * zoom) ** (steps + 1)).abs().max()
            assert float((found[:, k] - exact).abs().max()) == pytest.approx(float(left), abs=1e-12)


def test_the_smooth_spread_is_alike_wherever_an_event_falls():
    counts = torch.zeros(1, 2, 1, 9, 9, dtype=D)
    counts[0, 0, 0, 4, 4] = 1
    volume = EventVolume(counts, torch.zeros(1, dtype=D), torch.ones(1, dtype=D))
    place = torch.arange(9, dtype=D)
    for u, v in [(0.0, 0.0), (0.3, -0.2), (0.5, 0.5), (1.7, -1.1)]:
        image = contrast.smooth_image(contrast.volume_tracks(volume, uniform(u, v, 9, 9)), 1.0)[0, 0]
        assert float(image.sum()) == pytest.approx(1)
        for shares, centre in ((image.sum(0), 4 + u), (image.sum(1), 4 + v)):
            assert float((shares * place).sum()) == pytest.approx(centre)
            assert float((shares * (place - centre) ** 2).sum()) == pytest.approx(
                0.25
            )  # of the quadratic B-spline, at every offset


def test_still_image_is_the_smooth_image_at_zero_flow(generator):
    volume = window(torch.rand(2, 2, 3, 5, 7, generator=generator, dtype=D))
    tracks = contrast.volume_tracks(volume, torch.zeros(2, 2, 5, 7, dtype=D))
    torch.testing.assert_close(
        contrast.still_image(volume.counts), contrast.smooth_image(tracks, 0.3), rtol=0, atol=1e-12
    )


def test_area_change_of_an_affine_flow_is_its_determinant():
    matrix = torch.tensor([[0.3, -0.4], [0.2, -0.5]], dtype=D)
    y, x = torch.meshgrid(torch.arange(6, dtype=D), torch.arange(7, dtype=D), indexing="ij")
    flow = torch.einsum("ij,jhw->ihw", matrix, torch.stack([x, y]))[None]
    tracks = contrast.volume_tracks(window(torch.ones(1, 2, 3, 6, 7, dtype=D)), flow)
    for at in (0.0, 1.0):
        found = contrast.area_change(contrast.warp_jacobian(tracks, 3, at))
        for k, tau in enumerate((0.0, 0.5, 1.0)):
            exact = float(torch.linalg.det(torch.eye(2, dtype=D) + (at - tau) * matrix))
            torch.testing.assert_close(found[0, k], torch.full((6, 7), exact, dtype=D), rtol=0, atol=1e-12)


def test_weighted_by_area_a_contracted_image_is_as_sharp_as_before():
    # a Gaussian of variance 16 px^2 shrunk by 0.7: mean square slope goes as (mass / variance)^2. The spread
    # adds 1/4 px^2 before and after
    size = 49
    shrink = 0.7
    y, x = torch.meshgrid(*[torch.arange(size, dtype=D) - 24] * 2, indexing="ij")
    counts = torch.exp(-(x**2 + y**2) / 32).expand(1, 2, 1, size, size)
    volume = EventVolume(counts, torch.ones(1, dtype=D), torch.ones(1, dtype=D))  # seen at the end
    tracks = contrast.volume_tracks(volume, (1 - shrink) * torch.stack([x, y])[None])
    still = float(contrast.sharpness(contrast.still_image(counts)))
    weight = contrast.area_change(contrast.warp_jacobian(tracks, 1, 0.0)).flatten(1)
    guarded, plain = (
        float(contrast.sharpness(contrast.smooth_image(tracks, 0.0, w))) / still for w in (weight, None)
    )
    gain = (16.25 / (0.49 * 16 + 0.25)) ** 2
    # differences of neighbours lose k^2 / 12 of a wave k, 1 / (8 variance) of a Gaussian's energy: 0.8 %
    # before and 1.5 % after
    assert plain == pytest.approx(gain, rel=0.01)
    assert guarded == pytest.approx(gain * 0.49**2, rel=0.01)
    assert guarded < 1 < plain / 3


def check_gradients(function, *inputs):
    assert torch.autograd.gradcheck(
        function, [value.clone().requires_grad_() for value in inputs], eps=1e-6, atol=1e-7, rtol=1e-5
    )


@pytest.mark.parametrize("carry_steps", [0, 1])
@pytest.mark.parametrize(
    "image", [contrast.count_image, contrast.time_image, contrast.smooth_image, contrast.warp_jacobian]
)
def test_gradcheck_in_counts_and_flow(image, carry_steps, generator):
    shell = window(torch.zeros(1, 2, 3, 4, 5, dtype=D))

    def call(counts, flow):
        tracks = contrast.volume_tracks(
            EventVolume(counts, shell.centroid_s, shell.collected_s), flow, carry_steps
        )
        return (
            contrast.area_change(image(tracks, 3, 0.8))
            if image is contrast.warp_jacobian
            else image(tracks, 0.8)
        )

    counts = 0.5 + torch.rand(1, 2, 3, 4, 5, generator=generator, dtype=D)
    check_gradients(call, counts, 1.5 * torch.randn(1, 2, 4, 5, generator=generator, dtype=D))


def test_the_smooth_image_has_no_jump_in_its_gradient():
    # an event that crosses the border between two pixels, and the centre line of one: bilinear shares jump
    # there, the B-spline does not
    counts = torch.zeros(1, 2, 1, 1, 9, dtype=D)
    counts[0, 0, 0, 0, 4] = 1
    volume = EventVolume(counts, torch.zeros(1, dtype=D), torch.ones(1, dtype=D))
    weights = torch.arange(9, dtype=D).square()

    def slope(image, u):
        flow = uniform(u, 0.0, 1, 9).requires_grad_()
        (grad,) = torch.autograd.grad(
            (image(contrast.volume_tracks(volume, flow), 1.0)[0, 0, 0] * weights).sum(), flow
        )
        return float(grad[0, 0, 0, 4])

    for place in (0.5, 1.0):
        assert (
            abs(slope(contrast.smooth_image, place + 1e-9) - slope(contrast.smooth_image, place - 1e-9))
            <= 1e-7
        )  # curvature 2 times 2e-9
    assert abs(
        slope(contrast.count_image, 1 + 1e-9) - slope(contrast.count_image, 1 - 1e-9)
    ) == pytest.approx(2)


def test_half_precision_flow_keeps_its_place():
    counts = torch.zeros(1, 2, 1, 1, 600)
    counts[0, 0, 0, 0, 501] = 1
    volume = EventVolume(counts, torch.zeros(1), torch.ones(1))
    tracks = contrast.volume_tracks(volume, torch.full((1, 2, 1, 600), 0.25, dtype=torch.bfloat16))
    assert tracks.positions(1.0)[0][0, 501].item() == 501.25  # bfloat16 has steps of 2 px there


DOTS = moving_dots()
STREAM = ordered(*[torch.tensor([one]) for one in (10, 1, 1, 1)], 8, 16)
FLAT = window(torch.zeros(1, 2, 2, 1, 4))
NAN = torch.zeros(1, 2, 8, 16, dtype=D).index_fill(3, torch.tensor([2]), math.nan)


@pytest.mark.parametrize(
    ("call", "error", "sentence"),
    [
        (
            lambda: contrast.volume_tracks(DOTS, torch.zeros(1, 2, 8, 8)),
            ShapeError,
            r"must be \[1, 2, 8, 16\]",
        ),
        (
            lambda: contrast.volume_tracks(window(DOTS.counts[0, :, :, None]), NAN),
            ShapeError,
            r"bins, H, W\]",
        ),
        (lambda: contrast.volume_tracks(DOTS, NAN), DomainError, "flow of these events: 16 of 256"),
        (
            lambda: contrast.warp_jacobian(contrast.volume_tracks(FLAT, torch.zeros(1, 2, 1, 4)), 2, 0.0),
            ShapeError,
            "1 x 4 pixels has no slope",
        ),
        (lambda: contrast.stream_tracks(STREAM, NAN[0] * 0, 20, 30), DomainError, "flow of these events"),
        (lambda: contrast.stream_tracks(STREAM, torch.zeros(2, 8, 16), 20, 30), DomainError, "no event lies"),
        (lambda: contrast.stream_tracks(STREAM, torch.zeros(2, 8, 16), 30, 20), DomainError, "t1 > t0"),
        (lambda: contrast.stream_tracks(STREAM, torch.zeros(2, 8, 16), 0, 10.5), DomainError, "whole micro"),
    ],
)
def test_what_cannot_be_warped_is_refused(call, error, sentence):
    with pytest.raises(error, match=sentence):
        call()
