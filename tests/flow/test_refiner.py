"""The refining network: where it stands still, what it does to sizes, gradients against differences, and what
a few steps of training do."""

import math

import numpy as np
import pytest
import torch

from codesign.errors import DomainError, ShapeError
from codesign.flow.refiner import Refiner, _local_flow
from codesign.flow.warp import along_flow, pixel_grid
from codesign.types import EventVolume
from scenes.flow_windows import RenderedWindows, planes

D = torch.float64


def network(seed=0, dtype=D, **options):
    """A small network with random weights everywhere, also where a fresh one has zeros."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        made = Refiner(**{"width": 8, "steps": 2, **options}).to(dtype)
        for parameter in made.parameters():
            if not bool(parameter.any()):
                torch.nn.init.normal_(parameter, std=0.1)
    return made.eval()


def volume(counts):
    bins = counts.shape[2]
    return EventVolume(
        counts, (torch.arange(bins, dtype=D) + 0.5) / bins, torch.full((bins,), 1 / bins, dtype=D)
    )


def events(*shape, rate=0.3, seed=1):
    return torch.poisson(torch.full(shape, rate, dtype=D), generator=torch.Generator().manual_seed(seed))


def test_bins_are_looked_up_along_the_flow():
    """A picture linear in x and y, carried along: sampling at q + t flow(q) is exact for bilinear lookups
    away from the border."""
    x, y = pixel_grid(12, 16, torch.zeros((), dtype=D))
    flow = torch.stack([0.3 + 0.05 * x, -0.4 + 0.02 * y])[None]
    time = torch.tensor([0.0, 0.5, 1.0], dtype=D)
    found = along_flow((2 * x + 3 * y).expand(1, 3, 12, 16), flow, time)
    expected = 2 * (x + time[:, None, None] * flow[0, 0]) + 3 * (y + time[:, None, None] * flow[0, 1])
    torch.testing.assert_close(found[0, :, 2:-2, 2:-2], expected[:, 2:-2, 2:-2], rtol=0, atol=1e-12)


def test_without_corrections_the_start_comes_through():
    """With the correcting layers at zero the answer is the start, averaged over cells of 4 px: a constant
    flow exactly, all but the fading-in of events."""
    fresh = network()
    for head in (fresh.change_middle, fresh.change_fine):
        for parameter in head.parameters():
            torch.nn.init.zeros_(parameter)
    start = torch.tensor([1.5, -0.75], dtype=D)[None, :, None, None].expand(1, 2, 32, 48).clone()
    for field in fresh.predictions(volume(events(1, 2, 8, 32, 48)), start):
        torch.testing.assert_close(
            field.flow_px, start.expand_as(field.flow_px), rtol=1e-4, atol=0
        )  # n^2 / (n^2 + 100) of 7000 events


def test_loss_gradient_to_the_volume_passes_gradcheck():
    made = network()
    counts = events(1, 2, 8, 16, 16, rate=1.0).requires_grad_()
    weights = torch.randn(1, 2, 16, 16, dtype=D, generator=torch.Generator().manual_seed(2))

    def loss(counts):
        field = made(volume(counts))
        return (field.flow_px * weights).sum(), field.covariance_px2.sum(), field.confidence.sum()

    assert torch.autograd.gradcheck(loss, (counts,), eps=1e-6, atol=1e-5, rtol=1e-3, fast_mode=True)


def test_an_empty_volume_gives_zero_flow_zero_confidence_and_zero_gradient():
    counts = torch.zeros(1, 2, 8, 20, 24, dtype=D, requires_grad=True)
    field = network()(volume(counts))
    assert not bool(field.flow_px.any() | field.confidence.any() | field.valid.any())
    (gradient,) = torch.autograd.grad(field.flow_px.sum() + field.confidence.sum(), counts)
    assert torch.equal(gradient, torch.zeros_like(gradient))


@pytest.mark.parametrize("case", ["one event", "saturated", "constant", "one row"])
def test_odd_volumes_keep_value_and_gradient_tame(case):
    """No scene moves by more than a few times the prior, whatever the counts: bounded flow, and a gradient
    that differences confirm along one direction."""
    counts = torch.zeros(1, 2, 8, 16, 16, dtype=D)
    if case == "one event":
        counts[0, 0, 3, 8, 8] = 1.0
    elif case == "one row":
        counts[0, :, :, 8] = 5.0
    else:
        counts += 1e4 if case == "saturated" else 2.0
    made = network()
    counts = counts.requires_grad_()
    direction = (
        torch.randn(counts.shape, dtype=D, generator=torch.Generator().manual_seed(3)) * counts.detach().max()
    )

    def total(step):
        return made(volume(counts.detach() + step * direction)).flow_px.sum()

    field = made(volume(counts))
    assert field.flow_px.abs().max() < 40.0
    (gradient,) = torch.autograd.grad(field.flow_px.sum(), counts)
    step = 1e-6
    with torch.no_grad():
        difference = (total(step) - total(-step)) / (2 * step)
    torch.testing.assert_close((gradient * direction).sum(), difference, rtol=2e-3, atol=1e-4)


def test_any_size_is_padded_and_cropped_back():
    made = network()
    counts = events(2, 2, 8, 37, 50)
    start = torch.zeros(2, 2, 37, 50, dtype=D)
    found = made.predictions(volume(counts), start)[-1]
    wide = made.predictions(
        volume(torch.nn.functional.pad(counts, (0, 14, 0, 11))), torch.zeros(2, 2, 48, 64, dtype=D)
    )[-1]
    torch.testing.assert_close(found.flow_px, wide.flow_px[..., :37, :50], rtol=0, atol=1e-12)
    assert found.confidence is not None
    assert found.confidence.shape == (2, 37, 50)


def test_samples_do_not_see_each_other():
    made = network()
    counts = events(3, 2, 8, 32, 32)
    counts[1] *= 100
    together = made(volume(counts))
    alone = made(volume(counts[2:]))
    torch.testing.assert_close(together.flow_px[2], alone.flow_px[0], rtol=0, atol=1e-9)


def test_a_few_steps_teach_what_the_closed_form_leaves():
    """Eight windows learnt by heart: from a start 1 px off everywhere, forty steps must take away most of
    it."""
    windows = RenderedWindows(planes("fine", 0.1), seed=9, height_px=32, width_px=32).batch(range(8))
    made = network(dtype=torch.float32, steps=2).train()
    truth = windows.truth.flow_px
    start = truth + torch.tensor([0.8, -0.6])[:, None, None]
    optimiser = torch.optim.Adam(made.parameters(), 3e-3)
    for _ in range(40):
        error = (
            (made.predictions(windows.volume, start)[-1].flow_px - truth)
            .square()
            .sum(1)
            .add(1e-6)
            .sqrt()
            .mean()
        )
        optimiser.zero_grad()
        error.backward()
        optimiser.step()
    assert float(error.detach()) < 0.4


def test_wrong_volumes_and_sizes_are_refused():
    with pytest.raises(ShapeError, match=r"takes event volumes \[B, 2, 8, H, W\], got \(1, 2, 5, 16, 16\)"):
        network()(volume(events(1, 2, 5, 16, 16)))
    with pytest.raises(DomainError, match="multiple of 4"):
        Refiner(width=10)
    counts = events(1, 2, 8, 16, 16)
    counts[0, 0, 0, 0, 0] = float("nan")
    with pytest.raises(DomainError, match="event volume"):
        network()(volume(counts))


def test_the_budget_of_weights():
    made = Refiner()
    assert sum(parameter.numel() for parameter in made.parameters()) <= 500_000
    assert made.config == {"bins": 8, "width": 28, "steps": 2}


def test_a_wrong_correction_hardly_counts():
    """The network is made to add 3 px everywhere; along the true start nothing moves, so the answer must keep
    to it."""
    windows = RenderedWindows(planes("fine", 0.1), seed=12).batch(range(4))
    made = network(dtype=torch.float32, steps=1)
    for head in (made.change_middle, made.change_fine, made.blend):
        for parameter in head.parameters():
            torch.nn.init.zeros_(parameter)
    assert made.change_fine.bias is not None
    torch.nn.init.constant_(made.change_fine.bias, 1.5)  # averaged pixels of 2 px
    truth = windows.truth.flow_px

    def error(flow_px):
        return float((flow_px - truth).square().sum(1).sqrt().mean().detach())

    assert error(made.predictions(windows.volume)[-1].flow_px) > 3.5
    assert error(made(windows.volume).flow_px) < 0.5


def test_the_local_flow_solves_the_damped_normal_equations(generator):
    """V_t + u V_x + v V_y = 0 in least squares over some slopes, with 2 % of the mean square slope and a part of the
    motion's energy on the diagonal; long answers bend towards ``reach``."""
    slopes = (
        torch.randn(3, 40, 5, 6, generator=generator, dtype=D)
        * torch.tensor([1.0, 0.3, 2.0], dtype=D)[:, None, None, None]
    )
    pairs = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
    products = torch.stack([(slopes[i] * slopes[j]).mean(0) for i, j in pairs])[None]
    reach = 1.5
    found = _local_flow(products, reach)[0]
    xx, xy, yy, xs, ys, ss = products[0]
    for row in range(5):
        for column in range(6):
            at = (row, column)
            damping = 0.02 * float((xx + yy).mean()) + 0.02 * float(ss[at]) * (2 / 8.0) ** 2 + 1e-6
            matrix = np.array([[xx[at] + damping, xy[at]], [xy[at], yy[at] + damping]])
            flow = np.linalg.solve(matrix, -np.array([xs[at], ys[at]]))
            flow /= math.sqrt(1 + flow @ flow / reach**2)
            assert found[:2, row, column].tolist() == pytest.approx(flow.tolist(), rel=1e-10)
            assert float(found[2, row, column]) == pytest.approx(
                (matrix[0, 0] - matrix[1, 1]) / np.trace(matrix)
            )
            assert float(found[3, row, column]) == pytest.approx(2 * matrix[0, 1] / np.trace(matrix))
