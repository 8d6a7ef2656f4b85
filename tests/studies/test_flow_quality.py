"""Measures of the study of flow's quality, against numbers worked out by hand; and its quick form
from the command line."""

import math

import numpy as np
import pytest
import torch

from codesign.events.stream import ordered
from codesign.flow import metrics
from codesign.flow.checkpoint import DELIVERED
from codesign.flow.export import evenly_timed
from codesign.types import FlowField, FlowWindows
from studies.flow_quality import __main__ as flow_quality
from studies.flow_quality.__main__ import Config, judged
from studies.flow_quality.measures import (
    SHARES,
    figures,
    join,
    measure,
    sparsified,
    spearman,
    warp_loss,
)
from tests.studies.browser import check_page
from tests.studies.runs import numbers, ran


def one_window(error_px, confidence=None, variance_px2=None, truth_px=2.0):
    """A window [1, H, W] whose estimate is too long by error_px in x, truth along x."""
    truth = torch.zeros(1, 2, *error_px.shape)
    truth[:, 0] = truth_px
    flow = truth.clone()
    flow[:, 0] += error_px
    covariance = None
    if variance_px2 is not None:
        covariance = torch.stack([variance_px2, torch.zeros_like(variance_px2), variance_px2])[None]
    valid = torch.ones(1, *error_px.shape, dtype=torch.bool)
    field = FlowField(
        flow, valid, 1.0, None if confidence is None else confidence[None], covariance
    )
    counts = torch.zeros(1, 2, 4, *error_px.shape)
    return field, FlowWindows(evenly_timed(counts), FlowField(truth, valid, 1.0))


def test_errors_claims_and_ranks_of_two_windows():
    """Errors 0.5, 1, 1.5, 2 of a flow of 2 px; then 6 px everywhere: 5 / 4 and 6 / 2 of zero
    flow."""
    error = torch.tensor([[0.5, 1.0], [1.5, 2.0]])
    variance = error.square() / 2 / 4  # errors are twice what is claimed
    rising = measure(*one_window(error, 1 - error / 10, variance))
    even = measure(
        *one_window(torch.full((2, 2), 6.0), torch.full((2, 2), 0.5), torch.full((2, 2), 18.0))
    )
    first = figures(rising)
    both = figures(join([rising, even]))
    assert first["ratio"] == pytest.approx(1.25 / 2)
    assert both["ratio"] == pytest.approx((1.25 + 6) / 4)
    assert both["worse_percent"] == both["much_worse_percent"] == 50.0
    assert both["worse_by_a_twentieth_px_percent"] == 50.0
    # 0.5^2 / (0.5^2 / 8) = 8 and its like are outside 4.6, 36 / 18 = 2 is inside
    assert both["within_percent"] == 50.0
    assert both["normalised_square"] == pytest.approx((8 + 2) / 4)
    # draws of two windows from two: both the first, both the second, with a probability of 1/4 each
    assert (both["ratio_low"], both["ratio_high"]) == pytest.approx((1.25 / 2, 3.0))
    assert first["error_over_claimed"] == pytest.approx(2.0)
    assert both["error_over_claimed"] == pytest.approx(((4 + 1) / 2) ** 0.5)
    # medians 2 and 1 over the windows, over that of a two-dimensional Gaussian's length
    assert both["error_over_claimed_median"] == pytest.approx(1.5 / math.log(2) ** 0.5)
    assert first["rank_correlation"] == pytest.approx(1.0)
    assert math.isnan(even["spearman"][0])
    assert both["rank_correlation"] == pytest.approx(1.0)  # the even window has none
    assert first["ause"] == pytest.approx(0.0, abs=1e-12)
    assert "sharpness" not in first


def test_what_is_not_claimed_has_no_figures():
    plain = figures(measure(*one_window(torch.tensor([[0.5, 1.0]]))))
    assert not {
        name for name in plain if "claim" in name or "rank" in name or name == "normalised_square"
    }


