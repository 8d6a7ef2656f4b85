"""What is measured of an estimator on a set of windows: errors, how honest and how telling its claims are, and
how sharp it makes the events."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.stats import rankdata

from codesign.flow.contrast import nearest_images, volume_tracks
from codesign.flow.metrics import endpoint_error

SHARES = np.linspace(0, 0.95, 20)  # of the pixels left out of a sparsification curve
HONEST_MEDIAN = np.log(2) ** 0.5  # of error over claimed deviation, when errors are Gaussian as claimed
DRAWS = 2000  # of the bootstrap
ELLIPSE = -2 * np.log(0.1)  # normalised square of two Gaussian errors that 90 % stay below
MUCH = 1.05  # error over that of zero flow from which on a window is worse than by chance


@dataclass(frozen=True)
class Measured:
    """Figures of N windows.

    error_px, zero_px: [N] mean endpoint error over valid pixels of the estimate and of zero flow.
    claim: [N] mean squared error over the trace of the claimed covariance; claim_median: [N] median of its
      root; NaN where nothing is claimed. spearman: [N] rank correlation of 1 - confidence with the error
      over the pixels of a window, NaN where the confidence is the same everywhere; spearman_if_true: [N] with errors
      drawn from the claimed covariance in place of the true ones.
    left, best: [N, len(SHARES)] mean error of the pixels left when a share of them is taken out, least
      confident first, and largest error first. fwl, truth_fwl: [N] variance of the image of warped events
      over the unwarped one's, by the estimate and by the true flow, NaN for windows without events.
    within: [N] share of the pixels whose error lies in the claimed ellipse of 90 %; NaN where nothing is claimed.
    """

    error_px: np.ndarray
    zero_px: np.ndarray
    claim: np.ndarray
    claim_median: np.ndarray
    spearman: np.ndarray
    spearman_if_true: np.ndarray
    left: np.ndarray
    best: np.ndarray
    fwl: np.ndarray
    truth_fwl: np.ndarray
    within: np.ndarray

    @property
    def ratio(self) -> float:
        """Error over that of zero flow."""
        return float(self.error_px.mean() / self.zero_px.mean())

    def ratio_interval(self, seed: int = 0) -> tuple[float, float]:
        """95 % interval of the ratio, by bootstrap over windows."""
        pick = np.random.default_rng(seed).integers(0, len(self.error_px), (DRAWS, len(self.error_px)))
        ratios = self.error_px[pick].mean(1) / self.zero_px[pick].mean(1)
        low, high = np.quantile(ratios, (0.025, 0.975))
        return float(low), float(high)

    @property
    def worse_percent(self) -> float:
        """Share of windows with a larger error than zero flow's."""
        return float(100 * (self.error_px > self.zero_px).mean())

    @property
    def much_worse_percent(self) -> float:
        """Share of windows with an error above 1.05 times zero flow's."""
        return float(100 * (self.error_px > MUCH * self.zero_px).mean())

    @property
    def within_percent(self) -> float | None:
        """Share of the pixels in their claimed ellipses of 90 %."""
        return None if np.isnan(self.within).any() else float(100 * self.within.mean())

    @property
    def error_over_claimed(self) -> float | None:
        """Root mean square of error over claimed deviation; 1 for an honest claim."""
        return None if np.isnan(self.claim).any() else float(self.claim.mean() ** 0.5)

    @property
    def error_over_claimed_median(self) -> float | None:
        """Median over windows of the median over pixels, over what it is for Gaussian errors alike in all
        directions; a few bad windows do not count."""
        return (
            None if np.isnan(self.claim_median).any() else float(np.median(self.claim_median) / HONEST_MEDIAN)
        )

    @property
    def rank_correlation(self) -> float | None:
        """Mean of ``spearman`` over the windows that have one; None without any."""
        known = self.spearman[np.isfinite(self.spearman)]
        return float(known.mean()) if len(known) else None

    @property
    def rank_correlation_if_true(self) -> float | None:
        """The same of ``spearman_if_true``: what claims reach that are right."""
        known = self.spearman_if_true[np.isfinite(self.spearman_if_true)]
        return float(known.mean()) if len(known) else None

    @property
    def curves(self) -> tuple[np.ndarray, np.ndarray]:
        """Sparsification curves over SHARES, by confidence and by true error, relative to the error of all
        pixels."""
        whole = self.left[:, 0].mean()
        return self.left.mean(0) / whole, self.best.mean(0) / whole

    @property
    def ause(self) -> float:
        """Area between the two curves (Ilg et al., ECCV 2018); 0 for a confidence that ranks all errors
        rightly."""
        ours, best = self.curves
        return float(np.trapezoid(ours - best, SHARES))

    @property
    def sharpness(self) -> float | None:
        """Mean FWL over the windows with events; None without any."""
        known = self.fwl[np.isfinite(self.fwl)]
        return float(known.mean()) if len(known) else None


