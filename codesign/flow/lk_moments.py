"""Polynomial fields on the samples of a grid: values, and sums of images times the basis or its products. Powers of
x and y are separable, so each costs two small matrix products."""

import torch
from torch import Tensor

from codesign.flow.lk_field import Polynomials
from codesign.flow.lk_lanes import Grid

# powers of x and y of the basis of Polynomials
POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))


class Moments:
    """The basis of ``shape`` at the samples of ``grid``."""

    def __init__(self, shape: Polynomials, grid: Grid, like: Tensor) -> None:
        """Args: like: tells precision and device."""
        self.degree = max(map(sum, POWERS[: shape.terms]))
        rows, columns = (
            torch.arange(count).to(like) * grid.stride + (grid.stride - 1) / 2 for count in grid.shape
        )
        u, v = shape.scaled(columns, rows)
        exponents = torch.arange(2 * self.degree + 1, device=like.device)
        self.x = u[:, None] ** exponents
        self.y = v[:, None] ** exponents
        self.of_x, self.of_y = torch.tensor(POWERS[: shape.terms], device=like.device).T

    def flow(self, parameters: Tensor) -> Tensor:
        """[B, 2, h, w] of parameters [B, 2K]."""
        side = self.degree + 1
        table = parameters.new_zeros(len(parameters), 2, side, side)
        table[..., self.of_y, self.of_x] = parameters.reshape(len(parameters), 2, -1)
        return self.y[:, :side] @ table @ self.x[:, :side].T

    def sums(self, images: Tensor) -> Tensor:
        """[B, m, 2d + 1, 2d + 1] of images [B, m, h, w]: sums times y^i x^j, d the degree of the field."""
        return self.y.T @ (images @ self.x)

    def by_basis(self, sums: Tensor) -> Tensor:
        """[B, m, K]: sums of the images times the basis."""
        return sums[..., self.of_y, self.of_x]

    def by_products(self, sums: Tensor) -> Tensor:
        """[B, m, K, K]: sums of the images times products of the basis with itself."""
        return sums[..., self.of_y[:, None] + self.of_y, self.of_x[:, None] + self.of_x]
