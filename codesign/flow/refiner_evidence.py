"""What bins read along a flow say about the flow that is still missing: local least squares for V_t
+ u V_x + v V_y = 0 at several blurs and in windows of several sizes, weighed by the noise of events
scattered at random.

The noise is that of the closed form (lk.level): rho scattered events per pixel behind a Gaussian of
sigma give temporal slopes of variance rho / (4 pi sigma^2 sum w t^2) and slopes of the mean of
variance about rho / (8 pi sigma^4), alike over 4 pi sigma^2 px. With N the sums of products of
slopes in a window, the precision is N over that variance and overlap; it counts by the share (g /
(g + 4 z))^2 of the trace g of N, z what scattered events add to it.

At the border between two motions no window says where it runs, but the events near by are sharp
along one of the two: flows of cells around are tried as they are (PatchMatch: Barnes et al.,
SIGGRAPH 2009).
"""

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from codesign.flow.lk.lanes import Grid
from codesign.flow.lk.level import along_path, blurred_to
from codesign.flow.lk.slopes import sums_along
from codesign.flow.lk.warp import moving
from codesign.flow.warp import pixel_grid, read_at
from codesign.types import EventVolume

POOL = 2  # px a side over which the bins that are read are averaged
CELL = 4  # px a side of the cells on which flow is corrected
BLURS = (1, 2, 4)  # standard deviations in px, and spacing of the samples
WINDOWS = ((3, 9), (3, 9), (9,))  # cells a side, for each blur
# variance expected of what is missing where the claim is believed, over the claimed one
MISFIT = 4.0
SOLVED = 2 * sum(len(sizes) for sizes in WINDOWS)
# cells down and right
AROUND = ((3, 0), (-3, 0), (0, 3), (0, -3), (5, 5), (5, -5), (-5, 5), (-5, -5))
TRIED_IN = (3, 7)  # cells a side of the windows in which their flows are tried
TRIED_AT = 1  # of BLURS
TOLD = 5 * SOLVED  # channels told by ``Evidence.at``
TRIED = len(AROUND) * len(TRIED_IN)  # channels told by ``Evidence.others``
MOST_PX = 2.0  # deviation expected of what is missing
CALIBRATION = 3.0  # real errors over those of scattered events, as in the closed form
NOISE = 4.0  # the factor on z above
FEW = 1 / 64  # events per pixel that are assumed on top
SMALL = 0.05  # keeps logarithms finite
LARGEST = 4.0  # values that many times their noise are compressed
OVERLAP = 4 * math.pi


