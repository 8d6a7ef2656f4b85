"""How well an estimator does on windows that no network was trained on, beside zero flow."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import nn

from codesign.errors import DomainError
from codesign.flow.losses import contrast_loss
from codesign.flow.metrics import endpoint_error
from codesign.train.batches import Source, to_device
from codesign.types import EventVolume, FlowField, FlowWindows

TOGETHER = 16  # windows judged at a time


@dataclass(frozen=True)
class Score:
    """Figures of one estimator on one set.

    Args:
      aee_px, zero_flow_px: mean endpoint error over all valid pixels, of the estimate and of zero
        flow.
      worse_percent: share of the windows on which the estimate's own mean error is above zero
        flow's.
      windows: how many were judged.
      blur: of a set without any true flow, the blur of its events warped by the estimate, as a
        share of that of zero flow (contrast_loss), which then stands for the errors; worse_percent
        counts windows where it is above 1. None where there is truth.
    """

    aee_px: float
    zero_flow_px: float
    worse_percent: float
    windows: int
    blur: float | None = None

    @property
    def ratio(self) -> float:
        """Error as a share of that of zero flow; blur where there is no truth."""
        return self.aee_px / self.zero_flow_px if self.blur is None else self.blur


def batches(source: Source, count: int) -> Iterator[FlowWindows]:
    """The first ``count`` windows of a source, or all of a shorter one, some at a time."""
    sized: Any = source
    if hasattr(source, "__len__"):
        count = min(count, len(sized))
    return (
        source.batch(range(first, min(first + TOGETHER, count)))
        for first in range(0, count, TOGETHER)
    )


@torch.no_grad()
def score(
    estimator: Callable[[EventVolume], FlowField],
    found: Iterable[FlowWindows],
    device: torch.device | None = None,
) -> Score:
    """Score of ``estimator`` on windows, computed on ``device``; where they are for None.

    Windows without a valid pixel count for nothing beside others that have some; by themselves they
    are judged by how sharp the estimate makes their events.
    """
    sums = torch.zeros(3, dtype=torch.float64)  # error, error of zero flow, pixels
    worse = judged = 0
    blurs = []
    for windows in found:
        windows = windows if device is None else to_device(windows, device)
        flow = estimator(windows.volume).flow_px
        truth = windows.truth.flow_px
        valid = windows.truth.valid
        pixels = valid.sum((1, 2)).double()
        error, zero = (
            torch.where(valid, endpoint_error(each, truth).double(), 0.0).sum((1, 2))
            for each in (flow, torch.zeros_like(truth))
        )
        sums += torch.stack([error.sum(), zero.sum(), pixels.sum()]).cpu()
        worse += int((error > zero).sum())
        judged += int((pixels > 0).sum())
        if not judged:
            blurs += [
                float(contrast_loss(replace(windows.volume, counts=counts[None]), one[None]))
                for counts, one in zip(
                    windows.volume.counts, flow.to(windows.volume.counts), strict=True
                )
            ]
    error, zero, pixels = sums.tolist()
    if not judged and not blurs:
        raise DomainError("there are no windows to judge on; give one at least.")
    if not judged:
        share = sum(blur > 1 for blur in blurs) / len(blurs)
        return Score(0.0, 0.0, 100 * share, len(blurs), sum(blurs) / len(blurs))
    if not zero > 0:
        raise DomainError(
            "the true flow of the validation windows is 0 everywhere, so no error can be a share of it; validate on "
            "windows that move."
        )
    return Score(error / pixels, zero / pixels, 100 * worse / judged, judged)


def error_ratio(source: Source, count: int = 48) -> Callable[[nn.Module], float]:
    """A judge for ``fit``: error of a flow network over that of zero flow, on the first ``count``
    windows of a source, which are made once."""
    windows = []

    def judge(network: nn.Module) -> float:
        if not windows:
            windows.extend(batches(source, count))
        return score(network, windows, next(network.parameters()).device).ratio

    return judge
