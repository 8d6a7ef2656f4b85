"""The models that are compared, and their figures against recorded counts."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from codesign import events
from studies.davis_fit import score
from studies.davis_fit.score import Interval
from studies.davis_fit.search import naive_counts

PUBLISHED_THETA = 0.2
V2E_DEFAULT = events.SensorModel(
    theta_sigma=0.03, cutoff_hz=300.0, leak_rate_hz=0.01, shot_rate_hz=0.001, refractory_s=0.0005
)  # of its command line
POOLING_PX = (1, 2, 4)
LABELS = {
    "naive": "naive, θ 0.2",
    "naive_fitted": "naive, fitted",
    "naive_shape": "naive, fitted to shape alone",
    "unfitted": "memory, θ 0.2, unfitted",
    "v2e": "v2e's default sensor",
    "fitted": "memory, fitted",
    "naive_fitted_moved": "naive, fitted, moved frames",
    "naive_shape_moved": "naive, fitted to shape alone, moved frames",
    "unfitted_moved": "memory, unfitted, moved frames",
    "fitted_moved": "memory, fitted, moved frames",
}


@dataclass(frozen=True)
class Figures:
    """How close one model comes to the recording on one half.

    correlation: Interval by pooling (px). ratio: Intervals of simulated over recorded events, ON and OFF.
      by_interval: [T] correlation at 1 px.
    ratio_by_interval: [T, 2] rate ratios, ON first. rate_factor: exp of the root mean square log of these:
      1.2 is 20 % off in a typical interval.
    slope: simulated over recorded signed counts where many fire, by least squares on squares of 4 px: 1 when
      strong changes have the right number.
    by_polarity: correlation of ON counts and OFF counts, each for itself, at 1 px.
    draws: correlation at 1 px of every bootstrap draw, the same blocks for every model.
    """

    correlation: dict[int, Interval]
    ratio: tuple[Interval, Interval]
    by_interval: list[float]
    ratio_by_interval: Tensor
    rate_factor: float
    slope: float
    by_polarity: float
    draws: Tensor


def simulate_all(recording, clips, sensors, naives, generator):
    """Counts of every model over the whole recording.

    Args:
      clips: Clip by name ("frames", "moved"). sensors: FittedSensor by the same names. naives: what
        ``scan_naive`` returns, by the same names.
    Returns: counts [T-1, 2, H, W] by model name, in the order of LABELS.
    """
    found = {}
    for name, clip in clips.items():
        end = "_moved" if name == "moved" else ""
        pack = clip.sharp, clip.step_s, clip.per_interval
        if not end:
            found["naive"] = naive_counts(*pack, PUBLISHED_THETA)
            found["v2e"] = events.to_counts(
                events.simulate(clip.sharp, recording.mid_s, V2E_DEFAULT, generator), recording.mid_s
            )
        for kind, (theta, dark_offset) in naives[name].items():
            found[f"naive_{kind}{end}"] = naive_counts(*pack, theta, dark_offset)
        counts, _ = events.memory(clip.sharp, PUBLISHED_THETA, PUBLISHED_THETA)
        found["unfitted" + end] = counts.unflatten(0, (-1, clip.per_interval)).sum(1)
        found["fitted" + end] = sensors[name].draw(clip, generator)
    return {name: found[name] for name in LABELS if name in found}


def judge(simulated, recorded, resamples, seed):
    """Figures of simulated against recorded counts, both [T, 2, H, W]; intervals from bootstrap over blocks
    of pixels."""
    weights = {}

    def weights_of(blocks):
        if blocks not in weights:
            weights[blocks] = score.draws(blocks, resamples, torch.Generator().manual_seed(seed))
        return weights[blocks]

    draws = {
        side_px: score.correlation_draws(simulated, recorded, side_px, weights_of) for side_px in POOLING_PX
    }
    on, off = (score.interval(ratio) for ratio in score.ratio_draws(simulated, recorded, weights_of))
    ratios = (simulated.double().sum((2, 3)) + 1) / (
        recorded.double().sum((2, 3)) + 1
    )  # one more, so that a silent interval has a ratio
    by_interval = [
        score.correlation(score.signed(a), score.signed(b))
        for a, b in zip(simulated.split(1), recorded.split(1), strict=True)
    ]
    found, truth = (
        score.pooled(score.signed(counts), POOLING_PX[-1]).double() for counts in (simulated, recorded)
    )
    slope = float((found * truth).sum() / truth.square().sum().clamp(min=1))
    factor = math.exp(float(ratios.log().square().mean().sqrt()))
    return Figures(
        {side_px: score.interval(row) for side_px, row in draws.items()},
        (on, off),
        by_interval,
        ratios,
        factor,
        slope,
        score.correlation(simulated, recorded),
        draws[1],
    )


def flat(name, fold, figures):
    """Entries of metrics.json for one model on one half."""
    start = f"{name}_on_{fold.judged}_half"
    found = {}
    for side_px, value in figures.correlation.items():
        found |= _ends(f"{start}_correlation_{side_px}px", value)
    for polarity, value in zip(("on", "off"), figures.ratio, strict=True):
        found |= _ends(f"{start}_ratio_{polarity}", value)
    for k, (value, ratios) in enumerate(
        zip(figures.by_interval, figures.ratio_by_interval.tolist(), strict=True), start=fold.test.start
    ):
        found |= {
            f"{start}_interval_{k}_correlation_1px": value,
            f"{start}_interval_{k}_ratio_on": ratios[0],
            f"{start}_interval_{k}_ratio_off": ratios[1],
        }
    return found | {
        f"{start}_rate_factor": figures.rate_factor,
        f"{start}_slope_4px": figures.slope,
        f"{start}_by_polarity_correlation_1px": figures.by_polarity,
    }


def _ends(name, interval):
    return {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}
