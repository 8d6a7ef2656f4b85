"""Event volumes that tests of estimators are given."""

import torch

from codesign.types import EventVolume
from tests.numbers import D, seeded


def drawn(*shape, rate=1.0, seed=0):
    """Poisson counts of one rate everywhere, in doubles."""
    return torch.poisson(torch.full(shape, rate, dtype=D), generator=seeded(seed))


def in_even_bins(counts, span_s=1.0):
    """The volume of counts [B, 2, bins, H, W] whose bins are shares of a time, one after another."""
    bins = counts.shape[2]
    centroid_s = (torch.arange(bins, dtype=D) + 0.5) * span_s / bins
    return EventVolume(counts, centroid_s, torch.full((bins,), span_s / bins, dtype=D))
