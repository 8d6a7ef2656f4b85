"""One scale of the closed form: the blurred volume on its own grid, and what it says about the parameters of
a field.

Noise. Events scattered at random, rho per pixel and window, put into a volume blurred by a Gaussian of sigma
- temporal slopes of variance rho / (sum w t^2) / (4 pi sigma^2), w the share of the window in a bin and t its
  time, and
- slopes of the mean of variance kappa rho, about rho / (8 pi sigma^4), which look like texture and are none.
  The first sets how much the pull of the data can be trusted; how far real events are from Poisson is read
  off the residual. The second is an error in the regressors (Fuller, Measurement Error Models, 1987): with N
  = sum g g^T the normal matrix of the slopes seen and Z what scattered events alone would add to it, a
  direction of the parameters in which Z makes up the share z counts by (1 - z)^4 / ((1 - z)^4 + (3 z)^4):
  nearly 1 for texture, 1/82 where all is noise.
"""

import math

import torch
from kornia.filters import gaussian_blur2d, get_gaussian_kernel1d
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv1d, grid_sample, pad

from codesign.flow.lk_field import Polynomials
from codesign.types import EventVolume

# the factor 3 and the power 4 = 2^2 above
DOUBT = 3.0
DOUBLINGS = 2
FEW_EVENTS = 10.0  # worth of Poisson noise the measured noise starts from: some events alone fit any field
OVERLAP = 4 * math.pi  # blurred white noise is alike over 4 pi sigma^2 pixels
# for what makes errors larger than that: bins share events, thresholds quantise, fields warp imperfectly
# (docs/flow_closed_form.md)
CALIBRATION = 3.0
TINY = 1e-12


def stride(sigma_px: float) -> int:
    """Spacing of a level's grid, px: the largest power of two up to sigma, at least 1."""
    return 2 ** math.floor(math.log2(max(sigma_px, 1.0)))


def least_px(sigma_px: float) -> int:
    """Smallest side of an image that the level's kernel fits into."""
    return max(int(3 * sigma_px + 0.5) + 1, (_radius(sigma_px) + 1) * stride(sigma_px))


def signed_rate(volume: EventVolume) -> tuple[tuple[Tensor, Tensor], Tensor, Tensor]:
    """(weight [n], time [n]) of the bins, events per interval [B, n, H, W] as if each bin ran over all of it,
    and events of both signs per pixel [B, H, W].

    Weights are the shares of the interval; time is 0 at mid-interval, in intervals.
    """
    counts = volume.counts
    span = volume.collected_s.sum()
    weight = (volume.collected_s / span).to(counts)
    time = (volume.centroid_s / span).to(counts) - 0.5
    return (weight, time), (counts[:, 0] - counts[:, 1]) / weight[:, None, None], counts.sum((1, 2))


