"""The parameters of a Module as groups of flat vectors, for a certificate of each group."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from codesign.errors import DomainError

Call = Callable[..., Any]


def by_group(
    module: nn.Module, loss: Callable[[Call], Tensor], groups: Mapping[str, str]
) -> tuple[Callable[[dict[str, Tensor]], Tensor], dict[str, Tensor]]:
    """What ``certify`` takes, for a Module.

    Args:
      module: any Module, such as a System. loss: gets the module as a function of its inputs,
        returns a scalar, for example ``lambda system: system(batch).loss``.
      groups: group -> what the names of its parameters start with, for example {"lens": "lens.",
        "network": "flow."}; only parameters that ask for gradients count.
    Returns: fn and params: a function of {group: flat vector}, and the vectors as the module has
      them now.
    Raises: DomainError for a group without parameters.

    >>> layer = nn.Linear(2, 1)
    >>> fn, params = by_group(layer, lambda f: f(torch.ones(1, 2)).sum(), {"weights": "weight", "bias": "bias"})
    >>> {name: value.shape[0] for name, value in params.items()}
    {'weights': 2, 'bias': 1}
    """
    members = {
        group: {
            name: p
            for name, p in module.named_parameters()
            if p.requires_grad and name.startswith(prefix)
        }
        for group, prefix in groups.items()
    }
    for group, found in members.items():
        if not found:
            raise DomainError(
                f"group '{group}': no parameter that asks for a gradient starts with '{groups[group]}'; there are "
                f"{', '.join(name for name, p in module.named_parameters() if p.requires_grad) or 'none'}."
            )

    def fn(p: dict[str, Tensor]) -> Tensor:
        tensors = {}
        for group, vector in p.items():
            sizes = [q.numel() for q in members[group].values()]
            for (name, q), part in zip(members[group].items(), vector.split(sizes), strict=True):
                tensors[name] = part.reshape(q.shape).to(q.dtype)
        return loss(lambda *inputs, **named: functional_call(module, tensors, inputs, named))

    flat = {
        g: torch.cat([q.detach().reshape(-1) for q in found.values()])
        for g, found in members.items()
    }
    return fn, flat
