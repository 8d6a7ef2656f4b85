"""Curves along which a round shape passes through another one: short chords, carried onto both surfaces."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from codesign.render.outline.crossings import AROUND, Crossings
from codesign.render.outline.curves import ASIDE_RAD, DEEPEST, EPS, SAFETY, cut, pieces_of, rounding_rad
from codesign.render.outline.shapes import Ball, Disk, Mesh, Shape, Tube

TURNS = 6  # of Newton's method, from chords of a hundredth of a circle
FOUND = 1e-9  # share of the radius by which a point may miss the surfaces


@dataclass(frozen=True)
class Intersections:
    """Pieces start, end [n, 3] of curves on two surfaces each, f(x) = (x - c) A (x - c) + b (x - c) + k = 0 with
    gradients of length one: c, b [n, 2, 3], A [n, 2, 3, 3], k [n, 2]; curve: [n], which pieces are one curve;
    radius: [n], the lesser one of the two surfaces. Parameter 2 k .. 2 k + 1 of a curve for its piece k."""

    start: Tensor
    end: Tensor
    c: Tensor
    A: Tensor
    b: Tensor
    k: Tensor
    curve: Tensor
    radius: Tensor

    def pieces(self, viewpoint, angle, within_m=0.0):
        """As for Segments; all of every curve."""
        index, s = cut(
            torch.arange(len(self.start)), pieces_of(self.start - viewpoint, self.end - viewpoint, angle)
        )
        return self.curve[index], s + 2 * index[:, None]

    def points(self, index, s, viewpoint):
        """As for Segments: by Newton's method from the chord, in the plane across it."""
        piece = ((s + 0.5) / 2).floor().long().clamp(0, len(self.start) - 1)
        share = (s - 2 * piece)[:, None]
        return self.onto(piece, self.start[piece] + share * (self.end - self.start)[piece])[0]

    def onto(self, piece, x):
        """Points x [n, 3] near pieces [n] carried onto both surfaces, and how far [n] they still are from these."""
        c, A, b, k = (v[piece] for v in (self.c, self.A, self.b, self.k))
        for _ in range(TURNS):
            away = x[:, None] - c
            f = (away * ((A @ away[..., None])[..., 0] + b)).sum(2) + k
            gradient = 2 * (A @ away[..., None])[..., 0] + b
            square = gradient @ gradient.mT + 1e-12 * torch.eye(2, dtype=x.dtype)
            x = x - (gradient * torch.linalg.solve(square, f[..., None])).sum(1)
        away = x[:, None] - c
        return x, ((away * ((A @ away[..., None])[..., 0] + b)).sum(2) + k).abs().amax(1)

    def aside_rad(self, index, viewpoint):
        """As for Segments: as for the outline of the rounder of the two shapes."""
        count = int(self.curve.max()) + 1
        middle = torch.zeros(count, 3, dtype=torch.float64).index_add(0, self.curve, self.start)
        middle = middle / torch.bincount(self.curve, minlength=count)[:, None]
        reach = torch.zeros(count, dtype=torch.float64).scatter_reduce(
            0, self.curve, (self.start - middle[self.curve]).norm(dim=1), "amax"
        )
        radius = torch.full((count,), torch.inf, dtype=torch.float64).scatter_reduce(
            0, self.curve, self.radius, "amin"
        )[index]
        distance = (middle[index] - viewpoint).norm(dim=1) + reach[index]
        ratio = distance / radius
        aside = torch.minimum(ASIDE_RAD + SAFETY * EPS * ratio, DEEPEST / ratio)
        return aside + rounding_rad(viewpoint, middle[index].norm(dim=1), distance)

    def counts(self, index, viewpoint):
        """As for Segments: always."""
        return torch.ones_like(index, dtype=torch.bool)

    def covered(self, index, viewpoint):
        """As for Segments: nowhere."""
        return torch.zeros_like(index, dtype=torch.bool)


