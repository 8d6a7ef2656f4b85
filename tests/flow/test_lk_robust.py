"""The closed form on volumes that say little or nothing, on sensors with faulty pixels, on small
images."""

import numpy as np
import pytest
import torch

from codesign.flow import estimate_lk
from codesign.flow.export import evenly_timed
from codesign.flow.lk.level import weighed_down
from tests.certain_case import certain
from tests.numbers import D, close, rand64, seeded


def little(height, width):
    """Counts [1, 2, 6, height, width] with hardly anything in them: name, counts."""
    draw = rand64(seeded(height), 2, 6, height, width)
    empty = torch.zeros_like(draw)
    last = torch.arange(width) == width - 1
    top = torch.arange(height)[:, None] == 0
    bin_2 = (torch.arange(6) == 2)[:, None, None]
    yield "few", (draw < 3 / draw.numel()).to(D)
    yield "row", draw.round() * top
    yield "column at once", torch.ones_like(draw) * last * bin_2
    yield "corner", 3.0 * (top & last) + empty
    yield "bin", draw.round() * bin_2
    yield "one pixel", 200.0 * (top & last) + empty
    yield "all ON", torch.stack([empty[0] + 1, empty[1]])
    yield "all alike", empty + 0.5
    yield "empty", empty


@pytest.mark.parametrize(
    ("model", "dtype", "size"),
    [
        ("constant", D, (37, 20)),
        ("affine", torch.float32, (24, 3)),
        ("quadratic", D, (2, 31)),
        ("local", torch.float32, (21, 30)),
        ("local", D, (3, 9)),
    ],
)
def test_what_says_little_has_finite_gradients_and_what_says_nothing_no_flow(model, dtype, size):
    for k, (name, counts) in enumerate(little(*size)):
        scale = 10.0 ** (5 * k % 13 - 6)
        counts = (scale * counts[None]).to(dtype).requires_grad_()
        field = certain(estimate_lk(evenly_timed(counts), model))
        values = torch.stack(
            [*field.flow_px.unbind(1), field.confidence, *field.covariance_px2.unbind(1)]
        )
        assert values.isfinite().all()
        (gradient,) = torch.autograd.grad((values * values).sum() + values.sum(), counts)
        assert gradient.isfinite().all()
        assert 0 <= field.confidence.min().detach() <= field.confidence.max().detach() <= 1
        if name in ("all ON", "all alike"):
            assert field.flow_px.detach().abs().max() <= 0.01
        if name == "empty":
            assert not field.flow_px.any()
            assert not gradient.any()


@pytest.mark.parametrize("model", ["constant", "affine", "quadratic", "local"])
@pytest.mark.parametrize(("bins", "count", "most"), [(3, 1.0, 0.1), (slice(8), 125.0, 0.05)])
def test_one_pixel_of_a_large_image_says_nothing(model, bins, count, most):
    counts = torch.zeros(1, 2, 8, 128, 128)
    counts[0, 0, bins, 5, 5] = count
    field = certain(estimate_lk(evenly_timed(counts), model))
    assert field.flow_px.abs().max() <= 0.3  # a tenth of what the prior expects
    assert field.confidence.max() <= most


@pytest.mark.parametrize(("height", "width"), [(2, 2), (2, 30), (13, 3)])
def test_even_light_that_flickers_moves_nothing_however_small_the_image(height, width):
    even = torch.ones(1, 2, 4, height, width) * torch.tensor([1.0, 0.2, 2.0, 0.5])[:, None, None]
    assert estimate_lk(evenly_timed(even)).flow_px.abs().max() <= 1e-4


def test_pixels_count_by_what_their_surroundings_explain(generator):
    counts = torch.poisson(torch.full((2, 2, 3, 6, 7), 0.8, dtype=D), generator=generator)
    counts[0, 0, :, 0, 6] = 30.0
    counts[1, 1, :, 3, 3] = 9.0
    counts += 0.1 * rand64(generator, counts.shape)  # off the kinks
    signed, events, kept = weighed_down(counts)
    n = counts.sum((1, 2))
    for image, y, x in np.ndindex(2, 6, 7):
        near = n[image, max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
        q = float(near.sum() - n[image, y, x]) / (near.numel() - 1)
        excess = max(0.0, float(n[image, y, x]) - 4 * q - 5) / (q + 5)
        assert float(kept[image, y, x]) == pytest.approx(1 / (1 + excess**2), rel=1e-12)
    assert (kept < 1).sum() == 2
    close(events, kept * n, rtol=1e-14)
    close(signed, kept[:, None] * (counts[:, 0] - counts[:, 1]), rtol=1e-14)
    assert torch.autograd.gradcheck(weighed_down, counts.requires_grad_())
