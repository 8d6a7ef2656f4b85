"""Contrast maximisation: the true motion of moving dots and of a physical sensor's events, event collapse,
and finite differences."""

import math
from dataclasses import replace

import pytest
import torch

from codesign import events
from codesign.flow import losses, metrics
from codesign.types import EventVolume

D = torch.float64


def check_gradients(function, *inputs):
    assert torch.autograd.gradcheck(
        function, [value.clone().requires_grad_() for value in inputs], eps=1e-6, atol=1e-8, rtol=1e-5
    )


def dots(zoom=0.0, shift=(0.0, 0.0), size=40, radius=12.0, count=24, bins=6, steps=36):
    """Volume of Gaussian dots (1.2 px) of both signs, scattered around the middle, that move and grow by zoom
    x + shift; the grid [2, H, W] from the middle."""
    y, x = torch.meshgrid(*[torch.arange(size, dtype=D) - (size - 1) / 2] * 2, indexing="ij")
    u = torch.rand(3, count, generator=torch.Generator().manual_seed(3), dtype=D)
    place = radius * u[0].sqrt() * torch.stack([(2 * math.pi * u[1]).cos(), (2 * math.pi * u[1]).sin()])
    frames = []
    for k in range(steps):
        tau = (k + 0.5) / steps
        at = place * (1 + tau * zoom) + tau * torch.tensor(shift, dtype=D)[:, None]
        blob = (
            torch.exp(
                -((x - at[0, :, None, None]).square() + (y - at[1, :, None, None]).square())
                / (2 * (1.2 * (1 + tau * zoom)) ** 2)
            )
            / steps
        )
        frames.append(torch.stack([blob[u[2] > 0.5].sum(0), blob[u[2] <= 0.5].sum(0)]))
    return events.from_counts(
        torch.stack(frames), torch.linspace(0, 0.05, steps + 1, dtype=D), bins
    ), torch.stack([x, y])


def least(loss, values):
    """Place of the least of evenly spaced values, by the parabola through its neighbours."""
    found = [float(loss(value)) for value in values]
    k = min(max(found.index(min(found)), 1), len(found) - 2)
    before, at, after = found[k - 1 : k + 2]
    return values[k] + (values[1] - values[0]) * (before - after) / (2 * (before - 2 * at + after))


@pytest.mark.parametrize("loss", [losses.contrast_loss, losses.plain_contrast_loss])
def test_translation_is_least_at_the_true_motion(loss):
    volume, grid = dots(shift=(4.0, -2.5))

    def along(u, v):
        return loss(
            volume,
            torch.tensor([u, v], dtype=D)[None, :, None, None].expand(1, 2, *grid.shape[1:]).contiguous(),
        )

    # symmetric about the true motion but for the grid, whose phases the B-spline leaves visible in third
    # moments only
    assert least(lambda u: along(u, -2.5), [3.0, 3.5, 4.0, 4.5, 5.0]) == pytest.approx(4.0, abs=0.03)
    assert least(lambda v: along(4.0, v), [-3.5, -3.0, -2.5, -2.0, -1.5]) == pytest.approx(-2.5, abs=0.03)
    assert float(along(0.0, 0.0)) == pytest.approx(1)
    assert float(along(4.0, -2.5)) < 0.6


@pytest.mark.parametrize("zoom", [0.3, -0.25])
def test_the_plain_objective_collapses_and_the_guarded_one_finds_the_zoom(zoom):
    volume, grid = dots(zoom=zoom, size=56, radius=18.0, count=40)
    wide = [-3.0, -2.0, -1.25, -1.0, -0.75, -0.5, 0.0, zoom, 0.5, 0.75, 1.0, 1.5, 3.0]
    plain = [float(losses.plain_contrast_loss(volume, s * grid[None])) for s in wide]
    guarded = [float(losses.contrast_loss(volume, s * grid[None])) for s in wide]
    assert wide[plain.index(min(plain))] in (-1.25, -1.0)  # every event ends in the middle, or passes it
    assert min(plain) < 0.5 * plain[wide.index(zoom)]
    assert wide[guarded.index(min(guarded))] == zoom
    # one carry step leaves (tau zoom)^2 of the flow, 2 to 3 % on average over the window
    assert least(
        lambda s: losses.contrast_loss(volume, s * grid[None]), [zoom * (0.8 + 0.1 * k) for k in range(5)]
    ) == pytest.approx(zoom, rel=0.04)


