"""Gauss-Newton steps towards the field that the events and the prior agree on."""

import torch
from torch import Tensor

from codesign.flow.lk_cells import Cells
from codesign.flow.lk_field import Polynomials
from codesign.flow.lk_level import Level
from codesign.flow.lk_start import at_start

FIRST = 1.0  # by what the first of two answers leads in the logarithm of their odds


class Descent:
    """A field, and how surely it is known: a polynomial, and values on cells.

    Where not ``local``, the cells are no part of the flow. They are found once, at the end: what one polynomial does
    not explain is error of the field.
    """

    def __init__(self, shape: Polynomials, prior_px: float, local: bool, like: Tensor) -> None:
        """Args: like: [B, ...], tells batch, device and precision."""
        batch = len(like)
        self.shape = shape
        self.like = like
        # in units of the prior: parameters = unit @ found
        self.found = torch.zeros(batch, 2 * shape.terms, dtype=torch.float64, device=like.device)
        self.expected: Tensor | None = None
        self.one = torch.eye(2 * shape.terms, dtype=torch.float64, device=like.device)
        self.precision = self.one.expand(batch, -1, -1)
        self.local = local
        self.cells = Cells(batch, shape.height, shape.width, prior_px, like.device)

    def begin(self, flow_px: Tensor, start: Tensor) -> None:
        """Moves to the least-squares fit of a flow [B, 2, H, W], px per way, on the pixels of the start, which lies at
        ``start`` [B] on the way."""
        self.found = self.expected = self.shape.fitted(flow_px, start)

    def parameters(self) -> Tensor:
        """[B, 2K] of the polynomial, px per way."""
        return (self.found @ self.shape.unit.T).to(self.like)

    def flow(self, level: Level) -> Tensor:
        """[B, 2, h, w] px per way on the level's samples."""
        flow = level.moments.flow(self.parameters())
        return flow + self.cells.on(level).to(flow) if self.local else flow

    def descend(self, level: Level, steps: int, bend: bool, last: bool, expected: bool = False) -> None:
        """Moves to the best field, by steps no longer than the linearisation reaches.

        Args: bend: whether cells of a local field move too; they do from the second step on, or the only one, since
          what the polynomial has not yet reached looks like a local part. last: whether nothing follows. expected:
          whether the prior is about the field of ``begin``, which a blur that sees nothing then leaves as it is.
        """
        centre = self.expected if expected and self.expected is not None else torch.zeros_like(self.found)
        for step in range(steps):
            products = level.products(self.flow(level))
            evidence, pull = level.evidence(products)
            self.precision = self.one + evidence
            change = torch.linalg.solve(self.precision, pull + centre - self.found)
            moved = self.shape.mean_square(change @ self.shape.unit.T)
            change = change * (1 + moved / (2 * level.sigma) ** 2).rsqrt()[:, None]
            self.found = self.found + change
            moves = bend and step >= min(1, steps - 1) if self.local else last and step == steps - 1
            if moves:
                by_polynomial = level.moments.flow((change @ self.shape.unit.T).to(self.like))
                self.cells.step(level, products, by_polynomial)

    def join(self, other: "Descent", level: Level) -> None:
        """The mean of this field and another, by how much contrast the events along each have; where this one began
        somewhere, also by the prior, which it has had few steps to meet."""
        more = level.contrast_along(self.flow(level)) - level.contrast_along(other.flow(level))
        if self.expected is not None:
            more = more + other.found.square().sum(1) - self.found.square().sum(1)
        share = torch.sigmoid(more / 2 + FIRST)[:, None]
        self.found = other.found + share * (self.found - other.found)
        if self.local:
            share = share[..., None, None]
            self.cells.value = other.cells.value + share * (self.cells.value - other.cells.value)

    def at_start(self, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Flow [B, 2, H, W], its covariance [B, 3, H, W] and confidence [B, H, W] on the pixels of the start, which
        lies at ``start`` [B] on the way."""
        unit = self.shape.unit
        spread = unit @ torch.linalg.inv(self.precision) @ unit.T
        return at_start(self.shape, self.parameters(), spread, self.cells, self.local, start)
