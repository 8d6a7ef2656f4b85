"""What generated events are judged by: distance, rates, flicker, delay, patches, median filter; with
bootstrap intervals over blocks of pixels."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from codesign import events
from studies.spike_esim.data import Sequence
from studies.spike_esim.train import TAU_S

BIN_S = 0.01  # of rates over time
CELL_PX = 8
BLOCK_PX = 16  # of the bootstrap
HIGH_HZ = 50.0  # flicker is the power of the rate above; half of what the steps can show where that is less
MEDIAN_PX = 5
LAGS_S = 0.03


@dataclass(frozen=True)
class Interval:
    """A figure and the ends of its 95 % bootstrap interval."""

    value: float
    low: float
    high: float

    def __str__(self):
        return f"{self.value:.3f} ({self.low:.3f} to {self.high:.3f})"


@dataclass(frozen=True)
class Pair:
    """Generated counts beside those of the target, [T-1, 2, H, W] both."""

    found: Tensor
    sequence: Sequence


def draws(blocks, resamples, generator):
    """How often each block is taken: [1 + resamples, blocks] whole numbers, each row summing to ``blocks``;
    first row all 1 (the recording itself)."""
    chosen = torch.randint(blocks, (resamples, blocks), generator=generator)
    weights = torch.zeros(resamples, blocks, dtype=torch.float64)
    weights.scatter_add_(1, chosen, torch.ones_like(weights))
    return torch.cat((torch.ones(1, blocks, dtype=torch.float64), weights))


def interval(draws):
    """Interval of bootstrap draws [1 + resamples], of which the first is the value itself."""
    low, high = torch.quantile(draws[1:], torch.tensor([0.025, 0.975], dtype=draws.dtype)).tolist()
    return Interval(float(draws[0]), low, high)


def block_losses(found, target, dt_s):
    """Van Rossum loss per block of BLOCK_PX pixels: [blocks]."""
    response, _ = events.alpha_response(found - target, tau_s=TAU_S, dt=dt_s)
    return _blocks(response.square().sum((0, 1)) * (dt_s / 2))


def losses(pairs, resamples, seed):
    """Van Rossum loss over that of silence, all sequences together, and total rate over the target's:
    Interval each (95 %, blocks of pixels redrawn)."""
    found, silence, made, wanted = (
        torch.cat(parts).double() for parts in zip(*(_sums(pair) for pair in pairs), strict=True)
    )
    weights = draws(len(found), resamples, torch.Generator().manual_seed(seed))

    def share(a, b):
        return interval((weights @ a) / (weights @ b))

    return share(found, silence), share(made, wanted)


def rate_correlation(pairs, side_px=None):
    """Correlation with the target's rates in bins of 10 ms, ON and OFF: of whole pictures over time, or of
    cells of ``side_px``; all sequences together."""
    found, target = (
        [binned(counts, pair.sequence.dt_s, side_px) for pair, counts in zip(pairs, which, strict=True)]
        for which in _both(pairs)
    )
    return [
        _correlation(
            torch.cat([x[:, p].flatten() for x in found]), torch.cat([x[:, p].flatten() for x in target])
        )
        for p in (0, 1)
    ]


def binned(counts, dt_s, side_px=None):
    """Events per bin, polarity and cell, [bins, 2, h, w]; one cell is the whole picture when side_px is None.
    What fills no bin or cell is left out."""
    steps = max(1, round(BIN_S / dt_s))
    sums = counts[: len(counts) // steps * steps].unflatten(0, (-1, steps)).sum(1)
    return sums.sum((-2, -1), keepdim=True) if side_px is None else F.avg_pool2d(sums, side_px) * side_px**2


def flicker(pairs):
    """Power of the whole-picture rates above HIGH_HZ over the target's, ON and OFF together."""
    power = []
    for which in _both(pairs):
        total = 0.0
        for pair, counts in zip(pairs, which, strict=True):
            rate = counts.sum((-2, -1)).double()
            # without a taper the drift of the rate leaks upwards
            taper = torch.hann_window(len(rate), dtype=torch.float64)[:, None]
            spectrum = torch.fft.rfft((rate - rate.mean(0)) * taper, dim=0).abs().square()
            frequency_hz = torch.fft.rfftfreq(len(rate), pair.sequence.dt_s)
            total += float(spectrum[frequency_hz > min(HIGH_HZ, 0.25 / pair.sequence.dt_s)].sum())
        power.append(total)
    return power[0] / power[1]


