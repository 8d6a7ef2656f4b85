"""What generated events are judged by: distance, number, rates over time, flicker, delay."""

import torch
import torch.nn.functional as F

from codesign import events
from studies.frame.compare import ratio_of_means

TAU_S = 0.01  # of the van Rossum distance, as in the thesis
BIN_S = 0.01  # of rates over time
CELL_PX = 8
BLOCK_PX = 16  # of the bootstrap
MEDIAN_PX = 5
LAGS_S = 0.03
# flicker is the power of the rate above; half of what the steps can show where that is less
HIGH_HZ = 50.0


def judge(pairs, resamples, seed):
    """Figures by name, numbers or Intervals, of pairs (counts [T-1, 2, H, W], Sequence with the
    target's); ON and OFF: the smaller one."""
    found, target = sides = [[x for x, _ in pairs], [sequence.counts for _, sequence in pairs]]
    dt_s = pairs[0][1].dt_s
    loss, rate = intervals(pairs, resamples, seed)
    ours, theirs = (sum(flicker(counts, dt_s) for counts in side) for side in sides)

    def correlated(side_px):
        return correlation(*([binned(x, dt_s, side_px) for x in side] for side in sides))

    return {
        "loss": loss,
        "rate_ratio": rate,
        "rate_correlation": correlated(None),
        "cell_correlation": correlated(CELL_PX),
        "flicker_ratio": ours / theirs,
        "delay_s": dt_s * delay(found, target, round(LAGS_S / dt_s)),
    }


def distance(pairs):
    """Van Rossum distance over that of silence, all sequences together."""
    found, silence, *_ = block_sums(pairs).sum(1).tolist()
    return found / silence


def intervals(pairs, resamples, seed):
    """``distance``, and events over the target's: Interval each, 95 %, blocks of pixels drawn
    again."""
    halves = block_sums(pairs).split(2)
    return [ratio_of_means(*half, draws=resamples, seed=seed) for half in halves]


def block_sums(pairs):
    """[4, blocks]: squared van Rossum responses of the error and of silence, events and those of
    the target."""
    sums = []
    for found, sequence in pairs:
        target = sequence.counts
        squares = [
            events.alpha_response(error, tau_s=TAU_S, dt=sequence.dt_s)[0].square()
            for error in (found - target, target)
        ]
        pictures = torch.stack([x.sum((0, 1)) for x in (*squares, found, target)])
        sums.append(F.avg_pool2d(pictures, BLOCK_PX).flatten(1) * BLOCK_PX**2)
    return torch.cat(sums, 1).double()


def binned(counts, dt_s, side_px=None):
    """Events per bin, polarity and cell, [bins, 2, h, w]; one cell is the whole picture when
    side_px is None. What fills no bin or cell is left out."""
    sums = _pictures(counts, dt_s)
    if side_px is None:
        return sums.sum((-2, -1), keepdim=True)
    return F.avg_pool2d(sums, side_px) * side_px**2


def _pictures(counts, dt_s):
    """Events per bin, [bins, 2, H, W]."""
    steps = max(1, round(BIN_S / dt_s))
    return counts[: len(counts) // steps * steps].unflatten(0, (-1, steps)).sum(1)


def filtered(counts, dt_s):
    """Pictures of one bin each behind a median of 5 x 5 px, [bins, 2, H, W]: lone events vanish,
    edges stay."""
    wide = F.pad(_pictures(counts, dt_s), (MEDIAN_PX // 2,) * 4, mode="replicate")
    return wide.unfold(2, MEDIAN_PX, 1).unfold(3, MEDIAN_PX, 1).flatten(-2).median(-1).values


def correlation(found, target):
    """Pearson's, of two lists [T, 2, ...]: the smaller one of ON and OFF."""
    return min(
        _pearson(*(torch.cat([x[:, polarity].flatten() for x in side]) for side in (found, target)))
        for polarity in (0, 1)
    )


def flicker(counts, dt_s):
    """Power of the whole-picture rates above HIGH_HZ, ON and OFF together."""
    rate = counts.sum((-2, -1)).double()
    # without a taper the drift of the rate leaks upwards
    taper = torch.hann_window(len(rate), dtype=torch.float64)[:, None]
    spectrum = torch.fft.rfft((rate - rate.mean(0)) * taper, dim=0).abs().square()
    return float(spectrum[torch.fft.rfftfreq(len(rate), dt_s) > min(HIGH_HZ, 0.25 / dt_s)].sum())


def delay(found, target, most):
    """Steps by which the events of cells come later than the target's, where they correlate
    best."""

    def aligned(lag):
        windows = slice(max(lag, 0), min(lag, 0) or None), slice(max(-lag, 0), min(-lag, 0) or None)
        sides = zip((found, target), windows, strict=True)
        return [
            torch.cat([F.avg_pool2d(x[at], CELL_PX).flatten() for x in side]) for side, at in sides
        ]

    return max(range(-most, most + 1), key=lambda lag: _pearson(*aligned(lag)))


def _pearson(first, second):
    """Pearson's correlation; 0 when one side is constant."""
    first, second = (side.double() - side.double().mean() for side in (first, second))
    norm = float(first.norm() * second.norm())
    return float(first @ second) / norm if norm > 0 else 0.0
