"""One scale of the closed form: the blurred volume on its own grid, and what it says about the
parameters of a field.

Noise. Events scattered at random, rho per pixel and window, put into a volume blurred by a Gaussian
of sigma
- temporal slopes of variance rho / (sum w t^2) / (4 pi sigma^2), w the share of the window in a bin
  and t its time, and
- slopes of the mean of variance kappa rho, about rho / (8 pi sigma^4), which look like texture and
  are none. The first sets how much the pull of the data can be trusted; how far real events are
  from Poisson is read off the residual. The second is an error in the regressors (Fuller,
  Measurement Error Models, 1987): with N = sum g g^T the normal matrix of the slopes seen and Z
  what scattered events alone would add to it, a direction of the parameters in which Z makes up the
  share z counts by (1 - z)^4 / ((1 - z)^4 + (3 z)^4): nearly 1 for texture, 1/82 where all is
  noise.
"""

import math
from functools import lru_cache

import torch
from torch import Tensor, bmm
from torch.nn.functional import pad

from codesign.flow.lk.blur import blurred, pooled
from codesign.flow.lk.lanes import Grid, in_graph, plain_wanted
from codesign.flow.lk.path import Path, even, path
from codesign.flow.lk.polynomials import Moments, Polynomials
from codesign.flow.lk.slopes import sums_along
from codesign.flow.lk.warp import moving
from codesign.types import EventVolume

# the factor 3 and the power 4 = 2^2 above
DOUBT = 3.0
DOUBLINGS = 2
# worth of Poisson noise the measured noise starts from: some events alone fit any field
FEW_EVENTS = 10.0
OVERLAP = 4 * math.pi  # blurred white noise is alike over 4 pi sigma^2 pixels
# for what makes errors larger than that: bins share events, thresholds quantise, fields warp
# imperfectly (docs/flow_closed_form.md)
CALIBRATION = 1.7
# of the mean diagonal: above the rounding of sums in float32
RIDGE = 1e-5
# of hot pixels, the factor 4 and m: they take 0.05 % off the events of moving textures at most
LONELY = 4.0
HOT_EVENTS = 5.0
# px, of the surroundings
SIDE = 5
TINY = 2.0**-100  # keeps empty samples solvable, far below a millionth of an event


def stride(sigma_px: float, shortest_px: int = 2**30) -> int:
    """Spacing of a level's grid, px: the largest power of two up to sigma, at least 1, at most 8,
    of which two fit into the shorter side."""
    return 2 ** math.floor(math.log2(max(min(sigma_px, shortest_px / 2, 8.0), 1.0)))


