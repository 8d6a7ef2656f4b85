"""Curves along which a round shape passes through another one: short chords, carried onto both
surfaces."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from codesign.render.rows import Rows
from codesign.render.silhouettes.crossings import AROUND, Crossings
from codesign.render.silhouettes.curves import (
    ASIDE_RAD,
    DEEPEST,
    EPS,
    SAFETY,
    Curve,
    behind_itself,
    cut_line,
    on_line,
    rounding_rad,
)
from codesign.render.silhouettes.shapes import Shape

TURNS = 6  # of Newton's method, from chords of a hundredth of a circle
FOUND = 1e-9  # share of the radius by which a point may miss the surfaces


@dataclass(frozen=True)
class Intersections(Curve, Rows):
    """Pieces start, end [n, 3] of curves on two surfaces each, f(x) = (x - c) A (x - c) + b (x - c)
    + k = 0 with gradients of length one: c, b, axis [n, 2, 3], A [n, 2, 3, 3], k [n, 2], axis that
    of a tube from c to its other end, 0 for others; curve: [n], which pieces are one curve; radius:
    [n], the lesser one of the two surfaces."""

    start: Tensor
    end: Tensor
    c: Tensor
    A: Tensor
    b: Tensor
    k: Tensor
    axis: Tensor
    curve: Tensor
    radius: Tensor

    def pieces(self, viewpoint, angle, within_m=0.0):
        """As for Segments; all of every curve."""
        return cut_line(self, torch.arange(len(self.start)), viewpoint, angle)

    def points(self, index, s, viewpoint):
        """As for Segments: by Newton's method from the chord, in the plane across it."""
        return self.onto(index, on_line(self, index, s))[0]

    def counts(self, index, y, viewpoint):
        """As for Curve: not on the far side of a round shape, whose near side is before it."""
        away, towards = y[:, None] - self.c[index], (viewpoint - y)[:, None]
        return ~((self.k[index] < 0) & behind_itself(away, towards, self.axis[index])).any(1)

    def onto(self, piece, x):
        """Points x [n, 3] near pieces [n] carried onto both surfaces, and how far [n] they still
        are from these."""
        c, A, b, k = (v[piece] for v in (self.c, self.A, self.b, self.k))

        def surfaces(x):
            away = x[:, None] - c
            lean = (A @ away[..., None])[..., 0]
            return (away * (lean + b)).sum(2) + k, 2 * lean + b

        for _ in range(TURNS):
            f, slopes = surfaces(x)
            first, second = slopes.unbind(1)
            p, q, r = (
                (u * v).sum(1) for u, v in ((first, first), (first, second), (second, second))
            )
            p, r = p + 1e-12, r + 1e-12
            s, t = ((r * f[:, 0] - q * f[:, 1]), (p * f[:, 1] - q * f[:, 0]))
            x = x - (s[:, None] * first + t[:, None] * second) / (p * r - q * q)[:, None]
        return x, surfaces(x)[0].abs().amax(1)

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
        )
        index = self.curve[index]
        radius = radius[index]
        distance = (middle[index] - viewpoint).norm(dim=1) + reach[index]
        ratio = distance / radius
        aside = torch.minimum(ASIDE_RAD + SAFETY * EPS * ratio, DEEPEST / ratio)
        return aside + rounding_rad(viewpoint, middle[index].norm(dim=1), distance)


def on_surfaces(
    found: Crossings, shapes: list[Shape], apart_m: float
) -> tuple[Intersections | None, np.ndarray]:
    """The crossings of which one surface is round, on these surfaces, less those that run along the
    rim of a tube or disk; and for every shape how far [S, 2] such a crossing lies from its two
    rims."""
    width = np.zeros((len(shapes), 2))
    if not len(found.start):
        return None, width
    sides = [_surfaces(found, shapes, side) for side in (0, 1)]
    c, A, b, k, axis = (torch.tensor(np.stack([side[i] for side in sides], 1)) for i in range(5))
    least = torch.tensor(np.minimum(sides[0][5], sides[1][5]))
    _, curve = np.unique(found.shapes, axis=0, return_inverse=True)
    curve = torch.tensor(curve.reshape(-1))
    pieces = Intersections(
        torch.tensor(found.start), torch.tensor(found.end), c, A, b, k, axis, curve, least
    )
    every = torch.arange(len(curve))
    (start, miss_start), (end, miss_end) = (
        pieces.onto(every, x) for x in (pieces.start, pieces.end)
    )
    length = (pieces.end - pieces.start).norm(dim=1)
    moved = torch.maximum((start - pieces.start).norm(dim=1), (end - pieces.end).norm(dim=1))
    good = (torch.maximum(miss_start, miss_end) < FOUND * least) & (
        moved < length + 4 * least * (np.pi / AROUND)
    )
    for number in np.unique(found.shapes):
        for rim, curve_of_rim in enumerate(shapes[number].rims()):
            distance = np.maximum(*(_from_rim(curve_of_rim, x.numpy()) for x in (start, end)))
            near = (distance < apart_m) & (found.shapes == number).any(1) & good.numpy()
            width[number, rim] = distance[near].max(initial=0)
            good &= torch.tensor(~near)
    rows = torch.nonzero(good)[:, 0]
    if not rows.numel():
        return None, width
    return replace(pieces, start=start, end=end)[rows], width


def _surfaces(found, shapes, side):
    """c, b [n, 3], A [n, 3, 3], k [n], axis [n, 3] and radius [n] of one side of all crossings,
    infinite where it is flat."""
    count = len(found.start)
    c = found.start.copy()
    A = np.zeros((count, 3, 3))
    b = found.normals[:, side].copy()
    k = np.zeros(count)
    axes = np.zeros((count, 3))
    radius = np.full(count, np.inf)
    for number in np.unique(found.shapes[:, side]):
        rows = found.shapes[:, side] == number
        if (of := shapes[number].round()) is not None:
            c[rows], axes[rows], radius[rows] = of
            along = of[1] / max(np.linalg.norm(of[1]), 1e-300)
            A[rows] = (np.eye(3) - np.outer(along, along)) / (2 * of[2])
            b[rows] = 0
            k[rows] = -of[2] / 2
    return c, A, b, k, axes, radius


def _from_rim(rim, points):
    """How far [n] points [n, 3] on the surface of a shape lie from one of its rims."""
    centre, u, v, _ = rim
    lengths = [float(np.linalg.norm(half)) for half in (u, v)]
    away = points - centre
    share = np.hypot(away @ u / lengths[0] ** 2, away @ v / lengths[1] ** 2)
    height = away @ np.cross(u, v) / (lengths[0] * lengths[1])
    return np.hypot((share - 1) * min(lengths), height)
