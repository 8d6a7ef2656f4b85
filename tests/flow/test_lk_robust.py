"""The closed form on volumes that say little or nothing, on sensors with faulty pixels, on images of
any size."""

import numpy as np
import pytest
import torch

from codesign.flow import estimate_lk
from codesign.flow.export import evenly_timed
from codesign.flow.lk.hot_pixels import weighed_down
from codesign.types import EventVolume
from scenes.windows.rendered import RenderedWindows, planes
from tests.certain_case import certain

D = torch.float64
MODELS = ("constant", "affine", "quadratic", "local")
CASES = 7  # one of each kind


def little(draw, height, width):
    """Counts [1, 2, 6, height, width] with hardly anything in them, drawn from one of seven kinds."""

    def below(most):
        return int(torch.randint(most, (), generator=draw))

    counts = torch.zeros(2, 6, height, width, dtype=D)
    kind = below(7)
    if kind == 0:  # up to five events anywhere
        for _ in range(1 + below(5)):
            counts[below(2), below(6), below(height), below(width)] += 1
    elif kind == 1:  # one row
        counts[:, :, below(height)] = torch.rand(2, 6, width, generator=draw, dtype=D).round()
    elif kind == 2:  # one column, all at once
        counts[below(2), below(6), :, below(width)] = 1.0
    elif kind == 3:  # one corner
        counts[..., -1:, :1] = 3.0
    elif kind == 4:  # one bin
        counts[:, below(6)] = torch.rand(2, height, width, generator=draw, dtype=D).round()
    elif kind == 5:  # all ON, evenly
        counts[0] = 1.0
    else:  # one pixel, every bin
        counts[0, :, below(height), below(width)] = 200.0
    return counts[None]


@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize("model", MODELS)
def test_whatever_is_seen_flow_and_gradients_are_finite_and_confidence_is_a_share(model, dtype):
    for seed in range(CASES):
        draw = torch.Generator().manual_seed(seed)
        height, width = torch.randint(2, 40, (2,), generator=draw).tolist()
        scale = 10.0 ** float(torch.randint(-6, 7, (), generator=draw))
        counts = (scale * little(draw, height, width)).to(dtype).requires_grad_()
        field = certain(estimate_lk(evenly_timed(counts), model))
        assert 0 <= float(field.confidence.min().detach()) <= float(field.confidence.max().detach()) <= 1
        values = torch.stack([*field.flow_px.unbind(1), field.confidence, *field.covariance_px2.unbind(1)])
        assert bool(values.isfinite().all())
        (gradient,) = torch.autograd.grad((values * values).sum() + values.sum(), counts)
        assert bool(gradient.isfinite().all())


@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize("model", MODELS)
def test_one_event_in_a_corner_of_a_large_image_says_nothing(model, dtype):
    counts = torch.zeros(1, 2, 8, 128, 128, dtype=dtype)
    counts[0, 0, 3, 5, 5] = 1.0
    field = certain(estimate_lk(evenly_timed(counts), model))
    assert float(field.flow_px.abs().max()) <= 0.3  # a tenth of what the prior expects
    assert float(field.confidence.max()) <= 0.1


def test_hot_pixels_change_next_to_nothing_and_show_no_motion_by_themselves():
    windows = RenderedWindows(planes("fine", 0.2), seed=21).batch(range(24))
    errors = []
    for hot in (0, 5):
        counts = windows.volume.counts.clone()
        for sample in counts:
            places = torch.randint(64, (hot, 2), generator=torch.Generator().manual_seed(3))
            for y, x in places:
                sample[0, :, y, x] += 1000 / 8
        volume = EventVolume(counts, windows.volume.centroid_s, windows.volume.collected_s)
        with torch.no_grad():
            found = estimate_lk(volume)
        errors.append(float((found.flow_px - windows.truth.flow_px).norm(dim=1).mean()))
    assert errors[1] <= 1.1 * errors[0]
    alone = torch.zeros(1, 2, 8, 64, 64)
    alone[0, 0, :, 20, 20] = 1000 / 8
    assert float(certain(estimate_lk(evenly_timed(alone))).confidence.max()) <= 0.05


@pytest.mark.parametrize(("height", "width"), [(2, 2), (2, 30), (13, 3), (5, 8)])
def test_images_of_two_pixels_and_more(height, width):
    draw = torch.Generator().manual_seed(height * width)
    counts = torch.rand(2, 2, 4, height, width, generator=draw)
    field = estimate_lk(evenly_timed(counts))
    assert field.flow_px.shape == (2, 2, height, width)
    # even light that flickers moves nothing, however small the image
    even = torch.ones(1, 2, 4, height, width) * torch.tensor([1.0, 0.2, 2.0, 0.5])[:, None, None]
    assert float(estimate_lk(evenly_timed(even)).flow_px.abs().max()) <= 1e-4


def test_pixels_count_by_what_their_surroundings_explain(generator):
    counts = torch.poisson(torch.full((2, 2, 3, 6, 7), 0.8, dtype=D), generator=generator)
    counts[0, 0, :, 0, 6] = 30.0
    counts[1, 1, :, 3, 3] = 9.0
    counts += 0.1 * torch.rand(counts.shape, generator=generator, dtype=D)  # off the kinks
    signed, events, kept = weighed_down(counts)
    n = counts.sum((1, 2))
    hot = 0
    for image, y, x in np.ndindex(2, 6, 7):
        near = n[image, max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
        q = float(near.sum() - n[image, y, x]) / (near.numel() - 1)
        excess = max(0.0, float(n[image, y, x]) - 4 * q - 5) / (q + 5)
        hot += excess > 0
        assert float(kept[image, y, x]) == pytest.approx(1 / (1 + excess**2), rel=1e-12)
    assert hot == 2
    torch.testing.assert_close(events, kept * n, rtol=1e-14, atol=0)
    torch.testing.assert_close(signed, kept[:, None] * (counts[:, 0] - counts[:, 1]), rtol=1e-14, atol=0)
    assert torch.autograd.gradcheck(weighed_down, counts.requires_grad_())
