"""Positive values that are learnt, as unconstrained variables with steps of a natural size."""

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor, nn

from codesign.errors import DomainError, shown
from codesign.events.entry import check_positive

STEP = 0.1  # a unit step of a variable changes its value by a tenth: exp(0.1) - 1 = 10.5 %


class PositiveValues(nn.Module):
    """Positive values by name, each start exp(0.1 v) with a variable v in ``raw`` that is 0 at first.

    start: value > 0 by name. Whatever the unit, a unit step of a variable is about 10 % of its value.
    """

    def __init__(self, start: Mapping[str, float]):
        super().__init__()
        if not isinstance(start, Mapping):
            raise DomainError(
                f"start is {shown(start)}; values by name are needed, such as {{'tau_s': 0.01}}."
            )
        start = {name: check_positive(value, name) for name, value in start.items()}
        zeros = [(name, nn.Parameter(torch.zeros((), dtype=torch.float64))) for name in start]
        self.raw = nn.ParameterDict(zeros)
        for name, value in start.items():  # buffers, so that what is saved is complete
            self.register_buffer(f"start_{name}", torch.tensor(value, dtype=torch.float64))

    def __getitem__(self, name: str) -> Tensor:
        """The value as it is now, a 0-dim float64 tensor. Gradient: its variable."""
        if not isinstance(name, str) or name not in self.raw:
            raise DomainError(f"no value is called {shown(name)}; there are {', '.join(self.raw)}.")
        return getattr(self, f"start_{name}") * (STEP * self.raw[name]).exp()

    def __contains__(self, name: str) -> bool:
        return name in self.raw

    def __iter__(self) -> Iterator[str]:
        return iter(self.raw)
