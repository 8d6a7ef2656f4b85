"""The estimators whose cost is compared, and one process that measures their memory: python -m
studies.flow_cost.table SEED SIZE... Prints JSON."""

import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import codesign  # noqa: F401  (first: it sets OpenMP's wait policy before torch is imported)

import torch  # isort: skip

from codesign.flow import estimate_lk
from codesign.flow.baselines import ECN, FlowNetEvents, IDNet, SpikeFlowNet
from codesign.flow.baselines.parts import count_weights
from codesign.flow.refiner import Refiner
from codesign.types import EventVolume, FlowField
from studies.flow_cost.steps import StepByStep
from studies.lens_bench.tracers import forget_peak, peak

CLOSED = "closed form"
CELLS = "closed form with cells"
REFINER = "refiner"
PUBLISHED = "Spike-FlowNet form"
TEN_BINS = f"{PUBLISHED}, 10 bins"
STEPS = f"{PUBLISHED}, step by step"
SIZE_PX = 256
KINDS = ("forward", "forward_backward")
SMALL_PX = 64  # windows as loops that design a lens take them, so many at a time
WINDOWS = 32


@dataclass(frozen=True)
class Entry:
    """An estimator: name -> flow of a volume with ``bins`` bins, and its learned numbers."""

    estimate: Callable[[EventVolume], FlowField]
    bins: int
    parameters: tuple[torch.nn.Parameter, ...] = ()

    @property
    def weights(self):
        return sum(p.numel() for p in self.parameters)

    def work(self, volume, kind):
        """One call: the flow alone, or with the gradient of its square with respect to volume and weights."""
        if kind == "forward":
            with torch.no_grad():
                return self.estimate(volume)
        counts = volume.counts.detach().requires_grad_()
        loss = (
            self.estimate(EventVolume(counts, volume.centroid_s, volume.collected_s)).flow_px.square().sum()
        )
        return torch.autograd.grad(
            loss, (counts, *self.parameters), allow_unused=True
        )  # confidences have weights that the flow does not use


def kinds(name):
    """What is timed of an estimator: the step-by-step form goes forward only."""
    return KINDS[:1] if name == STEPS else KINDS


def grown(name):
    """Whether an estimator is measured at every size; variants of the spiking form are at SIZE_PX only."""
    return name not in (TEN_BINS, STEPS)


def entries(seed):
    """Name -> Entry; the networks untrained, the same at every call."""
    refiner = Refiner()
    budget = count_weights(refiner)
    networks = {
        REFINER: refiner,
        "FlowNetEvents, equal weights": FlowNetEvents.with_weights(budget, seed=seed),
        "Spike-FlowNet form, equal weights": SpikeFlowNet.with_weights(budget, seed=seed),
        "ECN, equal weights": ECN.with_weights(budget, seed=seed),
        "ECN": ECN(seed=seed),
        "IDNet, equal weights": IDNet.with_weights(budget, seed=seed),
        "IDNet, small": IDNet(seed=seed),
        PUBLISHED: SpikeFlowNet(seed=seed),
        TEN_BINS: SpikeFlowNet(bins=10, seed=seed),
        STEPS: StepByStep(seed=seed),
    }
    found = {CLOSED: Entry(estimate_lk, 8), CELLS: Entry(partial(estimate_lk, model="local"), 8)}
    return found | {
        name: Entry(network.eval(), network.config["bins"], tuple(network.parameters()))
        for name, network in networks.items()
    }


def scattered(size_px, bins, seed, windows=1):
    """One event in 20 bins and pixels at random: what a call costs hardly depends on where they are."""
    counts = torch.poisson(
        torch.full((windows, 2, bins, size_px, size_px), 0.05), generator=torch.Generator().manual_seed(seed)
    )
    spacing = 0.05 / bins
    return EventVolume(
        counts,
        (torch.arange(bins, dtype=torch.float64) + 0.5) * spacing,
        torch.full((bins,), spacing, dtype=torch.float64),
    )


def memory(seed, sizes_px):
    """Largest memory of a call beyond what was in use, bytes: rows (name, kind, size). Backward at SIZE_PX
    only."""
    rows = []
    for name, entry in entries(seed).items():
        for size in sizes_px if grown(name) else (SIZE_PX,):
            for kind in kinds(name) if size == SIZE_PX else KINDS[:1]:
                entry.work(scattered(64, entry.bins, seed), kind)  # what the first call loads
                volume = scattered(size, entry.bins, seed)
                before = forget_peak()
                result = entry.work(volume, kind)
                rows.append((name, kind, size, peak() - before))
                del result
    return rows


if __name__ == "__main__":
    torch.set_num_threads(min(2, os.cpu_count() or 1))
    print(json.dumps(memory(int(sys.argv[1]), [int(size) for size in sys.argv[2:]])))
