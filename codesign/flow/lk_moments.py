"""Polynomial fields on the samples of a grid: values, and sums of images times powers of x and y. Powers are
separable, so each costs two small matrix products."""

import torch
from torch import Tensor

from codesign.flow.lk_field import Polynomials
from codesign.flow.lk_lanes import Grid


class Moments:
    """Powers of x and y at the samples of ``grid``, up to twice the degree of ``shape``."""

    def __init__(self, shape: Polynomials, grid: Grid, like: Tensor) -> None:
        """Args: like: tells precision and device."""
        self.side = shape.degree + 1
        rows, columns = (
            torch.arange(count).to(like) * grid.stride + (grid.stride - 1) / 2 for count in grid.shape
        )
        u, v = shape.scaled(columns, rows)
        exponents = torch.arange(2 * shape.degree + 1, device=like.device)
        self.x = u[:, None] ** exponents
        self.y = v[:, None] ** exponents
        self.of_x = self.x[:, : self.side].T.contiguous()
        self.of_y = self.y[:, : self.side].contiguous()
        # where each parameter stands in a table of powers of y and x
        x, y = shape.powers.T
        self.place = torch.eye(self.side**2).to(like)[self.side * y + x]

    def flow(self, parameters: Tensor) -> Tensor:
        """[B, 2, h, w] of parameters [B, 2K]."""
        table = parameters.unflatten(1, (2, -1)) @ self.place
        return self.of_y @ table.unflatten(2, (self.side, self.side)) @ self.of_x

    def sums(self, images: Tensor) -> Tensor:
        """[B, m s^2] of images [B, m, h, w]: sums times y^i x^j, i, j < s = 2 degree + 1."""
        return ((self.y.T @ images) @ self.x).flatten(1)
