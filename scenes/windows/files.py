"""Windows whose motion is read from flow files, as Middlebury's: a photograph moved along them."""

from pathlib import Path

import numpy as np
import torch
from torch.nn.functional import grid_sample, interpolate

from codesign.errors import FileFormatError
from codesign.events import memory
from codesign.flow.files import read_flow
from scenes.windows import textures
from scenes.windows.rendered import DARKEST, LEAD, Windows

FINE = 3  # points a side of a pixel that carry the photograph
NEARER = 2.0  # per px: of two points in one place the one that moves farther hides the other
MARGIN = 1.5  # of the largest flow, around the piece that is judged: what comes in from there is seen


class FileWindows(Windows):
    """The files in turn, each with another photograph and piece.

    Every point of the photograph moves along its flow at a steady speed; where two meet, the faster is in
    front; where nothing comes, the picture of the start shows. Truth is valid where the file says so.
    Args:
      folder: with .flo files, at any depth.
      factor: on the flow.
      side_px: of the square windows.
      theta: threshold.
      seed, bins, intervals: as Windows.
    Raises: FileFormatError for a folder without flow files, or files smaller than the piece.
    """

    def __init__(self, folder, factor=1.0, *, seed=0, side_px=128, bins=8, intervals=32, theta=0.15):
        super().__init__(seed, bins, intervals)
        self.paths = sorted(Path(folder).rglob("*.flo"))
        if not self.paths:
            raise FileFormatError(f"{folder} holds no .flo file; give the folder of Middlebury's flows.")
        self.factor = factor
        self.side_px = side_px
        self.theta = theta
        self.textures = textures.pool("mixed")

    def _window(self, index):
        draw = np.random.default_rng((self.seed, index))
        path = self.paths[index % len(self.paths)]
        flow, valid = read_flow(path)
        flow = self.factor * flow
        height, width = flow.shape[1:]
        need = self.side_px
        if min(height, width) < need:
            raise FileFormatError(f"{path} has {height} x {width} pixels; windows of {need} px need as many.")
        margin = int(np.ceil(MARGIN * float(flow.abs().max())))
        own, wide, here = [], [], []
        for extent in (height, width):
            first = int(draw.integers(0, extent - need + 1))
            start = max(0, first - margin)
            own.append(slice(first, first + need))
            wide.append(slice(start, min(extent, first + need + margin)))
            here.append(slice(first - start, first - start + need))
        around = flow[:, *wide]
        photo = torch.from_numpy(np.ascontiguousarray(self.textures[draw.integers(len(self.textures))]))
        photo = photo[: around.shape[1], : around.shape[2]]
        photo = interpolate(photo[None, None], around.shape[1:], mode="bilinear", align_corners=False)[0, 0]
        lead = torch.linspace(-0.25, 0, LEAD + 1)[:-1]
        times = torch.cat([lead, torch.linspace(0, 1, self.intervals + 1)])
        frames = torch.stack([moved(photo, around, float(t))[*here] for t in times])
        counts, _ = memory(frames.clamp_min(DARKEST).log(), self.theta, self.theta, log_input=True)
        return counts[LEAD:], flow[:, *own], valid[*own], frames[[LEAD, -1]]


def moved(photo, flow_px, share):
    """A photograph [H, W] with every point moved by ``share`` of its flow [2, H, W].

    Points on a grid of FINE per pixel are shared between four pixels each, the nearest in front (weights that
    grow with the length of the flow; Niklaus and Liu, Softmax splatting, CVPR 2020).
    """
    height, width = photo.shape
    y, x = ((torch.arange(FINE * size) + 0.5) / FINE - 0.5 for size in (height, width))
    y, x = torch.meshgrid(y, x, indexing="ij")
    units = torch.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], -1)[None]
    radiance = grid_sample(photo[None, None], units, padding_mode="border", align_corners=False)[0, 0]
    # edges of depth stay sharp
    u, v = flow_px.repeat_interleave(FINE, 1).repeat_interleave(FINE, 2)
    length = (u.square() + v.square()).sqrt()
    weight = torch.exp(NEARER * (length - length.max())).clamp_min(1e-12)
    x = x + share * u
    y = y + share * v
    left, top = x.floor().long(), y.floor().long()
    sums = torch.zeros(2, height * width, dtype=torch.float64)
    for dx in (0, 1):
        for dy in (0, 1):
            column, row = left + dx, top + dy
            part = weight * (1 - (x - column).abs()) * (1 - (y - row).abs())
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            cell = (row * width + column)[inside]
            for number, value in enumerate((part * radiance, part)):
                sums[number].index_add_(0, cell, value[inside].double())
    lit, covered = sums.reshape(2, height, width)
    return torch.where(covered > 0, lit / covered.clamp_min(1e-300), photo.double()).float()
