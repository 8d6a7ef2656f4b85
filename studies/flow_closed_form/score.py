"""What the flow studies measure: endpoint errors per sample, their ratio to zero flow with an interval, and
how well a covariance says how large errors are."""

from dataclasses import dataclass

import numpy as np
import torch

from codesign.types import EventVolume

BATCH = 32


@dataclass(frozen=True)
class Score:
    """Per sample [N]: error_px and zero_px (mean endpoint error of the estimate and of zero flow), normalised
    (mean squared error over its own covariance, per component)."""

    error_px: np.ndarray
    zero_px: np.ndarray
    normalised: np.ndarray | None

    @property
    def ratio(self):
        return float(self.error_px.mean() / self.zero_px.mean())

    @property
    def worse_percent(self):
        return float(100 * (self.error_px > self.zero_px).mean())

    def worse_by_percent(self, margin_px):
        return float(100 * (self.error_px > self.zero_px + margin_px).mean())

    def ratio_interval(self, seed, draws=1000):
        """95 % interval of the ratio: bootstrap over samples."""
        pick = np.random.default_rng(seed).integers(0, len(self.error_px), (draws, len(self.error_px)))
        ratios = self.error_px[pick].mean(1) / self.zero_px[pick].mean(1)
        return tuple(float(q) for q in np.quantile(ratios, (0.025, 0.975)))


def score(estimator, windows):
    """Score of an estimator on a FlowWindows."""
    errors = []
    zeros = []
    normalised = []
    for first in range(0, len(windows.truth.flow_px), BATCH):
        part = slice(first, first + BATCH)
        volume = EventVolume(
            windows.volume.counts[part], windows.volume.centroid_s, windows.volume.collected_s
        )
        truth = windows.truth.flow_px[part]
        with torch.no_grad():
            field = estimator(volume)
        errors.append((field.flow_px - truth).norm(dim=1).mean((1, 2)))
        zeros.append(truth.norm(dim=1).mean((1, 2)))
        if field.covariance_px2 is not None:
            normalised.append(normalised_square(field, truth).mean((1, 2)))
    return Score(
        torch.cat(errors).numpy(),
        torch.cat(zeros).numpy(),
        torch.cat(normalised).numpy() if normalised else None,
    )


def normalised_square(field, truth_px):
    """Half of e^T C^-1 e per pixel [B, H, W], e the error and C its covariance: 1 on average when the
    covariance is right."""
    ex, ey = (field.flow_px - truth_px).unbind(1)
    xx, xy, yy = field.covariance_px2.unbind(1)
    return (yy * ex * ex - 2 * xy * ex * ey + xx * ey * ey) / (2 * (xx * yy - xy * xy))


def join(parts):
    """One Score of several."""
    normalised = [part.normalised for part in parts]
    return Score(
        np.concatenate([part.error_px for part in parts]),
        np.concatenate([part.zero_px for part in parts]),
        None if any(n is None for n in normalised) else np.concatenate(normalised),
    )