def on_surfaces(
    found: Crossings, shapes: list[Shape], apart_m: float
) -> tuple[Intersections | None, np.ndarray]:
    """The crossings of which one surface is round, on these surfaces, less those that run along the rim of a tube
    or disk; and for every shape how far [S, 2] such a crossing lies from its two rims."""
    width = np.zeros((len(shapes), 2))
    if not len(found.start):
        return None, width
    sides = [_surfaces(found, shapes, side) for side in (0, 1)]
    c, A, b, k = (torch.tensor(np.stack([side[i] for side in sides], 1)) for i in range(4))
    least = torch.tensor(np.minimum(sides[0][4], sides[1][4]))
    _, curve = np.unique(found.shapes, axis=0, return_inverse=True)
    pieces = Intersections(
        torch.tensor(found.start), torch.tensor(found.end), c, A, b, k, torch.tensor(curve.reshape(-1)), least
    )
    every = torch.arange(len(curve.reshape(-1)))
    (start, miss_start), (end, miss_end) = (pieces.onto(every, x) for x in (pieces.start, pieces.end))
    length = (pieces.end - pieces.start).norm(dim=1)
    moved = torch.maximum((start - pieces.start).norm(dim=1), (end - pieces.end).norm(dim=1))
    good = (torch.maximum(miss_start, miss_end) < FOUND * least) & (
        moved < length + 4 * least * (np.pi / AROUND)
    )
    for number in np.unique(found.shapes):
        for rim, distance in enumerate(_from_rims(shapes[number], start.numpy(), end.numpy())):
            near = (distance < apart_m) & (found.shapes == number).any(1) & good.numpy()
            width[number, rim] = distance[near].max(initial=0)
            good &= torch.tensor(~near)
    rows = torch.nonzero(good)[:, 0]
    if not rows.numel():
        return None, width
    kept = Intersections(*(getattr(pieces, name)[rows] for name in pieces.__dataclass_fields__))
    return replace(kept, start=start[rows], end=end[rows]), width


def _surfaces(found, shapes, side):
    """c, b [n, 3], A [n, 3, 3], k [n], and radius [n] of one side of all crossings, infinite where it is flat."""
    count = len(found.start)
    c = found.start.copy()
    A = np.zeros((count, 3, 3))
    b = found.normals[:, side].copy()
    k = np.zeros(count)
    radius = np.full(count, np.inf)
    for number in np.unique(found.shapes[:, side]):
        rows = found.shapes[:, side] == number
        shape = shapes[number]
        if isinstance(shape, Ball):
            c[rows] = shape.centre
            across = np.eye(3)
        elif isinstance(shape, Tube):
            c[rows] = shape.start
            axis = (shape.end - shape.start) / np.linalg.norm(shape.end - shape.start)
            across = np.eye(3) - np.outer(axis, axis)
        else:
            continue
        A[rows] = across / (2 * shape.radius)
        b[rows] = 0
        k[rows] = -shape.radius / 2
        radius[rows] = shape.radius
    return c, A, b, k, radius


def _from_rims(shape, start, end):
    """For every rim of a shape, how far [n] pieces from start to end [n, 3] on its surface run from it."""
    if isinstance(shape, Mesh | Ball):
        return []
    if isinstance(shape, Tube):
        axis = (shape.end - shape.start) / np.linalg.norm(shape.end - shape.start)
        return [
            np.maximum(np.abs((start - centre) @ axis), np.abs((end - centre) @ axis))
            for centre in (shape.start, shape.end)
        ]
    return [np.maximum(_from_rim(shape, start), _from_rim(shape, end))]


def _from_rim(disk: Disk, points):
    lengths = [float(np.linalg.norm(half)) for half in (disk.u, disk.v)]
    away = points - disk.centre
    share = np.hypot(away @ disk.u / lengths[0] ** 2, away @ disk.v / lengths[1] ** 2)
    return np.abs(share - 1) * min(lengths)
