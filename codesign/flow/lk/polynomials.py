"""Polynomial flow fields: their basis, the prior on their parameters, the step from mid-interval to
the start, the spread of the flow; values and sums on the samples of a grid.

A field is u = sum p_k b_k(x, y), v = sum q_k b_k(x, y) with b = 1, x, y, x^2, xy, y^2 on
coordinates that reach from -1 to 1 along the longer side. Parameters are [B, 2K]: p_1..p_K,
q_1..q_K.
"""

from functools import cached_property, lru_cache

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from codesign.flow.lk.lanes import Grid

TERMS = {"constant": 1, "affine": 3, "quadratic": 6}
POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # of x and y in the basis
# expected flow at the border from these terms, over that of the constant: cameras mostly shift,
# turn and approach
AFFINE = 0.35
SHEAR = 0.25
QUADRATIC = 0.15
POOL = 8  # px a side over which a flow is averaged before it is fitted
RIDGE = 1e-6  # of the mean diagonal: tiny images have fewer pixels than parameters
FIXED_POINT_STEPS = 4  # each gains a factor of half the flow's gradient, some 0.03 per px and px


class Polynomials:
    """Fields of one model over an image of height x width pixels.

    unit: [2K, 2K], equations (``_equations``), second_moments: [2K, 2K] of the basis over the square
      [-1, 1]^2, for both components, one: the unit matrix [2K, 2K]; float64.
    """

    def __init__(
        self,
        model: str,
        height: int,
        width: int,
        prior_px: float = 1.0,
        device: torch.device | None = None,
    ) -> None:
        self.model = model
        self.terms = TERMS[model]
        self.powers = torch.tensor(POWERS[: self.terms], device=device)
        self.degree = int(self.powers.sum(1).max())
        self.height = height
        self.width = width
        self.half = max(height, width) / 2
        # unit [2K, 2K]: parameters = unit @ numbers that are independent and of variance 1
        self.unit, self.equations, self.second_moments, self.one = (
            torch.from_numpy(each).to(device=device) for each in _by_prior(model, float(prior_px))
        )

    def scaled(self, x_px: Tensor, y_px: Tensor) -> tuple[Tensor, Tensor]:
        """Pixel coordinates to coordinates of the polynomials."""
        return (x_px - (self.width - 1) / 2) / self.half, (y_px - (self.height - 1) / 2) / self.half

    def basis(self, u: Tensor, v: Tensor, dim: int = 0) -> Tensor:
        """[..., K at dim, ...]."""
        return torch.stack([torch.ones_like(u), u, v, u * u, u * v, v * v][: self.terms], dim)

    def mean_square(self, parameters: Tensor) -> Tensor:
        """Mean squared length [B] of the flow over the square [-1, 1]^2."""
        return ((parameters @ self.second_moments.to(parameters)) * parameters).sum(1)

    def fitted(self, flow_px: Tensor, start: Tensor) -> Tensor:
        """Numbers [B, 2K], float64, for which unit @ numbers are the parameters whose flow on the
        pixels of the start is nearest to this one, px per way.

        start: [B] place of the start on the way, -1/2 for even motion.
        """
        side = max(1, min(POOL, self.height // 2, self.width // 2))
        flow = avg_pool2d(flow_px.double(), side)
        y, x = (torch.arange(count).to(flow) * side + (side - 1) / 2 for count in flow.shape[2:])
        back = -start.to(flow)[:, None, None]
        places = self.basis(*self.scaled(x + back * flow[:, 0], y[:, None] + back * flow[:, 1]), 1)
        by_unit = places.flatten(2).mT[:, None] @ self.unit.unflatten(0, (2, -1))  # [B, 2, n, 2K]
        design = by_unit.flatten(1, 2)
        normal = design.mT @ design
        ridge = RIDGE * normal.diagonal(dim1=1, dim2=2).mean(1)[:, None, None]
        right = design.mT @ flow.flatten(1)[:, :, None]
        return torch.linalg.solve(normal + ridge * self.one, right)[..., 0]

    @cached_property
    def of_squares(self) -> tuple[tuple[int, int], ...]:
        """Powers of x and y in products of two terms of the basis."""
        most = 2 * self.degree
        return tuple((x, degree - x) for degree in range(most + 1) for x in range(degree, -1, -1))

    def squares(self, covariance: Tensor) -> Tensor:
        """``covariance`` as coefficients [3, B, M] of polynomials in the powers of
        ``of_squares``."""
        k = self.terms
        sums = (self.powers[:, None] + self.powers).flatten(0, 1)
        powers = torch.tensor(self.of_squares, device=sums.device)
        place = (sums[:, None] == powers).all(2).to(covariance)  # [K^2, M]
        blocks = torch.stack([covariance[:, :k, :k], covariance[:, :k, k:], covariance[:, k:, k:]])
        return blocks.flatten(2) @ place


@lru_cache(maxsize=64)
def _by_prior(model, prior_px):
    """What ``Polynomials`` hold of a model, as arrays: no mode of torch that a caller is in stays
    with them."""
    powers = torch.tensor(POWERS[: TERMS[model]])
    unit = torch.linalg.cholesky(torch.linalg.inv(_prior_precision(len(powers), prior_px)))
    sums = powers[:, None] + powers
    moments = (sums % 2 == 0).all(2) / (sums + 1).prod(2).double()
    found = unit, _equations(powers, unit), torch.block_diag(moments, moments), torch.eye(len(unit))
    return [each.double().cpu().numpy() for each in found]


def _prior_precision(k, prior_px):
    """Inverse covariance [2K, 2K] of the parameters, per px^2: constant, divergence, rotation,
    two shears, quadratic terms, all independent."""
    unit = torch.eye(2 * k, dtype=torch.float64)
    precision = torch.zeros(2 * k, 2 * k, dtype=torch.float64)
    independent = [(unit[0], 1.0), (unit[k], 1.0)]
    if k >= 3:
        ux = unit[1]
        uy = unit[2]
        vx = unit[k + 1]
        vy = unit[k + 2]
        independent += [
            ((ux + vy) / 2, AFFINE),
            ((vx - uy) / 2, AFFINE),
            ((ux - vy) / 2, SHEAR),
            ((vx + uy) / 2, SHEAR),
        ]
    if k == 6:
        independent += [(unit[i + offset], QUADRATIC) for i in (3, 4, 5) for offset in (0, k)]
    for direction, relative in independent:
        precision += torch.outer(direction, direction) / (relative * prior_px) ** 2
    return precision


def _equations(powers, unit):
    """Sums over an image to normal equations, which are linear in them:
    [8 s^2, 8 K^2 + 2 K + 2], float64.

    Rows: the sums of ``slopes.sums_along`` times y^i x^j, i, j < s = 2 degree + 1. Columns: in
    units of the prior the matrix of the slopes and that of events as slopes along x and y, [2K,
    2K] each, and the pull [2K]; then energy of the temporal slopes, and events.
    """
    side = 2 * int(powers.sum(1).max()) + 1
    one = torch.eye(8 * side**2, dtype=torch.float64)
    sums = one.unflatten(1, (8, side, side))
    x, y = powers.T
    xx, xy, yy, events = sums[:, [0, 1, 2, 7]][..., y[:, None] + y, x[:, None] + x].unbind(1)
    none = torch.zeros_like(events)
    slopes = torch.cat([torch.cat([xx, xy], 2), torch.cat([xy, yy], 2)], 1)
    scattered = torch.cat([torch.cat([events, none], 2), torch.cat([none, events], 2)], 1)
    pull = -sums[:, 3:5][..., y, x].flatten(1)
    matrices = [(unit.T @ matrix @ unit).flatten(1) for matrix in (slopes, scattered)]
    return torch.cat([*matrices, pull @ unit, sums[:, 5, 0, :1], sums[:, 7, 0, :1]], 1)


class Moments:
    """Powers of x and y at the samples of ``grid``, up to twice the degree of ``shape``: values of
    fields, and sums of images times powers. Powers are separable, so each costs two small matrix
    products."""

    def __init__(self, shape: Polynomials, grid: Grid, like: Tensor) -> None:
        """Args: like: tells precision and device."""
        self.side = shape.degree + 1
        self.x, self.y, self.of_x, self.of_y, self.place = (
            torch.from_numpy(each).to(like.device)
            for each in _powers(shape.model, grid, like.dtype, like.device)
        )

    def flow(self, parameters: Tensor) -> Tensor:
        """[B, 2, h, w] of parameters [B, 2K]."""
        table = parameters.unflatten(1, (2, -1)) @ self.place
        return self.of_y @ table.unflatten(2, (self.side, self.side)) @ self.of_x

    def sums(self, images: Tensor) -> Tensor:
        """[B, m s^2] of images [B, m, h, w]: sums times y^i x^j, i, j < s = 2 degree + 1."""
        return ((self.y.T @ images) @ self.x).flatten(1)


@lru_cache(maxsize=64)
def _powers(model, grid, dtype, device):
    """What ``Moments`` hold, as arrays: powers of x and y at the samples of ``grid``, those of the
    basis once more, and where each parameter stands in a table of powers of y and x."""
    shape = Polynomials(model, grid.height, grid.width, device=device)
    side = shape.degree + 1
    rows, columns = (
        torch.arange(count, device=device).to(dtype) * grid.stride + (grid.stride - 1) / 2
        for count in grid.shape
    )
    u, v = shape.scaled(columns, rows)
    exponents = torch.arange(2 * shape.degree + 1, device=device)
    x, y = u[:, None] ** exponents, v[:, None] ** exponents
    across, down = shape.powers.T
    place = torch.eye(side**2, device=device).to(dtype)[side * down + across]
    found = x, y, x[:, :side].T.contiguous(), y[:, :side].contiguous(), place
    return [each.cpu().numpy() for each in found]
