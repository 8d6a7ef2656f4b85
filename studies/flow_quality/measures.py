"""What is measured of an estimator on a set of windows: errors, how honest and how telling its
claims are, and how sharp it makes the events."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.stats import spearmanr

from codesign.flow.contrast import nearest_images, volume_tracks
from codesign.flow.metrics import endpoint_error
from codesign.types import EventVolume, FlowField, FlowWindows
from studies.frame.compare import ratio_of_means

SHARES = np.linspace(0, 0.95, 20)  # of the pixels left out of a sparsification curve
# of error over claimed deviation, when errors are Gaussian as claimed
HONEST_MEDIAN = np.log(2) ** 0.5
ELLIPSE = -2 * np.log(0.1)  # normalised square of two Gaussian errors that 90 % stay below
MUCH = 1.05  # error over that of zero flow from which on a window is worse than by chance
# windows without information give next to no flow, which loses by less every second time
MARGIN_PX = 0.05

Rows = dict[str, np.ndarray]
"""Of N windows: error_px, zero_px: [N] mean endpoint error over valid pixels of the estimate and of
zero flow.
claim, claim_median: [N] mean squared error over the trace of the claimed covariance, and median of
  its root.
normalised, within: [N] mean of half of e^T C^-1 e, and share of the pixels in the claimed ellipse
  of 90 %.
spearman, spearman_if_true: [N] rank correlation within a window of 1 - confidence with the error,
and with errors drawn from the claim. left, best: [N, len(SHARES)] mean error of the pixels left
when a share of them is taken out, least confident first, and largest error first. fwl, truth_fwl:
[N] by the estimate and by the true flow. NaN where nothing is claimed, the confidence is the same
everywhere, or no event is."""


def measure(field: FlowField, windows: FlowWindows) -> Rows:
    """Rows of a FlowField on FlowWindows; windows without a valid pixel are left out."""
    truth = windows.truth
    error = endpoint_error(field.flow_px, truth.flow_px).double()
    zero = truth.flow_px.double().norm(dim=1)
    confidence = torch.ones_like(error) if field.confidence is None else field.confidence.double()
    random = np.random.default_rng(0)
    rows = []
    for k in torch.arange(len(error))[truth.valid.flatten(1).any(1)].tolist():
        here = truth.valid[k]
        e = error[k][here].numpy()
        doubt = -confidence[k][here].numpy()
        row = {
            "error_px": e.mean(),
            "zero_px": float(zero[k][here].mean()),
            "spearman": spearman(doubt, e),
            "left": sparsified(e, doubt),
            "best": sparsified(e, e),
            "fwl": warp_loss(windows.volume, field.flow_px, k),
            "truth_fwl": warp_loss(windows.volume, truth.flow_px, k),
        }
        claimed = ("claim", "claim_median", "normalised", "within", "spearman_if_true")
        row |= dict.fromkeys(claimed, np.nan)
        if field.covariance_px2 is not None:
            miss = (field.flow_px - truth.flow_px)[k][:, here].double().numpy()
            row |= of_claim(miss, field.covariance_px2[k][:, here].double().numpy(), doubt, random)
        rows.append(row)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def of_claim(miss, covariance, doubt, random) -> dict[str, float]:
    """What errors [2, N] say of covariances [3, N] (xx, xy, yy), and errors drawn from these of
    doubts [N]."""
    x, y = miss
    xx, xy, yy = covariance
    square = (yy * x**2 - 2 * xy * x * y + xx * y**2) / (xx * yy - xy**2)
    claim = (x**2 + y**2) / (xx + yy)
    across = xy / np.sqrt(xx)
    one, other = random.standard_normal((2, len(xx)))
    drawn = np.hypot(
        np.sqrt(xx) * one, across * one + np.sqrt(np.maximum(yy - across**2, 0)) * other
    )
    return {
        "claim": claim.mean(),
        "claim_median": np.median(np.sqrt(claim)),
        "normalised": square.mean() / 2,
        "within": (square <= ELLIPSE).mean(),
        "spearman_if_true": spearman(doubt, drawn),
    }


def join(parts: Sequence[Rows]) -> Rows:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def figures(rows: Rows) -> dict[str, float]:
    """Figures of a set by their names in metrics.json; those that are not defined are left out."""
    error, zero = rows["error_px"], rows["zero_px"]
    ratio = ratio_of_means(error, zero)
    ours, best = curves(rows)
    found = {
        "ratio": ratio.value,
        "ratio_low": ratio.low,
        "ratio_high": ratio.high,
        "aee_px": error.mean(),
        "worse_percent": 100 * (error > zero).mean(),
        "much_worse_percent": 100 * (error > MUCH * zero).mean(),
        "worse_by_a_twentieth_px_percent": 100 * (error > zero + MARGIN_PX).mean(),
        "within_percent": 100 * rows["within"].mean(),
        "error_over_claimed": rows["claim"].mean() ** 0.5,
        "error_over_claimed_median": np.median(rows["claim_median"]) / HONEST_MEDIAN,
        "normalised_square": rows["normalised"].mean(),
        "rank_correlation": mean_of_known(rows["spearman"]),
        "rank_correlation_if_true": mean_of_known(rows["spearman_if_true"]),
        "ause": np.trapezoid(ours - best, SHARES),
        "sharpness": mean_of_known(rows["fwl"]),
    }
    return {name: value for name, value in found.items() if not np.isnan(value)}


def curves(rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Sparsification curves over SHARES, by confidence and by true error, relative to the error of
    all pixels; the area between them is AUSE (Ilg et al., ECCV 2018)."""
    whole = rows["left"][:, 0].mean()
    return rows["left"].mean(0) / whole, rows["best"].mean(0) / whole


def mean_of_known(values: np.ndarray) -> float:
    """Mean of what is finite; NaN without any."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def spearman(doubt, error) -> float:
    """Rank correlation (ties take their mean rank) of two lists; NaN where one is constant."""
    if len(error) < 2 or np.ptp(doubt) == 0 or np.ptp(error) == 0:
        return float("nan")
    return float(spearmanr(doubt, error).statistic)


def sparsified(error, doubt) -> np.ndarray:
    """Mean error [len(SHARES)] of the pixels that are left when the most doubtful share is taken
    out; pixels of equal doubt count with their mean error."""
    order = np.argsort(doubt, kind="stable")
    _, group, sizes = np.unique(doubt[order], return_inverse=True, return_counts=True)
    mean = np.bincount(group, error[order]) / sizes
    sums = np.cumsum(mean[group])
    kept = np.maximum(np.rint((1 - SHARES) * len(error)).astype(int), 1)
    return sums[kept - 1] / kept


def warp_loss(volume: EventVolume, flow_px, k: int) -> float:
    """FWL of sample k by the contents of its bins, each at its centroid (codesign.flow.metrics.fwl
    has it for streams); NaN where the unwarped image is even."""
    one = EventVolume(volume.counts[k : k + 1], volume.centroid_s, volume.collected_s)
    tracks = volume_tracks(one, flow_px[k : k + 1])
    still, moved = (
        float(nearest_images(tracks, time)[0].double().sum(1).var(correction=0))
        for time in (tracks.time, 1.0)
    )
    return moved / still if still > 0 else float("nan")
