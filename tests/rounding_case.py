"""A processor that rounds as badly as one may."""

import math

import torch
from torch.utils._python_dispatch import TorchDispatchMode

aten = torch.ops.aten
PRODUCTS = {
    *(aten.mm, aten.bmm, aten.addmm, aten.baddbmm, aten.mv, aten.addmv, aten.dot),
    aten.convolution,
}
TRANSCENDENTAL = {
    *(aten.log, aten.log_, aten.exp, aten.exp_, aten.log1p, aten.expm1),
    *(aten.sin, aten.cos, aten.tanh),
}
LOOPS = 400  # batches of smaller matrices are multiplied by plain loops of torch's own
PERIOD = 7


class RoundsByPlace(TorchDispatchMode):
    """Matrix products, convolutions and functions such as log round by the place of a number in the
    result and by where in memory their input begins, as the libraries behind them may: by up to 6
    eps.

    What keeps its bits under it gives each of these operations the same shapes at the same
    alignment.
    """

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        found = func(*args, **(kwargs or {}))
        packet = func.overloadpacket
        if packet not in PRODUCTS | TRANSCENDENTAL or not found.is_floating_point():
            return found
        if packet is aten.bmm and math.prod(found.shape[-2:]) * args[0].shape[-1] < LOOPS:
            return found
        aside = sum(value.data_ptr() % 64 for value in args if isinstance(value, torch.Tensor))
        place = (torch.arange(found.numel(), device=found.device) + aside) % PERIOD
        eps = torch.finfo(found.dtype).eps
        return found.mul_(1 + eps * place.reshape(found.shape).to(found))