def test_ranks_and_sparsification_by_hand():
    # d = 0, 2, 1, -1, -2: 1 - 6 * 10 / (5 * 24)
    ranks = spearman(np.array([1.0, 4, 4.5, 3.5, 2]), np.array([10.0, 20, 40, 50, 60]))
    assert ranks == pytest.approx(1 - 6 * (0 + 4 + 4 + 1 + 9) / (5 * 24))
    # ten pixels of error 1 to 10: taking out the largest half leaves a mean of 3, the smallest half
    # 8; equal doubt leaves the mean whatever the share
    error = np.arange(1.0, 11)
    half = int(np.argmin(abs(SHARES - 0.5)))
    assert sparsified(error, error)[[0, half]] == pytest.approx([5.5, 3.0])
    assert sparsified(error, -error)[half] == pytest.approx(8.0)
    np.testing.assert_allclose(sparsified(error, np.zeros(10)), 5.5)
    # for many errors even on 0..1 the oracle's curve is 1 - s, chance's is 1: the area to s = 0.95
    # is 0.95^2 / 2
    even = torch.linspace(0, 1, 4000).reshape(40, 100)
    chance = figures(measure(*one_window(even, torch.full((40, 100), 0.5))))
    assert chance["ause"] == pytest.approx(0.95**2 / 2, rel=2e-3)


def test_warp_loss_of_bins_is_that_of_their_events(generator):
    """Events at the centroids of bins, so that a volume holds what the stream does."""
    empty = evenly_timed(torch.zeros(1, 2, 4, 12, 16))
    pick, x, y, on = (torch.randint(size, (300,), generator=generator) for size in (4, 16, 12, 2))
    t_us = (empty.centroid_s[pick] / empty.collected_s.sum() * 1e6).round().long()
    stream = ordered(t_us, x, y, 2 * on - 1, 12, 16)
    counts = torch.zeros_like(empty.counts)
    counts.index_put_((torch.zeros_like(x), 1 - on, pick, y, x), torch.ones(300), accumulate=True)
    flow_px = torch.tensor([3.3, -1.7])[None, :, None, None].expand(1, 2, 12, 16)
    right = metrics.fwl(stream, flow_px, 0, 10**6)
    assert warp_loss(evenly_timed(counts), flow_px, 0) == pytest.approx(right, rel=1e-6)
    assert math.isnan(warp_loss(empty, flow_px, 0))


@pytest.mark.skipif(not DELIVERED["refiner"].exists(), reason="no trained refiner in this checkout")
def test_quick_form(tmp_path, monkeypatch):
    """The delivered refiner beats zero flow on fine textures and in the worlds by far: a broken
    file or a wrong convention would not."""
    # pictures and their tables take a third of the time
    monkeypatch.setattr(flow_quality, "SHOWN", 1)
    chosen = "fine_theta_0.1 worlds layers_0.3 mixed_theta_0.2_noise_0.002"
    options = f"--quick --models affine constant --sets {chosen} --out"
    assert ran(flow_quality, options, tmp_path) == 0
    found = numbers(tmp_path)
    assert found["fine_theta_0.1_refiner_ratio"] < 0.2
    assert found["worlds_refiner_ratio"] < 0.8
    assert found["worlds_windows"] == 5
    # 0.3 of the scene, up to 15 % of noise on top
    assert found["layers_0.3_events_per_px_median"] < 0.36
    assert found["layers_0.3_closed_form_affine_sharpness"] > 1
    # the prior and the noise model are worth more than half of the plain solve's error
    # (docs/flow_closed_form.md)
    cell = "mixed_theta_0.2_noise_0.002"
    assert found[f"{cell}_closed_form_affine_ratio"] < 0.5 * found[f"{cell}_plain_ratio"]
    check_page("flow_quality", tmp_path)


def test_cells_of_single_planes_are_sets():
    assert len(judged(Config(sets=("cells",)), 4)) == 12