def weighed_down(counts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Counts by what their pixels count: hot pixels are weighed down.

    A pixel counts by k = 1 / (1 + e^2), e = max(0, n - 4 q - m) / (q + m): n events of the pixel, q
    the mean of the 24 pixels around it, m = 5 events. Moving texture puts events on several pixels;
    a hot pixel has them alone.

    Args:
      counts: [B, 2, n, H, W].
    Returns: ON less OFF [B, n, H, W], events of both signs and all bins [B, H, W], both weighed,
      and the weights [B, H, W].
    Gradient: counts.
    """
    events = counts.sum((1, 2))
    pixels = _boxes(torch.ones_like(events[:1, :, :1])) * _boxes(torch.ones_like(events[:1, :1]))
    # relu: no slope where the surroundings have no event
    around = torch.relu(_boxes(events) - events) / (pixels - 1)
    excess = torch.relu(events - LONELY * around - HOT_EVENTS) / (around + HOT_EVENTS)
    weights = 1 / (1 + excess.square())
    return _signed(counts, weights), weights * events, weights


def _signed(counts, weights):
    """Weights [B, H, W] times ON less OFF [B, n, H, W]."""
    if plain_wanted():
        return weights[:, None] * (counts[:, 0] - counts[:, 1])
    return in_graph(_weighed, _weighed_back, (), counts, weights)[0]


def _weighed(counts, weights):
    signed = counts[:, 0] - counts[:, 1]
    if not (counts.requires_grad or weights.requires_grad):
        return [signed.mul_(weights[:, None])], ()
    return [weights[:, None] * signed], [signed]


def _weighed_back(counts, weights, signed, grads, wanted):
    """In few passes over memory: whole images of all bins are larger than what is near."""
    by_counts = torch.empty_like(counts)
    torch.mul(grads[0], weights[:, None], out=by_counts[:, 0])
    torch.neg(by_counts[:, 0], out=by_counts[:, 1])
    return by_counts, (grads[0] * signed).sum(1)


def _boxes(images):
    """Sums over the 5 x 5 pixels around each of [B, H, W], or as many of them as there are."""
    # shifted images and their sum: pooling one channel takes seven times as long
    around = pad(images, (SIDE // 2,) * 4)
    for along in (2, 1):
        size = around.shape[along] - SIDE + 1
        around = sum(around.narrow(along, k, size) for k in range(SIDE))
    return around


def along_path(volume: EventVolume, clock: str) -> tuple[Path, Tensor, Tensor]:
    """The way of the samples, weight and time of the bins [2, n], events of both signs per pixel
    [B, H, W]; hot pixels weighed down.

    clock: "time", "events", or "turn": events, with one turn of any speed. Weights are the shares
      of the interval; time is 0 at mid-interval, in intervals.
    """
    counts = volume.counts
    span = volume.collected_s.sum()
    weight = (volume.collected_s / span).to(counts)
    time = (volume.centroid_s / span).to(counts) - 0.5
    signed, density, kept = weighed_down(counts)
    if clock == "time":
        found = even(signed, weight, time)
    else:
        events = (counts.sum(1).flatten(2) @ kept.flatten(1)[:, :, None])[..., 0]  # of each bin
        found = path(signed, events, weight, time, clock == "turn")
    return found, torch.stack([weight, time]), density


class Level:
    """The volume blurred by a Gaussian of sigma_px, sampled at the centres of squares of ``stride``
    x ``stride`` pixels."""

    def __init__(
        self,
        way: Path,
        bins: Tensor,
        density: Tensor,
        shape: Polynomials,
        sigma_px: float,
        noise_floor: float,
    ) -> None:
        self.sigma = sigma_px
        self.shape = shape
        self.noise_floor = noise_floor
        self.stride = stride(sigma_px, min(shape.height, shape.width))
        self.grid = Grid(shape.height, shape.width, self.stride)
        self.counts = blurred_to(way.counts, sigma_px, self.grid)
        self.density = pooled(density, self.stride)
        self.moments = Moments(shape, self.grid, density)
        weight, time = bins
        self.place = time - weight @ time
        spread = weight @ self.place.square()
        # of the events: their sum over the bins is the rate, their mean place its slope over the
        # way
        self.contrast = torch.stack([torch.ones_like(weight), self.place / spread])
        self.gain = (spread / way.spread).to(density)
        self.slope_noise = 1 / (way.spread * OVERLAP * sigma_px**2)
        self.texture_noise = _taps(sigma_px, self.stride)[1]

    def products(self, flow: Tensor) -> Tensor:
        """[B, 8, h, w] as of ``sums_along``, per sample, at a flow [B, 2, h, w] px per way."""
        bins = self.place, self.contrast, self.grid, 1 + self.sigma
        return sums_along(self.counts, flow, self.density, *bins, self.gain)

    def contrast_along(self, flow: Tensor) -> Tensor:
        """Mean square [B] of the rate over the level's samples, in units of what scattered events
        give it, times how many independent samples there are."""
        bins = self.place, self.contrast, self.grid, 1 + self.sigma
        mean, _, seen = moving(self.counts, flow, *bins)
        square = (seen * mean.square()).sum((1, 2)) / (seen.sum((1, 2)) + TINY)
        noise = (self.density.mean((1, 2)) + TINY) / (OVERLAP * self.sigma**2)
        samples = mean[0].numel() * self.stride**2 / (CALIBRATION * OVERLAP * self.sigma**2)
        return (samples * square / noise).double()

    def evidence(self, products: Tensor) -> tuple[Tensor, Tensor]:
        """Precision [B, 2K, 2K] that the data add where their products were taken, and their pull
        [B, 2K] on the parameters: precision times the distance to the best fit."""
        side = 2 * self.shape.terms
        slopes, scattered, right, energy, events = (
            self.moments.sums(products).double() @ self.shape.equations
        ).split([side**2, side**2, side, 1, 1], 1)
        kept, weighed, explained = _trusted(
            slopes.unflatten(1, (side, side)),
            self.texture_noise * scattered.unflatten(1, (side, side)),
            right,
            self.shape.one,
        )
        scale = (CALIBRATION * OVERLAP * self.sigma**2 / self.stride**2) * self._noise(
            explained, events[:, 0], energy[:, 0]
        )
        return kept / scale[:, None, None], weighed / scale[:, None]

    def _noise(self, explained, events, energy):
        """Variance [B] of the temporal slopes: what the fit leaves of their energy, on a floor, per
        sample of the grid."""
        # positive and smooth
        left = torch.sqrt((energy - explained).square() + (1e-6 * energy).square() + TINY)
        few = FEW_EVENTS / self.stride**2 * self.slope_noise
        expected = events * self.slope_noise
        return self.slope_noise * (left + self.noise_floor * expected + few) / (expected + few)


def _trusted(normal, scattered, right, unit):
    """What of the normal equations N p = r is texture (see above), and how much of the slopes'
    energy it explains.

    Args: N, Z [B, 2K, 2K], r [B, 2K], 1 [2K, 2K], float64, in units in which all parameters are
      expected to be alike. A ridge, relative to N + Z, counts as noise: directions in which nothing
      was seen are not trusted.
    Returns: with N + Z = L L^T, S = L^-1 Z L^-T, whose eigenvalues z are the shares of noise, and
      t(z) the trust: L t(S) (1 - S) L^T (symmetric, no eigenvalue below 0), L t(S) L^-1 r, and what
      a step x = (N + Z)^-1 r takes off the energy, 2 r x - x N x.
    """
    ridge = (RIDGE * (normal + scattered).diagonal(dim1=1, dim2=2).mean(1) + TINY)[
        :, None, None
    ] * unit
    root = torch.linalg.cholesky(normal + scattered + ridge)
    inverse = torch.linalg.solve_triangular(root, unit, upper=False)
    # bmm: operator @ looks at shapes for as long as small matrices take
    noise = bmm(bmm(inverse, scattered + ridge), inverse.mT)
    doubt = DOUBT * noise
    texture = unit - noise
    trust = texture
    for _ in range(DOUBLINGS):
        trust = trust @ trust  # bmm adds the gradients of ``texture`` up in another order
        doubt = bmm(doubt, doubt)
    trust = torch.linalg.solve(trust + doubt, trust)
    seen = bmm(inverse, right[:, :, None])
    explained = (seen * (seen + bmm(noise, seen))).sum((1, 2))
    kept = bmm(bmm(root, bmm(trust, texture)), root.mT)
    return (kept + kept.mT) / 2, bmm(root, bmm(trust, seen))[..., 0], explained


def gaussian(sigma_px: float, step: int) -> Tensor:
    """Taps [2 radius + 1], float64, on samples ``step`` px apart, that after averaging over squares
    of ``step`` px make a Gaussian of standard deviation sigma."""
    # in samples: the averages have variance (step^2 - 1) / 12 px^2
    spread = math.sqrt(sigma_px**2 - (step**2 - 1) / 12) / step
    radius = int((3.0 if step == 1 else 2.5) * spread + 0.5)
    taps = torch.exp(
        -torch.arange(-radius, radius + 1, dtype=torch.float64).square() / (2 * spread**2)
    )
    return taps / taps.sum()


def blurred_to(images: Tensor, sigma_px: float, grid: Grid) -> Tensor:
    """Images [B, n, H, W] on the samples of ``grid``: averaged over squares, then through a
    Gaussian, together of standard deviation sigma; mirrored at the border."""
    return blurred(images, grid, _taps(sigma_px, grid.stride)[0])


@lru_cache(64)
def _taps(sigma_px, step):
    """What ``blurred`` takes of a Gaussian, and the ``_slope_of_noise`` that it leaves."""
    taps = gaussian(sigma_px, step)
    noise = _slope_of_noise(_whole_kernel(sigma_px, step), step)
    return tuple(taps[len(taps) // 2 :].tolist()), noise


def _whole_kernel(sigma_px, step):
    """What ``blurred_to`` does along one axis, in taps of 1 px."""
    taps = gaussian(sigma_px, step)
    kernel = torch.zeros(len(taps) * step, dtype=torch.float64)
    for shift in range(step):
        kernel[shift : shift + len(taps) * step - step + 1 : step] += taps / step
    return kernel


def _slope_of_noise(kernel, step):
    """Mean square of a central difference, per px^2, in white noise of variance 1 per pixel behind
    this separable kernel."""
    wide = pad(kernel, (2 * step, 2 * step))
    difference = (wide[2 * step :] - wide[: -2 * step]) / (2 * step)
    return float(difference.square().sum() * kernel.square().sum())
