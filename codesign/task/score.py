"""By what a design is judged: errors of the velocity in the units of the task, one component and one sample at a
time."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from codesign.errors import DomainError, ShapeError
from codesign.place.criterion import LINEAR, NAMES

PERCENTILES = (5, 10, 25, 50, 75, 90, 95)


@dataclass(frozen=True)
class VelocityErrors:
    """error: [N, K] estimate less truth, m/s and rad/s. speed_m_s: [N] of the body. axes: K of the six velocities."""

    error: Tensor
    speed_m_s: Tensor
    axes: tuple[int, ...]

    def unit(self, m_s: float = 0.05, share: float = 0.1, rad_s: float = 0.15) -> Tensor:
        """[N, K]: the error that counts 1: ``m_s`` plus a share of the speed, and ``rad_s``."""
        linear = (m_s + share * self.speed_m_s)[:, None].expand(self.error.shape)
        return torch.where(torch.tensor(self.axes) < LINEAR, linear, rad_s)

    def squared(self, **unit: float) -> Tensor:
        """[N]: mean over the velocities of the squared error in units of ``unit``."""
        return (self.error / self.unit(**unit)).square().mean(1)

    def bounded(self, **unit: float) -> Tensor:
        """[N] in 0..1: q / (1 + q) of ``squared``, in which a lost sample counts 1 and no more."""
        squared = self.squared(**unit)
        return squared / (1 + squared)

    def table(self) -> dict[str, dict[str, float]]:
        """Name of the velocity -> rms, bias, median, and percentiles of the size of its error; of linear ones also
        the median over the speed."""
        found = {}
        for column, axis in zip(self.error.detach().T, self.axes, strict=True):
            size = column.abs()
            unit = "m_s" if axis < LINEAR else "rad_s"
            row = {f"rms_{unit}": float(size.square().mean().sqrt()), f"bias_{unit}": float(column.mean())}
            levels = torch.tensor(PERCENTILES, dtype=size.dtype) / 100
            for percent, value in zip(PERCENTILES, torch.quantile(size, levels).tolist(), strict=True):
                row[f"p{percent}_{unit}"] = value
            if axis < LINEAR:
                row["median_over_speed"] = float((size / self.speed_m_s.clamp_min(1e-12)).median())
            found[NAMES[axis]] = row
        return found


def velocity_errors(velocity: Tensor, twist: Tensor, axes: Sequence[int]) -> VelocityErrors:
    """Errors of estimated velocities.

    Args: velocity: [N, K] estimated, m/s and rad/s. twist: [N, 6] of the body: m/s forward, left, up, rad/s about
      these axes. axes: which K of the six were estimated.
    Gradient: velocity, twist. Raises: ShapeError where they do not fit; DomainError for other axes.

    >>> twist = torch.tensor([[2.0, 0.0, 0.0, 0.0, 0.0, 0.5]])
    >>> errors = velocity_errors(torch.tensor([[1.75, 0.0, 0.5]]), twist, (0, 1, 5))
    >>> errors.squared().tolist()  # a quarter of a metre per second where 0.05 + 0.1 * 2 count 1
    [0.3333333432674408]
    """
    if not axes or not set(axes) <= set(range(len(NAMES))):
        raise DomainError(f"axes = {tuple(axes)}; choose from 0 to 5: {', '.join(NAMES)}.")
    if twist.shape != (len(velocity), len(NAMES)) or velocity.shape != (len(twist), len(axes)):
        raise ShapeError(
            f"velocities are {list(velocity.shape)}, twists {list(twist.shape)}; give [N, {len(axes)}] and [N, 6]."
        )
    speed = torch.linalg.vector_norm(twist[:, :LINEAR], dim=1)
    return VelocityErrors(velocity - twist[:, list(axes)], speed, tuple(axes))
