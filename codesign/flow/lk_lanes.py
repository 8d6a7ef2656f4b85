"""What the kernels of the closed form share: the samples of an image, and opaque numbers for lanes of them."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from codesign import backend


@dataclass(frozen=True)
class Grid:
    """Samples of an image of height x width pixels: the centres of its squares of stride x stride pixels."""

    height: int
    width: int
    stride: int = 1

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns; a square that sticks out at the lower or right border has no sample."""
        return self.height // self.stride, self.width // self.stride


class Lanes:
    """One lane of drjit per sample and image, and numbers that need no new kernel when they change."""

    def __init__(self, like: Tensor, grid: Grid) -> None:
        """Args: like: [B, ...], tells batch, device and precision."""
        import drjit as dr

        self.dr: Any = dr
        self.arr = backend.arrays(like.device.type, like.dtype)
        self.double = backend.arrays(like.device.type, torch.float64).Float
        self.images = len(like)
        self.rows, self.columns = grid.shape
        self.samples = self.rows * self.columns
        self.area = self.count(self.samples)
        self.across = self.count(self.columns)

    def count(self, value: int) -> Any:
        return self.dr.opaque(self.arr.UInt32, value)

    def number(self, value: float) -> Any:
        return self.dr.opaque(self.arr.Float, value)

    def lanes(self, count: int) -> Any:
        return self.dr.arange(self.arr.UInt32, count)

    def load(self, tensor: Tensor) -> Any:
        return self.arr.Float(tensor.detach().contiguous().reshape(-1))

    def take(self, flat: Any, index: Any) -> Any:
        return self.dr.gather(self.arr.Float, flat, index)

    def split(self, index: Any, size: int) -> tuple[Any, Any]:
        """Quotient and remainder by a size. Processors divide no vectors of whole numbers; the half keeps the
        rounded quotient off the next whole number."""
        inverse = self.dr.opaque(self.double, 1 / size)
        quotient = self.arr.UInt32((self.double(index) + 0.5) * inverse)
        return quotient, index - quotient * self.count(size)

    def empty(self, count: int) -> Any:
        """Memory to be filled by ``put``; drjit hands the same pages out again and again."""
        target = self.dr.empty(self.arr.Float, count)
        self.dr.eval(target)
        return target

    def put(self, target: Any, value: Any, index: Any) -> None:
        self.dr.scatter(target, value, index, mode=self.dr.ReduceMode.NoConflicts)

    def loop(self, first: Any, end: Any, body: Any, *carried: Any) -> list[Any]:
        """carried = body(k, *carried) for k from ``first`` to ``end``, per lane."""
        _, *carried = self.dr.while_loop(
            (first, *carried),
            lambda k, *_: k < end,
            lambda k, *carried: (k + 1, *body(k, *carried)),
            mode="symbolic",
        )
        return carried

    def tensors(self, shape: tuple[int, ...], *values: Any) -> list[Tensor]:
        """Compute the values, as tensors of one shape that own their memory."""
        self.dr.eval(values)
        self.dr.sync_thread()
        return [value.torch().reshape(shape) for value in values]
