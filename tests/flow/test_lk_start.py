"""Warm starts of the closed form: motions that are found from near by only, and starts that are
wrong."""

from dataclasses import replace

import pytest
import torch

from codesign.flow import estimate_lk
from codesign.flow.lk import polynomials
from tests.flow.test_lk import D, length, mean_error, moving, pixels
from tests.numbers import close, f64, randn64, seeded

FINE_PX = (4.0, 8.0)  # a blur of 4 px leaves a thousandth of these textures


@pytest.mark.parametrize("size", [(16, 24), (2, 3)])
def test_a_polynomial_is_read_off_its_own_flow(size, generator):
    """Within the fixed point (a factor of 0.1 in each of 5 steps) and the ridge (1e-6 of the mean
    diagonal, where the least term counts some hundredth of the mean)."""
    shape = polynomials.Polynomials("affine", *size)
    matrix = 0.05 * randn64(generator, 2, 2, 2)
    shift = randn64(generator, 2, 2)
    start = f64([-0.5, -0.3])
    x, y = pixels(*size)
    at = torch.stack([x - x.mean(), y - y.mean()])
    # w = M (a - s w) + t
    right = torch.einsum("bij,jyx->biyx", matrix, at) + shift[:, :, None, None]
    inverse = torch.linalg.inv(torch.eye(2, dtype=D) + start[:, None, None] * matrix)
    found = shape.fitted(torch.einsum("bij,bjyx->biyx", inverse, right), start) @ shape.unit.T
    parameters = torch.cat([shift[:, :, None], matrix * shape.half], 2).flatten(1)
    close(found, parameters, atol=1e-3)


@pytest.mark.parametrize("model", ["affine", "local"])
def test_a_start_near_by_finds_what_the_coarse_blur_wipes_out(model):
    volume, truth = moving(1, shift=(18.0, 5.0), bins=8, waves_px=FINE_PX)
    near = 0.85 * torch.tensor([[18.0, 5.0]])
    assert mean_error(estimate_lk(volume, model), truth) >= 0.5 * length(truth)
    found = estimate_lk(volume, model, start_px=near)
    assert mean_error(found, truth) <= 0.01 * length(truth)
    whole = near[:, :, None, None].expand(-1, -1, *truth.shape[1:])
    again = estimate_lk(volume, model, start_px=whole)
    close(again.flow_px, found.flow_px, atol=1e-9)


@pytest.mark.parametrize("waves_px", [FINE_PX, (6.0, 24.0)])
@pytest.mark.parametrize("levels_px", [(4.0, 2.0, 1.0), (2.0, 1.0)])
def test_a_wrong_start_leaves_what_is_found_without(waves_px, levels_px):
    # the share of the wrong one is below 1e-3 where contrasts differ by 7 in the logarithm of the
    # odds
    volume, truth = moving(1, shift=(3.0, -2.0), waves_px=waves_px)
    cold = mean_error(estimate_lk(volume, levels_px=levels_px), truth)
    for wrong in ((-6.0, 4.0), (9.0, 9.0), (0.0, -12.0)):
        found = estimate_lk(volume, levels_px=levels_px, start_px=torch.tensor([wrong]))
        assert mean_error(found, truth) <= cold + 0.01 * length(truth)


@pytest.mark.parametrize("count", [0, 1, 200])
def test_events_that_say_nothing_keep_no_start(count):
    # few steps of at most 4 px do not lead back from 40 px: the prior drops it (without it 27 px
    # stay)
    shell, _ = moving(0, steps=10)
    for seed in range(2):
        draw = seeded(seed)
        counts = torch.zeros_like(shell.counts)
        counts.view(-1)[torch.randint(counts.numel(), (count,), generator=draw)] += 1
        volume = replace(shell, counts=counts)
        warm = estimate_lk(volume, start_px=torch.tensor([[40.0, -20.0]])).flow_px
        close(warm, estimate_lk(volume).flow_px, atol=1e-6)


def test_starts_of_a_batch_are_each_their_own_and_have_no_gradient():
    (a, _), (b, _) = moving(0, shift=(2.0, 1.0)), moving(1, shift=(-1.0, 0.5))
    both = replace(a, counts=torch.cat([a.counts, b.counts]))
    starts = torch.tensor([[4.0, 0.0], [-2.0, -1.0]], requires_grad=True)
    found = estimate_lk(both, start_px=starts).flow_px
    assert not found.requires_grad
    for k, volume in enumerate((a, b)):
        alone = estimate_lk(volume, start_px=starts[k : k + 1]).flow_px[0]
        close(found[k], alone, atol=1e-9)
