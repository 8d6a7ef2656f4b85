"""How many weights a baseline has, where they start, and the widths that fill a budget."""

from collections.abc import Callable, Iterable

import torch
from torch import nn

from codesign.errors import DomainError, check_seed, check_whole

MOST_WEIGHTS = 10**9


def channels(width: float, factor: float = 1.0) -> int:
    """Channels of a layer ``factor`` times as wide as the first: the nearest multiple of 4, at least 4."""
    return max(4, 4 * round(width * factor / 4))


def count_weights(module: nn.Module) -> int:
    """Number of learned numbers of a module."""
    return sum(p.numel() for p in module.parameters())


def start(module: nn.Module, seed: int, variance: float, heads: Iterable[nn.Module] = ()) -> None:
    """Draw convolutions from a normal distribution of variance ``variance`` / inputs of a weight (a hundredth
    of that in ``heads``), biases 0.

    The generator's seed is the only source. Modules on the meta device, built to be counted, are left alone.
    """
    generator = torch.Generator().manual_seed(check_seed(seed, "seed"))
    for part in module.modules():
        if (
            isinstance(part, (torch.nn.Conv2d, torch.nn.ConvTranspose2d))
            and part.weight.device.type != "meta"
        ):
            inputs = part.in_channels * part.kernel_size[0] * part.kernel_size[1]
            small = 0.1 if any(part is head for head in heads) else 1.0
            with torch.no_grad():
                part.weight.copy_(
                    torch.randn(part.weight.shape, generator=generator) * (small * (variance / inputs) ** 0.5)
                )
                if part.bias is not None:
                    part.bias.zero_()


def fill_budget(build: Callable[..., nn.Module], weights: int, inside: float = 8.0) -> tuple[float, int]:
    """Arguments (width, hidden) of the network with the fewest weights that is not below the budget.

    Args: build: function of width and hidden (channels inside the residual blocks, None for the usual number)
      that makes the network. weights: the budget. inside: the usual ``hidden`` over the width.
    Raises: DomainError when even the narrowest network is above the budget.
    """

    def counted(width, hidden=None):
        with torch.device("meta"):
            return count_weights(build(width=width, hidden=hidden))

    if check_whole(weights, "weights") > MOST_WEIGHTS:
        raise DomainError(f"a budget of {weights} weights is too large; at most {MOST_WEIGHTS} are possible.")
    if counted(1.0) > weights:
        raise DomainError(
            f"a budget of {weights} weights is too small; the narrowest network has {counted(1.0)}."
        )
    # widths in quarters
    low = 4
    high = 8
    while counted(high / 4) <= weights:
        low = high
        high = 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if counted(middle / 4) <= weights else (low, middle)
    width = low / 4
    hidden = channels(low / 4, inside)
    while counted(width, hidden) < weights:
        hidden += 4
    return width, hidden