def delay_s(pairs):
    """By how much generated events come later than the target's, seconds: the shift at which rates of 8x8
    cells correlate best."""
    dt_s = pairs[0].sequence.dt_s
    most = round(LAGS_S / dt_s)
    scores = []
    cells = [
        tuple(F.avg_pool2d(counts, CELL_PX) for counts in (pair.found, pair.sequence.counts))
        for pair in pairs
    ]
    for lag in range(-most, most + 1):
        ahead = slice(max(lag, 0), min(lag, 0) or None)
        behind = slice(max(-lag, 0), min(-lag, 0) or None)
        scores.append(
            _correlation(
                *(
                    torch.cat([pair[k][window].flatten() for pair in cells])
                    for k, window in ((0, ahead), (1, behind))
                )
            )
        )
    return (scores.index(max(scores)) - most) * dt_s


def median_filtered(counts, dt_s):
    """Event pictures of 10 ms behind a 5x5 median: lone events vanish, edges stay. [bins, 2, H, W]."""
    steps = max(1, round(BIN_S / dt_s))
    pictures = counts[: len(counts) // steps * steps].unflatten(0, (-1, steps)).sum(1)
    edge = MEDIAN_PX // 2
    wide = F.pad(pictures, (edge,) * 4, mode="replicate")
    return torch.stack(
        [
            picture.unfold(1, MEDIAN_PX, 1).unfold(2, MEDIAN_PX, 1).flatten(-2).median(-1).values
            for picture in wide
        ]
    )


def median_scores(pairs):
    """Behind the median filter: total over the target's, and the smaller of the correlations ON and OFF of
    whole-picture rates."""
    found, target = (
        [
            median_filtered(counts, pair.sequence.dt_s).sum((-2, -1))
            for pair, counts in zip(pairs, which, strict=True)
        ]
        for which in _both(pairs)
    )
    found = torch.cat(found)
    target = torch.cat(target)
    return float(found.sum() / target.sum()), min(_correlation(found[:, p], target[:, p]) for p in (0, 1))


def patch_correlation(pairs, count, generator):
    """Median correlation of the rates (both polarities one after the other, 10 ms) in ``count`` random 8x8
    patches per sequence that the target has events in."""
    values = []
    for pair in pairs:
        cells = [
            binned(counts, pair.sequence.dt_s, CELL_PX).flatten(2)
            for counts in (pair.found, pair.sequence.counts)
        ]
        for place in torch.randperm(cells[0].shape[-1], generator=generator)[:count].tolist():
            found, target = (x[:, :, place].flatten() for x in cells)
            if float(target.std()) > 0:
                values.append(_correlation(found, target))
    return float(torch.tensor(values).median())


def _sums(pair):
    target = pair.sequence.counts
    dt_s = pair.sequence.dt_s
    found = block_losses(pair.found, target, dt_s), block_losses(torch.zeros_like(target), target, dt_s)
    return *found, _blocks(pair.found.sum((0, 1))), _blocks(target.sum((0, 1)))


def _blocks(picture):
    return (F.avg_pool2d(picture[None], BLOCK_PX) * BLOCK_PX**2).flatten()


def _both(pairs):
    return [pair.found for pair in pairs], [pair.sequence.counts for pair in pairs]


def _correlation(first, second):
    """Pearson's correlation; 0 when one side is constant."""
    first = first.double() - first.double().mean()
    second = second.double() - second.double().mean()
    norm = float(first.norm() * second.norm())
    return float(first @ second) / norm if norm > 0 else 0.0
