"""One or several processes that train the same network, each on its share of every batch."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from codesign.errors import DomainError


@dataclass(frozen=True)
class Ranks:
    """This process among ``count``, and the device it computes on."""

    rank: int
    count: int
    device: torch.device

    def mine(self, indices: Sequence[int]) -> Sequence[int]:
        """This process's share of the sample numbers of a batch."""
        return indices[self.rank :: self.count]

    def sum(self, *numbers: float) -> list[float]:
        """Sums over all processes, the same on each."""
        if self.count == 1:
            return list(numbers)
        total = torch.tensor(numbers, dtype=torch.float64)
        dist.all_reduce(total)
        return total.tolist()

    def average_gradients(self, parameters: Sequence[Tensor]) -> None:
        """Replace every gradient by its mean over all processes, 0 where one has none; what none has
        a gradient of stays without."""
        if self.count == 1:
            return
        reached = parameters[0].new_tensor([parameter.grad is not None for parameter in parameters])
        dist.all_reduce(reached)
        gradients = []
        for parameter, count in zip(parameters, reached.tolist(), strict=True):
            if count:
                if parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)
                gradients.append(parameter.grad)
        flat = torch.cat([gradient.reshape(-1) for gradient in gradients])
        dist.all_reduce(flat)
        flat /= self.count
        parts = flat.split([gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view_as(gradient))

    def tell(self, value: Any = None) -> Any:
        """What the first process gives, on every process."""
        if self.count == 1:
            return value
        held = [value]
        dist.broadcast_object_list(held, src=0, device=torch.device("cpu"))
        return held[0]

    def on(self, device_type: str) -> "Ranks":
        """The same process with its device: the processor, or the graphics card of its number on
        this machine; the one that CUDA_VISIBLE_DEVICES names, which kernels need.

        Raises: DomainError when a process has no graphics card of its own.
        """
        if device_type != "cuda":
            return self
        alone = os.environ.get("CUDA_VISIBLE_DEVICES", ",").count(",") == 0
        local = 0 if alone else int(os.environ.get("LOCAL_RANK", "0"))
        if local >= torch.cuda.device_count():
            raise DomainError(
                f"process {local} of this machine has no CUDA device ({torch.cuda.device_count()} present); "
                "start fewer processes, or give --device cpu."
            )
        torch.cuda.set_device(local)
        return replace(self, device=torch.device("cuda", local))

    def leave(self) -> None:
        """End the connection."""
        if self.count > 1:
            dist.barrier()  # nobody hangs up while another still speaks
            dist.destroy_process_group()


ALONE = Ranks(0, 1, torch.device("cpu"))
"""The one process of a training that is not shared."""


def place() -> tuple[int, int]:
    """(rank, number of processes) that torchrun gave this process; (0, 1) without torchrun."""
    return int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))


def join() -> Ranks:
    """Connect to the other processes that torchrun started: gloo for tensors on the processor, nccl
    for those on CUDA. Device: the processor, until ``on``."""
    rank, count = place()
    if count > 1:
        backend = (
            "cpu:gloo,cuda:nccl"
            if torch.cuda.is_available() and dist.is_nccl_available()
            else "gloo"
        )
        # the first process validates and draws alone meanwhile
        dist.init_process_group(backend, timeout=timedelta(hours=1))
    return Ranks(rank, count, torch.device("cpu"))
