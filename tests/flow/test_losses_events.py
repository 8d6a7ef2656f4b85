"""Contrast maximisation: the true motion of moving dots and of a physical sensor's events, event
collapse, and finite differences."""

import math

import pytest
import torch

from codesign import events
from codesign.flow import contrast, losses
from codesign.flow.export import evenly_timed
from tests.flow.test_contrast import centred
from tests.flow.test_losses import check_gradients
from tests.numbers import D, f64, rand64, randn64, seeded


def dots(zoom=0.0, shift=(0.0, 0.0), size=40, radius=12.0, count=24, bins=6, steps=36):
    """Volume of Gaussian dots (1.2 px) of both signs, scattered around the middle, that move and
    grow by zoom x + shift; the grid [2, H, W] from the middle."""
    x, y = grid = centred(size)
    u = rand64(seeded(3), 3, count)
    place = (
        radius * u[0].sqrt() * torch.stack([(2 * math.pi * u[1]).cos(), (2 * math.pi * u[1]).sin()])
    )
    tau = (torch.arange(steps, dtype=D)[:, None, None, None] + 0.5) / steps
    at = place[:, None, :, None, None] * (1 + tau * zoom)
    at = at + tau * f64(shift)[:, None, None, None, None]
    blob = (
        torch.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * (1.2 * (1 + tau * zoom)) ** 2))
        / steps
    )
    frames = torch.stack([blob[:, u[2] > 0.5].sum(1), blob[:, u[2] <= 0.5].sum(1)], 1)
    times = torch.linspace(0, 0.05, steps + 1, dtype=D)
    return events.from_counts(frames, times, bins), grid


def least(loss, values):
    """Place of the least of evenly spaced values, by the parabola through its neighbours."""
    found = [float(loss(value)) for value in values]
    k = min(max(found.index(min(found)), 1), len(found) - 2)
    before, at, after = found[k - 1 : k + 2]
    return values[k] + (values[1] - values[0]) * (before - after) / (2 * (before - 2 * at + after))


def plain_contrast(volume, flow_px):
    """The objective as published, without a guard: zero-flow sharpness over mean sharpness."""
    tracks = contrast.volume_tracks(volume, flow_px)
    images = [(share, contrast.smooth_image(tracks, at)) for at, share in losses.REFERENCES]
    moved = sum(share * contrast.sharpness(image) for share, image in images)
    return (contrast.sharpness(contrast.still_image(volume.counts)) / moved).mean()


@pytest.mark.parametrize("loss", [losses.contrast_loss, plain_contrast])
def test_translation_is_least_at_the_true_motion(loss):
    volume, grid = dots(shift=(4.0, -2.5))

    def along(u, v):
        return loss(volume, (0 * grid + f64([u, v])[:, None, None])[None])

    # symmetric about the true motion but for the grid, whose phases the B-spline leaves visible in
    # third moments only
    assert least(lambda u: along(u, -2.5), [3.0, 3.5, 4.0, 4.5, 5.0]) == pytest.approx(
        4.0, abs=0.03
    )
    assert least(lambda v: along(4.0, v), [-3.5, -3.0, -2.5, -2.0, -1.5]) == pytest.approx(
        -2.5, abs=0.03
    )
    assert along(4.0, -2.5) < 0.6


@pytest.mark.parametrize("zoom", [0.3, -0.25])
def test_the_plain_objective_collapses_and_the_guarded_one_finds_the_zoom(zoom):
    volume, grid = dots(zoom=zoom, size=56, radius=18.0, count=40)
    wide = [-3.0, -2.0, -1.25, -1.0, -0.75, -0.5, 0.0, zoom, 0.5, 0.75, 1.0, 1.5, 3.0]
    plain = [float(plain_contrast(volume, s * grid[None])) for s in wide]
    guarded = [float(losses.contrast_loss(volume, s * grid[None])) for s in wide]
    # every event ends in the middle, or passes it
    assert wide[plain.index(min(plain))] in (-1.25, -1.0)
    assert min(plain) < 0.5 * plain[wide.index(zoom)]
    assert wide[guarded.index(min(guarded))] == zoom
    # one carry step leaves (tau zoom)^2 of the flow, 2 to 3 % on average over the window
    near = [zoom * (0.8 + 0.1 * k) for k in range(5)]
    found = least(lambda s: losses.contrast_loss(volume, s * grid[None]), near)
    assert found == pytest.approx(zoom, rel=0.04)


def test_no_events_cost_as_much_as_zero_flow_and_give_no_gradient(generator):
    counts = torch.zeros(1, 2, 3, 8, 9, requires_grad=True)
    flow = torch.randn(1, 2, 8, 9, generator=generator).requires_grad_()
    value = losses.contrast_loss(evenly_timed(counts), flow)
    assert value.item() == 1
    assert not any(grad.any() for grad in torch.autograd.grad(value, (counts, flow)))
    drawn = torch.rand(counts.shape, generator=generator)
    still = losses.contrast_loss(evenly_timed(drawn), torch.zeros(1, 2, 8, 9))
    assert float(still) == pytest.approx(1, rel=1e-6)


def test_gradcheck_in_events_and_flow(generator):
    counts = rand64(generator, 1, 2, 2, 3, 4)
    flow = 0.8 * randn64(generator, 1, 2, 3, 4)
    check_gradients(lambda c, f: losses.contrast_loss(evenly_timed(c), f), counts, flow)


def test_the_weight_of_an_area_is_itself_where_it_is_moderate():
    area = f64([-3.0, 0.0, 0.2, 0.5, 1.0, 1.5, 1e6])
    one = torch.ones_like(area)
    none = torch.zeros_like(area)
    assert losses._stretch((area, none, none, one)).tolist() == pytest.approx(
        [0, 0, 0.2, 0.5, 1, 1.5, 2.5]
    )
    # turned over in both axes: the area is positive, the warp is not upright
    assert not losses._stretch((-one, none, none, -area.abs())).any()
    # no corner at 0, 0.2 or 1.5
    check_gradients(lambda a: losses._stretch((a, none, none, one)), area)
    turn = f64(0.8)  # a rotation by 46 degrees changes no area
    assert losses._stretch(
        (turn.cos(), -turn.sin(), turn.sin(), turn.cos())
    ).item() == pytest.approx(1)
