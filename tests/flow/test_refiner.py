"""The refining network: where it stands still, what it does to sizes, gradients against
differences, what it is told of the flow that is missing, and what a few steps of training do."""
# pyright: reportArgumentType=false, reportCallIssue=false, reportOperatorIssue=false

import math

import numpy as np
import pytest
import torch

from codesign.events import from_stream
from codesign.flow.checkpoint import load
from codesign.flow.lk import estimate_lk
from codesign.flow.metrics import aee
from codesign.flow.refiner import Refiner, _on_cells, _on_pixels
from codesign.flow.refiner_evidence import (
    AROUND,
    CALIBRATION,
    CELL,
    MISFIT,
    MOST_PX,
    NOISE,
    TRIED_IN,
    Evidence,
)
from codesign.flow.warp import pixel_grid
from codesign.types import FlowField, FlowWindows
from scenes.windows.sets import HARSH, SETS
from scenes.windows.streams import turning
from tests.flow.volumes import drawn, in_even_bins
from tests.numbers import D, close, f64, randn64, seeded

SEED = 4242  # of no study


def network(seed=0, dtype=D, **options):
    """A small network with random weights everywhere, also where a fresh one has zeros."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        made = Refiner(**{"width": 16, "steps": 2, **options}).to(dtype)
        for parameter in made.parameters():
            if not bool(parameter.any()):
                torch.nn.init.normal_(parameter, std=0.1)
    return made.eval()


def begun(flow):
    """A start that may be off by a pixel."""
    covariance = (
        torch.tensor([1.0, 0.0, 1.0]).to(flow)[:, None, None].expand(len(flow), 3, *flow.shape[2:])
    )
    return FlowField(flow, torch.ones_like(flow[:, 0], dtype=torch.bool), 1.0, None, covariance)


def signed(bins):
    """A volume of signed bins [n, H, W]."""
    return in_even_bins(torch.stack([bins.clamp(min=0), (-bins).clamp(min=0)])[None])


def drifting(flow, side=64):
    """A volume of a smooth texture that drifts, without quantisation."""
    x, y = pixel_grid(side, side, torch.zeros((), dtype=D))
    time = ((torch.arange(8, dtype=D) + 0.5) / 8)[:, None, None]
    u = x - flow[0] * time
    v = y - flow[1] * time
    return signed(
        2 * (torch.sin(u / 2 + v / 7) + torch.sin(v / 2 - u / 5) + torch.sin((u + v) / 3))
    )


@pytest.mark.parametrize("size", [(64, 64), (9, 6)])
def test_a_fresh_network_is_the_closed_form(size):
    """Its last layers are zero: flow and, but for the 0.01 px^2 that are added, covariance come
    through; at any size, by events as the clock, from an expected flow."""
    counts = (
        drawn(2, 2, 8, *size, rate=0.3, seed=1)
        * torch.linspace(0.2, 3.0, 8, dtype=D)[:, None, None]
    )
    given = in_even_bins(counts)
    made = Refiner().double()
    start = estimate_lk(given, model="local")
    found = made.refined(given, start)[-1]
    assert torch.equal(found.flow_px, start.flow_px)
    shown = counts.flatten(1).sum(1).square() / (counts.flatten(1).sum(1).square() + 100)
    expected = (0.01 * shown)[:, None, None, None] * f64([1.0, 0.0, 1.0])[:, None, None]
    added = found.covariance_px2 - start.covariance_px2
    close(added, expected.expand_as(added), atol=1e-12)
    expected = f64([[5.0, -2.0]]).expand(2, 2)
    for options in ({"clock": "events"}, {"start_px": expected}):
        closed = estimate_lk(given, model="local", **options).flow_px
        assert (closed - start.flow_px).abs().max() > 1e-6
        assert torch.equal(made(given, **options).flow_px, closed)


@pytest.mark.bits
def test_the_flow_is_that_after_the_last_correction():
    given = in_even_bins(drawn(1, 2, 8, 32, 24, rate=0.3, seed=2))
    made = network()
    whole, *before = reversed(made.predictions(given))
    assert torch.equal(made(given).flow_px, whole.flow_px)
    assert not torch.equal(whole.flow_px, before[0].flow_px)


def on_noise():
    return [HARSH["noise"](SEED, 8).batch(range(8))]


def on_layers():
    return [SETS["layers_3"](SEED, 8).batch(range(16))]


def on_thin_packets():
    """4 x 5,000 events of a camera that turns, 240 x 180 px."""
    made = turning(seed=SEED)
    firsts = [len(made.stream) * k // 6 for k in (1, 2, 3, 4)]
    ends = [[int(made.stream.t_us[k]) for k in (first, first + 5000)] for first in firsts]
    return [FlowWindows(from_stream(made.stream, *both, 8), made.truth(*both)) for both in ends]


@pytest.mark.parametrize(
    ("case", "most_px", "of_start", "of_whole"),
    # the whole correction makes 1.3 px of noise, adds a third of the error on packets, takes off a
    # tenth on layers
    [(on_noise, 0.1, 1.001, 1.0), (on_thin_packets, 0.1, 1.05, 0.9), (on_layers, 1.0, 0.93, 1.01)],
)
def test_the_correction_counts_as_far_as_events_bend_the_field(case, most_px, of_start, of_whole):
    made = load("refiner")
    rows = []
    with torch.no_grad():
        for windows in case():
            start = made.start(windows.volume, clock="events")
            whole = made.refined(windows.volume, start, clock="events")[-1].flow_px
            found = made(windows.volume, clock="events").flow_px
            truth = windows.truth
            errors = [
                aee(flow, truth.flow_px, truth.valid) for flow in (found, start.flow_px, whole)
            ]
            rows.append(torch.stack([(found - start.flow_px).norm(dim=1).mean(), *errors]))
    change, error, of_it, of_all = torch.stack(rows).mean(0)
    assert change < most_px
    assert error <= of_start * of_it
    assert error <= of_whole * of_all


def test_the_evidence_is_damped_least_squares(generator):
    """Sums of products of slopes over a window: the solutions of (w N + 1 / MOST^2) f = -w r and of
    the same with the claimed variance, with the weight of the module's docstring, bent towards 3 px
    at a blur of 1 px."""
    evidence = Evidence(drifting((0.0, 0.0), 16))
    slopes = randn64(generator, 3, 60) * f64([0.3, 0.2, 0.2])[:, None]
    pairs = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
    products = [float((slopes[i] * slopes[j]).sum()) for i, j in pairs]
    seen = 59.0
    density = 0.7
    sums = f64([*products, seen, density * (seen + 1) - (seen + 1) / 64])
    claimed = 0.03
    found = evidence._solved(
        sums[None, :, None, None], 1, torch.full((1, 1, 1, 1), claimed, dtype=D)
    )
    xx, xy, yy, xs, ys, _ = products
    overlap = 4 * math.pi
    time_noise = density * evidence.time_noise / overlap
    noise = NOISE * density / overlap * (seen + 1)
    weight = ((xx + yy) / (xx + yy + noise)) ** 2 / (CALIBRATION * overlap * time_noise)
    for flow, precision in zip(found[:2], (MOST_PX**-2, 1 / (MISFIT * claimed)), strict=True):
        expected = np.linalg.solve(
            weight * np.array([[xx, xy], [xy, yy]]) + np.eye(2) * precision,
            -weight * np.array([xs, ys]),
        )
        expected /= math.sqrt(1 + expected @ expected / 9.0)
        assert flow.flatten().tolist() == pytest.approx(expected.tolist(), rel=1e-9)


def test_beside_a_border_the_flow_of_the_other_side_is_told_true_from_false():
    """Two textures meet between the cells 7 and 8 and drift apart. Along the true flow every cell
    loses contrast by the flow of the other side; where the left flow reaches two cells too far, the
    right one gains."""
    noise = randn64(seeded(6), 64, 64)
    left, right = (torch.stack([noise.roll(way * k, 0) for k in range(8)]) for way in (1, -1))
    bins = torch.where(torch.arange(64) < 32, left, right)
    evidence = Evidence(signed(bins))
    rightwards = AROUND.index((0, 3))
    leftwards = AROUND.index((0, -3))

    def tried(border, place):
        flow = torch.zeros(1, 2, 16, 16, dtype=D)
        flow[:, 1] = torch.where(torch.arange(16) < border, 8.0, -8.0)
        told, offered = evidence.others(flow)
        assert set(offered[0, place, 1].unique().tolist()) == {
            0.0,
            16.0 if place == leftwards else -16.0,
        }
        return told[0, place * len(TRIED_IN), 4:12].mean(0)

    assert tried(8, rightwards)[5:8].max() < -0.1
    assert tried(8, leftwards)[8:11].max() < -0.1
    assert tried(10, rightwards)[9] > 0.1
    assert tried(8, rightwards)[:3].abs().max() < 1e-12  # the same flow


def test_cells_become_pixels_linearly_until_edges_are_learnt():
    """Without weights a picture linear in x and y stays linear but for the thousandth that every
    cell keeps; a cell that is chosen gives its value to all its pixels."""
    y, x = torch.meshgrid(torch.arange(6, dtype=D), torch.arange(7, dtype=D), indexing="ij")
    image = torch.stack([x, 2 * y - x])[None]
    found = _on_pixels(image, torch.zeros(1, 9 * CELL**2, 6, 7, dtype=D))
    place = [(torch.arange(CELL * n, dtype=D) + 0.5) / CELL - 0.5 for n in (6, 7)]
    v, u = torch.meshgrid(*place, indexing="ij")
    inside = slice(CELL, -CELL)
    expected = torch.stack([u, 2 * v - u])
    assert (found[0] - expected)[:, inside, inside].abs().max() < 0.01
    own = torch.zeros(1, 9, CELL**2, 6, 7, dtype=D)
    own[:, 4] = 100.0
    steps = _on_pixels(image, own.flatten(1, 2))
    close(steps, image.repeat_interleave(CELL, 2).repeat_interleave(CELL, 3), atol=1e-9)


def test_an_image_is_continued_on_cells_by_its_own_width_and_height():
    rows, columns = 7, 9
    y, x = np.meshgrid(
        np.arange(8).clip(max=rows - 1), np.arange(12).clip(max=columns - 1), indexing="ij"
    )
    whole = (10.0 * y + x).reshape(2, CELL, 3, CELL).mean((1, 3))
    image = 10 * torch.arange(rows, dtype=D)[:, None] + torch.arange(columns, dtype=D)
    np.testing.assert_allclose(_on_cells(image[None, None])[0, 0].numpy(), whole, rtol=1e-14)


def test_gradient_to_a_start_passes_gradcheck(generator):
    made = network()
    counts = in_even_bins(drawn(1, 2, 8, 16, 16, seed=1))
    start = randn64(generator, 1, 2, 16, 16).requires_grad_()

    def refined(start):
        return made.refined(counts, begun(start))[-1].flow_px

    assert torch.autograd.gradcheck(refined, start, atol=1e-5, rtol=1e-3, fast_mode=True)


def test_motion_that_turns_back_keeps_the_closed_form_by_events_as_far_as_it_comes_back():
    x, y = pixel_grid(32, 32, torch.zeros((), dtype=D))
    time = ((torch.arange(8, dtype=D) + 0.5) / 8 * math.pi)[:, None, None]
    u = x - 4 * torch.sin(time)  # there and back
    turned = signed(20 * torch.cos(time) * (torch.sin(u / 2 + y / 7) + torch.sin(y / 2 - u / 5)))
    start = estimate_lk(turned, model="local", clock="events").flow_px
    found = network()(turned, clock="events")
    assert (found.flow_px - start).abs().max() < 1e-3
    spread = (found.covariance_px2[:, 0] + found.covariance_px2[:, 2]) / 2
    close(found.confidence, 9 / (9 + spread), rtol=1e-3)
    assert (network().refined(turned, begun(start))[-1].flow_px - start).abs().max() > 0.1


def test_the_budget_of_weights():
    made = Refiner()
    assert sum(parameter.numel() for parameter in made.parameters()) <= 400_000
    assert made.config == {"bins": 8, "width": 48, "steps": 2}