class Evidence:
    """A volume blurred at several scales, and what it says along a flow, px per way (lk.path).

    Sides of the volume are multiples of CELL. density: [B, 1, h, w] events per px on cells;
    mean_density: [B, 1, 1, 1].
    net: [B, 1, 1, 1] displacement over the way, 1 for motion that never turns.
    """

    def __init__(self, volume: EventVolume, clock: str = "time") -> None:
        way, (weight, time), density = along_path(volume, clock)
        self.net = way.net.to(density)[:, None, None, None]
        height, width = density.shape[-2:]
        place = time - weight @ time
        spread = weight @ place.square()
        self.time = time + 0.5  # 0 at the start, where the flow belongs
        self.contrast = torch.stack([torch.ones_like(place), place / spread])
        self.time_noise = 1 / float(spread)
        self.mean_density = density.mean((1, 2))[:, None, None, None] + FEW
        self.density = avg_pool2d(density[:, None], CELL)
        unit = (POOL**2 / (self.mean_density * weight.to(density)[:, None, None])).sqrt()
        self.pooled = _compressed(unit * avg_pool2d(way.counts, POOL))
        self.levels = []
        for blur in BLURS:
            grid = Grid(height, width, blur)
            pooled = avg_pool2d(density, blur) if blur > 1 else density
            counts = blurred_to(way.counts, blur, grid)
            self.levels.append((blur, grid, counts, pooled))

    def at(self, flow: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
        """What is still missing along a flow [B, 2, h, w] px on cells, of which ``variance``
        [B, 1, h, w] px^2 is claimed.

        Returns: told [B, TOLD, h, w]: per blur and window the two flows below (4), logarithms of
          twice the likelihood gained and of the precision, orientation of the texture (2),
          logarithms of what moves and of the texture over their noise. solved [B, SOLVED, 2, h, w]:
          per blur and window two flows in px, where next to nothing is expected (MOST_PX), and
          where the claim is believed (MISFIT).
        Gradient: flow, variance, volume.
        """
        told = []
        solved = []
        for (blur, grid, counts, density), sizes in zip(self.levels, WINDOWS, strict=True):
            there = larger(flow, CELL // blur) if blur < CELL else flow
            bins = self.time, self.contrast, grid, 1.0 + blur
            sums = sums_along(counts, there, density, *bins, cell=CELL // blur)
            for size in sizes:
                wide = _around(sums, size) * size**2
                here, sure, trust = self._solved(wide, blur, variance)
                told += [here, sure, trust]
                solved += [here, sure]
        return torch.cat(told, 1), torch.stack(solved, 1)

    def others(self, flow: Tensor) -> tuple[Tensor, Tensor]:
        """What the flows of cells around would explain here.

        Args:
          flow: [B, 2, h, w] px on cells.
        Returns: told [B, TRIED, h, w]: for each cell of AROUND and window of TRIED_IN, by how much
          the events have more contrast along its flow than along the cell's own, over the sum of
          both and of noise. offered [B, len(AROUND), 2, h, w]: its flow less the cell's own, px.
        Gradient: flow, volume.
        """
        blur, grid, counts, _ = self.levels[TRIED_AT]
        rows, columns = flow.shape[2:]

        def contrast(flow):
            there = larger(flow, CELL // blur)
            mean, _, seen = moving(
                counts, there, self.time, self.contrast, grid, fade_px=1.0 + blur
            )
            square = avg_pool2d((seen * mean.square())[:, None], CELL // blur)
            return [_around(square, size) for size in TRIED_IN]

        told = []
        offered = []
        least = self.mean_density / (OVERLAP * blur**2)
        own = contrast(flow)
        for down, right in AROUND:
            edge = max(abs(down), abs(right))
            other = pad(flow, (edge,) * 4, mode="replicate")
            other = other[
                :, :, edge + down : edge + down + rows, edge + right : edge + right + columns
            ]
            told += [(a - b) / (a + b + least) for a, b in zip(contrast(other), own, strict=True)]
            offered.append(other - flow)
        return torch.cat(told, 1), torch.stack(offered, 1)

    def bins(self, flow: Tensor) -> Tensor:
        """Bins [B, 2 n, 2 h, 2 w] averaged over 2 x 2 px, over the noise of scattered events, large
        ones compressed: as they are, and along a flow [B, 2, h, w] px on cells. Gradient: flow,
        volume."""
        along = larger(flow, CELL // POOL) / POOL
        bins, height, width = self.pooled.shape[1:]
        at = (
            pixel_grid(height, width, along)
            + self.time.to(along)[:, None, None, None] * along[:, None]
        )
        found = read_at(self.pooled.flatten(0, 1)[:, None], at.flatten(0, 1))
        return torch.cat([self.pooled, found.unflatten(0, (-1, bins))[:, :, 0]], 1)

    def _solved(self, sums, blur, variance):
        """Flows [B, 2, h, w] px that the sums of a window ask for with the one prior and the other,
        and what is told of the first [B, 6, h, w]."""
        xx, xy, yy, xs, ys, ss, seen, events = sums.unbind(1)
        alike = OVERLAP  # samples, blur px apart, over which noise is alike
        density = (events + FEW * (seen + 1)) / (seen + 1)
        moving_noise = density * self.time_noise / (OVERLAP * blur**2)
        texture_noise = density / (OVERLAP * blur**4)  # of both slopes of the mean
        texture = xx + yy
        noise = NOISE * texture_noise * (seen + 1)
        weight = (texture / (texture + noise)).square() / (CALIBRATION * alike * moving_noise)
        matrix = xx, xy, yy
        u, v, a, b, c = _least(weight, matrix, xs, ys, MOST_PX**-2)
        sure = torch.stack(_least(weight, matrix, xs, ys, 1 / (MISFIT * variance[:, 0]))[:2], 1)
        determinant = a * b - c * c
        gain = -weight * (u * xs + v * ys)
        trust = [
            (gain + SMALL).log() / 4,
            determinant.log() / 8,
            (a - b) / (a + b),
            2 * c / (a + b),
            ((ss + SMALL * moving_noise) / ((seen + 1) * moving_noise)).log() / 4,
            ((texture + SMALL * texture_noise) / ((seen + 1) * texture_noise)).log() / 4,
        ]
        free = torch.stack([u, v], 1)
        return _within(free, 3.0 * blur), _within(sure, 3.0 * blur), torch.stack(trust, 1)


def _around(image, size):
    """Means of an image [B, C, h, w] over squares of so many cells a side, an odd number, around each
    cell; 0 beyond its border."""
    along = avg_pool2d(image, (1, size), 1, (0, size // 2))
    return avg_pool2d(along, (size, 1), 1, (size // 2, 0))


def _within(flow, reach):
    """Flow [B, 2, h, w] bent towards lengths below ``reach``."""
    return flow * (1 + (flow / reach).square().sum(1, keepdim=True)).rsqrt()


def _compressed(value):
    return value * (1 + (value / LARGEST).square()).rsqrt()


def larger(image: Tensor, factor: int) -> Tensor:
    """An image on cells enlarged bilinearly."""
    return interpolate(image, scale_factor=factor, mode="bilinear", align_corners=False)


def _least(weight, matrix, xs, ys, prior):
    """Flow (u, v) of the normal equations, and their matrix (xx, yy, xy), with a prior
    precision."""
    xx, xy, yy = matrix
    a = weight * xx + prior
    b = weight * yy + prior
    c = weight * xy
    determinant = a * b - c * c
    return (
        weight * (c * ys - b * xs) / determinant,
        weight * (c * xs - a * ys) / determinant,
        a,
        b,
        c,
    )