def test_descent_from_zero_flow_finds_the_motion_of_a_physical_sensors_events():
    # texture of 5 px and coarser; threshold 0.2 with mismatch and shot noise; an affine motion of 3 px on
    # average
    shift = torch.tensor([2.5, -1.0], dtype=D)
    matrix = torch.tensor([[0.05, -0.04], [0.06, -0.03]], dtype=D)
    y, x = torch.meshgrid(*[torch.arange(40, dtype=D) - 19.5] * 2, indexing="ij")
    u = torch.rand(3, 40, generator=torch.Generator().manual_seed(1), dtype=D)
    wave = 2 * math.pi / (5 * 8 ** u[0])
    turn = 2 * math.pi * u[1]
    frames = []
    for tau in torch.linspace(0, 1, 17, dtype=D):
        at = torch.linalg.solve(
            torch.eye(2, dtype=D) + tau * matrix, torch.stack([x, y]).flatten(1) - tau * shift[:, None]
        )
        wavy = torch.cos(
            wave * (turn.cos() * at[0][:, None] + turn.sin() * at[1][:, None]) + 2 * math.pi * u[2]
        )
        frames.append(60 * torch.exp(0.6 * wavy.sum(1) * (2 / 40) ** 0.5).reshape(40, 40))
    sensor = events.SensorModel(theta_on=0.2, theta_off=0.2, theta_sigma=0.03, shot_rate_hz=1.0)
    stream = events.simulate(
        torch.stack(frames), torch.linspace(0, 0.05, 17, dtype=D), sensor, torch.Generator().manual_seed(0)
    )
    volume = events.from_stream(stream, 0, 50000, 6, dtype=D)
    truth = (torch.einsum("ij,jhw->ihw", matrix, torch.stack([x, y])) + shift[:, None, None])[None]
    basis = torch.stack([torch.ones_like(x), x / 20, y / 20])
    parameters = torch.zeros(2, 3, dtype=D, requires_grad=True)
    optimiser = torch.optim.Adam([parameters], 0.25)
    for _ in range(50):
        optimiser.zero_grad()
        flow = torch.einsum("ck,khw->chw", parameters, basis)[None]
        losses.contrast_loss(volume, flow).backward()
        optimiser.step()
    # events at threshold 0.2 place an edge to a fraction of a pixel; 0.06 to 0.13 of zero flow was measured
    # on five larger samples
    assert float(metrics.aee(flow.detach(), truth)) <= 0.2 * float(metrics.zero_flow_error(truth))


def test_the_published_penalty_by_hand_stops_the_collapse():
    # one bin in mid-window and a zoom of -0.6: the area changes by 1.3^2, 1 and 0.7^2 at the three references
    y, x = torch.meshgrid(*[torch.arange(5, dtype=D) - 2] * 2, indexing="ij")
    one = EventVolume(
        torch.ones(1, 2, 1, 5, 5, dtype=D), torch.tensor([0.5], dtype=D), torch.ones(1, dtype=D)
    )
    found = losses.collapse_penalty(one, -0.6 * torch.stack([x, y])[None])
    assert float(found) == pytest.approx(0.25 * (0.8 - 0.49) ** 2)
    volume, grid = dots(zoom=0.3)
    sums = {
        s: float(
            losses.plain_contrast_loss(volume, s * grid[None])
            + 5 * losses.collapse_penalty(volume, s * grid[None])
        )
        for s in (-1.0, -0.5, 0.0, 0.3)
    }
    assert min(sums, key=lambda s: sums[s]) == 0.3


@pytest.mark.parametrize("dtype", [torch.float32, D])
@pytest.mark.parametrize("loss", [losses.contrast_loss, losses.plain_contrast_loss])
def test_no_events_cost_as_much_as_zero_flow_and_give_no_gradient(loss, dtype, generator):
    counts = torch.zeros(1, 2, 3, 8, 9, dtype=dtype, requires_grad=True)
    flow = torch.randn(1, 2, 8, 9, generator=generator, dtype=dtype).requires_grad_()
    volume = EventVolume(counts, torch.linspace(0, 1, 3), torch.full((3,), 1 / 3))
    value = loss(volume, flow)
    assert value.item() == 1
    for grad in torch.autograd.grad(value, (counts, flow)):
        assert not grad.any()
    still = loss(
        replace(volume, counts=torch.rand(1, 2, 3, 8, 9, generator=generator, dtype=dtype)),
        torch.zeros_like(flow),
    )
    assert float(still) == pytest.approx(1, rel=1e-6)  # and zero flow costs 1, whatever the events


@pytest.mark.parametrize("loss", [losses.contrast_loss, losses.plain_contrast_loss, losses.collapse_penalty])
def test_gradcheck_in_events_and_flow(loss, generator):
    shell = EventVolume(torch.zeros(1), torch.tensor([0.0, 0.7], dtype=D), torch.full((2,), 0.5, dtype=D))
    counts = torch.rand(1, 2, 2, 3, 4, generator=generator, dtype=D)
    check_gradients(
        lambda c, f: loss(replace(shell, counts=c), f),
        counts,
        0.8 * torch.randn(1, 2, 3, 4, generator=generator, dtype=D),
    )


def test_the_weight_of_an_area_is_itself_where_it_is_moderate():
    area = torch.tensor([-3.0, 0.0, 0.2, 0.5, 1.0, 1.5, 1e6], dtype=D)
    one = torch.ones_like(area)
    none = torch.zeros_like(area)
    assert losses._stretch((area, none, none, one)).tolist() == pytest.approx([0, 0, 0.2, 0.5, 1, 1.5, 2.5])
    assert not losses._stretch(
        (-one, none, none, -area.abs())
    ).any()  # turned over in both axes: the area is positive, the warp is not upright
    check_gradients(lambda a: losses._stretch((a, none, none, one)), area)  # no corner at 0, 0.2 or 1.5
    turn = torch.tensor(0.8, dtype=D)  # a rotation by 46 degrees changes no area
    assert losses._stretch((turn.cos(), -turn.sin(), turn.sin(), turn.cos())).item() == pytest.approx(1)
