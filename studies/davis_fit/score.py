"""How close simulated counts are to recorded ones: correlations, rate ratios, and their bootstrap intervals
over blocks of pixels."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F

from codesign.errors import DomainError, ShapeError

# wider than the motion blur, a multiple of every pooling; neighbouring pixels err together, blocks hardly
BLOCK_PX = 20


@dataclass(frozen=True)
class Interval:
    """A figure and the ends of its 95 % bootstrap interval."""

    value: float
    low: float
    high: float

    def __str__(self):
        return f"{self.value:.3f} ({self.low:.3f} to {self.high:.3f})"


def pooled(counts, side_px):
    """Counts summed over squares of pixels; rows and columns that fill no square are left out at the far
    edges. counts: [..., H, W]."""
    if side_px < 1 or min(counts.shape[-2:]) < side_px:
        raise DomainError(
            f"pooling squares of {side_px} px do not fit into {list(counts.shape[-2:])} pixels; choose 1 px "
            "or more, up to the shorter side."
        )
    return F.avg_pool2d(counts.flatten(0, -3), side_px).unflatten(0, counts.shape[:-2]) * side_px**2


def signed(counts):
    """ON minus OFF: [T, 2, H, W] to [T, H, W]."""
    return counts[:, 0] - counts[:, 1]


def correlation(first, second):
    """Pearson's correlation of two tensors of one shape, all entries together; 0 when one of them is
    constant."""
    if first.shape != second.shape:
        raise ShapeError(
            f"maps of shapes {list(first.shape)} and {list(second.shape)} cannot be correlated; give the "
            "same intervals and pixels."
        )
    return float(_correlation(_moments(first.double(), second.double()).flatten(1).sum(1)))


def block_sums(values, block_px):
    """Sums over blocks of pixels, the last ones cut by the edge. values: [..., H, W]; returns [...,
    blocks]."""
    height, width = values.shape[-2:]
    wide = F.pad(values, (0, -width % block_px, 0, -height % block_px))
    return (
        F.avg_pool2d(wide.flatten(0, -3), block_px).flatten(1).unflatten(0, values.shape[:-2]) * block_px**2
    )


def draws(blocks, resamples, generator):
    """How often each block is taken: [resamples, blocks] whole numbers, each row summing to ``blocks``; first
    row all 1 (the recording itself)."""
    chosen = torch.randint(blocks, (resamples, blocks), generator=generator)
    weights = torch.zeros(resamples, blocks, dtype=torch.float64).scatter_add_(
        1, chosen, torch.ones(resamples, blocks, dtype=torch.float64)
    )
    return torch.cat((torch.ones(1, blocks, dtype=torch.float64), weights))


def correlation_draws(simulated, recorded, side_px, weights_of):
    """Signed-count correlation of every bootstrap draw.

    Args: simulated, recorded: [T, 2, H, W]. side_px: pooling. weights_of: function from a number of blocks to
      weights (``draws``).
    Returns: [1 + resamples]; the first is the value itself.
    """
    maps = (pooled(signed(counts), side_px).double() for counts in (simulated, recorded))
    sums = block_sums(_moments(*maps), BLOCK_PX // side_px).sum(1)  # [6, blocks]
    return _correlation(sums @ weights_of(sums.shape[-1]).T)


def ratio_draws(simulated, recorded, weights_of):
    """Simulated over recorded events of every bootstrap draw: [2, 1 + resamples], ON first. Raises:
    DomainError when nothing was recorded."""
    sums = torch.stack(
        [block_sums(counts.double().sum(0), BLOCK_PX) for counts in (simulated, recorded)]
    )  # [2, 2, blocks]
    if bool((sums[1].sum(-1) == 0).any()):
        raise DomainError(
            "no event of one polarity was recorded in these intervals; a rate ratio needs some on either "
            "side."
        )
    totals = sums @ weights_of(sums.shape[-1]).T
    return totals[0] / totals[1]


def interval(draws):
    """Interval of bootstrap draws [1 + resamples], of which the first is the value itself."""
    low, high = torch.quantile(draws[1:], torch.tensor([0.025, 0.975], dtype=draws.dtype)).tolist()
    return Interval(float(draws[0]), low, high)


def _moments(first, second):
    """The six sums that a correlation needs, entry by entry: [6, ...]."""
    return torch.stack(
        (torch.ones_like(first), first, second, first.square(), second.square(), first * second)
    )


def _correlation(moments):
    """Correlation from the six sums [6, ...]."""
    n, a, b, aa, bb, ab = moments
    spread = ((n * aa - a * a) * (n * bb - b * b)).clamp(min=0).sqrt()
    return torch.where(spread > 0, (n * ab - a * b) / spread.clamp(min=torch.finfo(spread.dtype).tiny), 0.0)
