"""Flat layers that bend while they move: a smooth random displacement on top of a homography."""

import numpy as np
import torch
from torch.nn.functional import grid_sample, interpolate

from scenes.flow_layers import Plane

MARGIN = 0.5  # of the image's sides, beyond which the displacement stays as at its border
KNOTS = (3, 7)  # random values along a side, least and most
STEEPEST = 0.25  # px of displacement per px; far below 1, where a field folds over
ITERATIONS = 12  # each gains a factor of at least 4


class Bent:
    """A point seen at p + share(t) d(p) at time 0 is seen at H(t) p at time t, with a smooth field d.

    Args: homographies: [T, 3, 3], centred px. displacement_px: [2, h, w] d at points 1 px apart, bilinear in
      between, centred on the image. share: [T], 0 at time 0 and 1 at the window's end.
    """

    def __init__(self, homographies, displacement_px, share):
        self.plane = Plane(homographies)
        self.displacement_px = displacement_px
        self.share = share
        _, height, width = displacement_px.shape
        self.unit = 2 / torch.tensor([float(width), float(height)])

    def texels(self, place, points):
        """As scenes.flow_layers.Plane.texels."""
        flat = self.plane.texels(torch.eye(3), points)
        origin = flat + self.share[:, None, None, None] * self._displacement(flat)
        turned = torch.einsum("ij,tjhw->tihw", place[:2, :2], origin)
        return turned + place[:2, 2, None, None]

    def end(self, points):
        """Where points [H, W, 2] of the start are at the window's end, [H, W, 2]: p + d(p) = q by fixed
        point."""
        start = points.movedim(-1, 0)[None]
        flat = start
        for _ in range(ITERATIONS):
            flat = start - self._displacement(flat)
        return self.plane.end(flat[0].movedim(0, -1))

    def _displacement(self, points):
        """d at points [T, 2, H, W]."""
        grid = points.movedim(1, -1) * self.unit
        field = self.displacement_px.expand(len(points), -1, -1, -1)
        return grid_sample(field, grid, padding_mode="border", align_corners=False)


def displacement(draw, width_px, height_px, rms_px):
    """A smooth random field [2, h, w] of this root mean square length, or shorter where that were too steep.

    Args: draw: numpy Generator.
    """
    knots = int(draw.integers(KNOTS[0], KNOTS[1] + 1))
    values = torch.from_numpy(draw.standard_normal((1, 2, knots, knots))).float()
    size = [int((1 + MARGIN) * side) for side in (height_px, width_px)]
    field = interpolate(values, size=size, mode="bicubic", align_corners=True)[0]
    field = field * (rms_px / field.square().sum(0).mean().sqrt())
    steepest = max(float(field.diff(dim=axis).abs().max()) for axis in (1, 2))
    return field * min(1.0, STEEPEST / max(steepest, 1e-12))


def pace(draw, t, most):
    """Times at which a motion is at its steady course when it hurries and tarries: 0 and 1 stay.

    Args: draw: numpy Generator. t: [T] times, window = 0..1. most: largest change of speed, relative.
    """
    frequency = 2 * np.pi * draw.uniform(0.2, 1.0)
    phase = draw.uniform(0, 2 * np.pi)
    swing = draw.uniform(0, most) / frequency
    wave = swing * np.sin(frequency * t + phase)
    first = swing * np.sin(phase)
    last = swing * np.sin(frequency + phase)
    return t + wave - first * (1 - t) - last * t