class Level:
    """The volume blurred by a Gaussian of sigma_px, sampled at the centres of squares of ``stride`` x
    ``stride`` pixels."""

    def __init__(
        self,
        rate: Tensor,
        density: Tensor,
        times: tuple[Tensor, Tensor],
        shape: Polynomials,
        sigma_px: float,
        noise_floor: float,
    ) -> None:
        self.sigma = sigma_px
        self.shape = shape
        self.noise_floor = noise_floor
        self.stride = stride(sigma_px)
        self.rate, kernel = _blurred(rate, sigma_px)
        self.density = (avg_pool2d(density, self.stride) if self.stride > 1 else density).flatten(1)
        self.rows, self.columns = self.rate.shape[-2:]
        first = (self.stride - 1) / 2
        x, y = (torch.arange(count).to(rate) * self.stride + first for count in (self.columns, self.rows))
        places = shape.scaled(x.expand(self.rows, -1), y[:, None].expand(-1, self.columns))
        self.basis = shape.basis(*places).flatten(1).T.contiguous()  # [P, K]
        self.products = (self.basis[:, :, None] * self.basis[:, None]).flatten(1)  # [P, K K]
        weight, time = times
        centred = time - weight @ time
        spread = weight @ centred.square()
        self.contrast = torch.stack([weight, weight * centred / spread])  # mean over bins, slope over time
        self.slope_noise = 1 / (float(spread) * OVERLAP * sigma_px**2)
        self.texture_noise = _slope_of_noise(kernel, self.stride)
        # in grid_sample's units, -1 and 1 at the outermost samples
        self.half = torch.stack([x[-1] - first, y[-1] - first]) / 2
        self.middle = (torch.tensor([shape.width, shape.height]).to(rate) - 1 - 2 * first) / (
            2 * self.half
        ) - 1
        self.reach = torch.tensor([shape.width, shape.height]).to(rate) / 2 - 0.5
        self.speed = time[:, None, None] / self.half
        self.grid = torch.stack(
            [
                ((x - first) / self.half[0] - 1).expand(self.rows, -1),
                ((y - first) / self.half[1] - 1)[:, None].expand(-1, self.columns),
            ],
            -1,
        ).flatten(0, 1)

    def evidence(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Precision [B, 2K, 2K] that the data add at these parameters, and their pull [B, 2K] on them:
        precision times the distance to the best fit."""
        batch = len(parameters)
        k = self.shape.terms
        warped, seen = self._warped(self.basis @ parameters.reshape(batch, 2, k).mT)
        mean, slope = (self.contrast @ warped).unbind(1)
        dy, dx = (
            d.flatten(1) / self.stride
            for d in torch.gradient(mean.unflatten(1, (self.rows, self.columns)), dim=(1, 2))
        )
        sx = seen * dx
        sy = seen * dy
        xx, xy, yy, event_products = (
            (torch.stack([sx * dx, sx * dy, sy * dy, seen * self.density], 1) @ self.products)
            .unflatten(2, (k, k))
            .unbind(1)
        )
        normal = torch.cat([torch.cat([xx, xy], 2), torch.cat([xy, yy], 2)], 1)
        scattered = (
            torch.block_diag(torch.ones(k, k), torch.ones(k, k)).to(event_products)
            * event_products.repeat(1, 2, 2)
            * self.texture_noise
        )
        right = -(torch.stack([sx * slope, sy * slope], 1) @ self.basis).flatten(1)
        trust = _trust(normal, scattered)
        scale = (
            CALIBRATION
            * OVERLAP
            * self.sigma**2
            / self.stride**2
            * self._noise(normal, right, event_products[:, 0, 0], (seen * slope.square()).sum(1))
        )[:, None, None]
        return normal @ trust / scale, (right[:, None] @ trust / scale)[:, 0]

    def _noise(self, normal, right, events, energy):
        """Variance [B] of the temporal slopes: what the best fit leaves of their energy, on a floor, per
        sample of the grid."""
        ridge = (1e-6 * normal.diagonal(dim1=1, dim2=2).mean(1)[:, None] + TINY).expand_as(right)
        explained = (right * torch.linalg.solve(normal + torch.diag_embed(ridge), right)).sum(1)
        left = torch.sqrt(
            (energy - explained).square() + (1e-6 * energy).square() + TINY**2
        )  # positive and smooth
        few = FEW_EVENTS / self.stride**2 * self.slope_noise
        expected = events * self.slope_noise
        return self.slope_noise * (left + self.noise_floor * expected + few) / (expected + few)

    def _warped(self, flow):
        """Bins carried back to mid-interval along the flow [B, P, 2], as [B, n, P], and a smooth window [B,
        P] that fades where they leave the image."""
        batch, bins = self.rate.shape[:2]
        at = self.grid + self.speed * flow[:, None]
        warped = grid_sample(
            self.rate.flatten(0, 1)[:, None],
            at.reshape(batch * bins, self.rows, self.columns, 2),
            padding_mode="border",
            align_corners=True,
        )
        inside = ((self.reach - (at[:, [0, -1]] - self.middle).abs() * self.half) / (1 + self.sigma)).clamp(
            0, 1
        )
        window = (inside.square() * (3 - 2 * inside)).unbind(3)
        window = window[0] * window[1]
        return warped.reshape(batch, bins, -1), window[:, 0] * window[:, 1]


def _trust(normal, scattered):
    """N^-1 times the part of N that is texture (see above), [B, 2K, 2K]; powers of the share of noise (N +
    Z)^-1 Z, whose eigenvalues are 0 to 1."""
    unit = torch.eye(normal.shape[-1]).to(normal)
    noise = torch.linalg.solve(normal + scattered + TINY * unit, scattered + TINY * unit)
    texture = unit - noise
    doubt = DOUBT * noise
    for _ in range(DOUBLINGS):
        texture = texture @ texture
        doubt = doubt @ doubt
    return torch.linalg.solve(texture + doubt, texture)


def _radius(sigma_px):
    """Taps on each side, in samples of the level's grid."""
    step = stride(sigma_px)
    return int((3.0 if step == 1 else 2.5) * _spread(sigma_px) + 0.5)


def _spread(sigma_px):
    """Standard deviation, in samples of the grid, of the Gaussian that follows averaging over squares
    (variance (step^2 - 1) / 12)."""
    step = stride(sigma_px)
    return math.sqrt(sigma_px**2 - (step**2 - 1) / 12) / step


def _blurred(images, sigma_px):
    """[B, n, H, W] averaged over squares, then through a Gaussian, together of standard deviation sigma;
    mirrored at the border.

    Returns: images at the centres of the squares, and the whole kernel along one axis, taps of 1 px.
    """
    step = stride(sigma_px)
    size = 2 * _radius(sigma_px) + 1
    pooled = avg_pool2d(images, step) if step > 1 else images
    spread = _spread(sigma_px)
    found = gaussian_blur2d(pooled, (size, size), (spread, spread))
    taps = get_gaussian_kernel1d(size, spread, device=images.device, dtype=images.dtype)
    spaced = pad(taps[0][:, None], (0, step - 1)).flatten()
    kernel = conv1d(spaced[None, None], torch.full((1, 1, step), 1 / step).to(images), padding=step - 1)[0, 0]
    return found, kernel


def _slope_of_noise(kernel, step):
    """Mean square of a central difference, per px^2, in white noise of variance 1 per pixel behind this
    separable kernel."""
    wide = pad(kernel, (2 * step, 2 * step))
    difference = (wide[2 * step :] - wide[: -2 * step]) / (2 * step)
    return float(difference.square().sum() * kernel.square().sum())
