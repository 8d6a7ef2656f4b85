"""A processor that rounds as badly as one may."""

import math

import torch
from torch.overrides import TorchFunctionMode

PRODUCTS = {torch.conv2d, torch.matmul, torch.Tensor.matmul, torch.Tensor.__matmul__}
SMALL = 400  # batches of smaller products are plain loops of torch's own


class RoundsByPlace(TorchFunctionMode):
    """Matrix products and convolutions round by the place of a number in the result and by the address of
    what is multiplied, as BLAS may, and more coarsely.

    What keeps its bits under it gives every product the same shapes at the same alignment.
    """

    def __init__(self, coarseness=1e-4):
        super().__init__()
        self.coarseness = coarseness

    def __torch_function__(self, func, types, args=(), kwargs=None):
        found = func(*args, **(kwargs or {}))
        if func not in PRODUCTS or (
            found.ndim > 2
            and math.prod(found.shape[-2:]) * args[0].shape[-1] < SMALL
            and func is not torch.conv2d
        ):
            return found
        place = torch.arange(found.numel()).reshape(found.shape) % 97
        aside = sum(value.data_ptr() % 64 for value in args[:2])
        return found * (1 + self.coarseness * (place + aside).to(found))