def measure(field, windows) -> Measured:
    """Measured of a FlowField on FlowWindows; windows without a valid pixel are left out."""
    truth = windows.truth
    valid = truth.valid
    error = endpoint_error(field.flow_px, truth.flow_px).double()
    zero = truth.flow_px.double().norm(dim=1)
    confidence = field.confidence if field.confidence is not None else torch.ones_like(error)
    claim = None
    drawn = np.random.default_rng(0)
    if field.covariance_px2 is not None:
        claim = error.square() / (field.covariance_px2[:, 0] + field.covariance_px2[:, 2]).double()
    rows = []
    for k in torch.arange(len(valid))[valid.flatten(1).any(1)].tolist():
        here = valid[k]
        e = error[k][here].numpy()
        doubt = -confidence[k][here].double().numpy()
        c = np.full(1, np.nan) if claim is None else claim[k][here].numpy()
        as_claimed = np.ones(1) if claim is None else _drawn(field.covariance_px2[k][:, here], drawn)
        rows.append(
            (
                e.mean(),
                float(zero[k][here].mean()),
                c.mean(),
                np.median(np.sqrt(c)),
                spearman(doubt, e),
                spearman(doubt[: len(as_claimed)], as_claimed),
                sparsified(e, doubt),
                sparsified(e, e),
                warp_loss(windows.volume, field.flow_px, k),
                warp_loss(windows.volume, truth.flow_px, k),
                np.nan if claim is None else within(field, truth, k),
            )
        )
    return Measured(*(np.array(column) for column in zip(*rows, strict=True)))


def within(field, truth, k) -> float:
    """Share of the valid pixels of sample k whose error lies in the claimed ellipse of 90 %."""
    here = truth.valid[k]
    x, y = (field.flow_px - truth.flow_px)[k][:, here].double().numpy()
    xx, xy, yy = field.covariance_px2[k][:, here].double().numpy()
    square = yy * x**2 - 2 * xy * x * y + xx * y**2
    return float((square <= ELLIPSE * (xx * yy - xy**2)).mean())


def _drawn(covariance, random):
    """Lengths [N] of errors drawn from covariances [3, N] (xx, xy, yy)."""
    xx, xy, yy = covariance.double().numpy()
    across = xy / np.sqrt(xx)
    one, other = random.standard_normal((2, len(xx)))
    return np.hypot(np.sqrt(xx) * one, across * one + np.sqrt(np.maximum(yy - across**2, 0)) * other)


def join(parts) -> Measured:
    """One Measured of those of several batches."""
    names = Measured.__dataclass_fields__
    return Measured(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def spearman(doubt, error) -> float:
    """Rank correlation (ties take their mean rank) of two lists; NaN where one is constant."""
    if len(error) < 2 or np.ptp(doubt) == 0 or np.ptp(error) == 0:
        return float("nan")
    return float(np.corrcoef(rankdata(doubt), rankdata(error))[0, 1])


def sparsified(error, doubt) -> np.ndarray:
    """Mean error [len(SHARES)] of the pixels that are left when the most doubtful share is taken out; pixels
    of equal doubt count with their mean error."""
    order = np.argsort(doubt, kind="stable")
    _, group, sizes = np.unique(doubt[order], return_inverse=True, return_counts=True)
    mean = np.bincount(group, error[order]) / sizes
    sums = np.cumsum(mean[group])
    kept = np.maximum(np.rint((1 - SHARES) * len(error)).astype(int), 1)
    return sums[kept - 1] / kept


def warp_loss(volume, flow_px, k) -> float:
    """FWL of sample k by the contents of its bins, each at its centroid (codesign.flow.metrics.fwl has it for
    streams); NaN where the unwarped image is even."""
    one = type(volume)(volume.counts[k : k + 1], volume.centroid_s, volume.collected_s)
    tracks = volume_tracks(one, flow_px[k : k + 1])
    still, moved = (
        float(nearest_images(tracks, time)[0].double().sum(1).var(correction=0))
        for time in (tracks.time, 1.0)
    )
    return moved / still if still > 0 else float("nan")
