"""Stage "flow": what event flow costs. Closed form, refiner, plain and spiking networks at 256 x 256
pixels, the closed form on 32 windows of 64 x 64, and how cost grows from 128 to 1024 pixels a side.

Time of one call, batch of one, float32, the estimators in turns, one thread (two spin while they wait for
each other, which counts as processor time); memory in a process of its own that gives freed blocks back.
Networks are untrained: the same arithmetic. The spiking network runs as fast as its form allows
(docs/flow_baselines.md), on the volume of 8 bins that the others get; its published 10 are beside it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import drjit as dr
import torch

from codesign.flow import estimate_lk
from codesign.flow.baselines import ECN, FlowNetEvents, IDNet, SpikeFlowNet
from codesign.flow.baselines.parts import count_weights
from codesign.flow.refiner import Refiner
from codesign.types import EventVolume, FlowField
from studies.frame.bench import apart, peak_mb, turns
from studies.frame.run import Run
from studies.frame.show import Asked, Panel, asked, panels, table
from studies.frame.sweep import column, metrics, select
from studies.speed_error import Config

CLOSED = "closed form"
CELLS = "closed form with cells"
REFINER = "refiner"
PUBLISHED = "Spike-FlowNet form"
TEN_BINS = f"{PUBLISHED}, 10 bins"
KINDS = ("forward", "forward_backward")
SIZE_PX = 256
SIZES_PX = (128, 256, 512, 1024)
SMALL_PX = 64  # windows as loops that design a lens take them, so many at a time
WINDOWS = 32
ASKED_TIME = 1 / 10
ASKED_WEIGHTS = 1 / 25
ASKED_GROWTH = 0.2
# of the processor time of the published width's forward pass, 119 ms where these were asked for
ASKED_CLOSED = {"forward": 25 / 119, "forward_backward": 60 / 119}
# the same for the small windows: a third of what the closed form took before it ran on kernels of its own
# (117 and 305 of 170 ms, in one run)
ASKED_SMALL = {"forward": 117 / 170 / 3, "forward_backward": 305 / 170 / 3}


@dataclass(frozen=True)
class Entry:
    """An estimator: flow of a volume with ``bins`` bins, and its learned numbers."""

    estimate: Callable[[EventVolume], FlowField]
    bins: int = 8
    parameters: tuple[torch.nn.Parameter, ...] = ()

    @property
    def weights(self) -> int:
        return sum(p.numel() for p in self.parameters)

    def work(self, volume: EventVolume, kind: str) -> object:
        """One call: the flow alone, or with the gradient of its square with respect to volume and weights."""
        if kind == "forward":
            with torch.no_grad():
                return self.estimate(volume)
        counts = volume.counts.detach().requires_grad_()
        field = self.estimate(EventVolume(counts, volume.centroid_s, volume.collected_s))
        # confidences have weights that the flow does not use
        return torch.autograd.grad(
            field.flow_px.square().sum(), (counts, *self.parameters), allow_unused=True
        )


def entries(seed: int) -> dict[str, Entry]:
    """Name -> Entry; the networks untrained, the same at every call."""
    refiner = Refiner()
    budget = count_weights(refiner)
    networks = {
        REFINER: refiner,
        "FlowNetEvents, equal weights": FlowNetEvents.with_weights(budget, seed=seed),
        f"{PUBLISHED}, equal weights": SpikeFlowNet.with_weights(budget, seed=seed),
        "ECN, equal weights": ECN.with_weights(budget, seed=seed),
        "ECN": ECN(seed=seed),
        "IDNet, equal weights": IDNet.with_weights(budget, seed=seed),
        "IDNet, small": IDNet(seed=seed),
        PUBLISHED: SpikeFlowNet(seed=seed),
        TEN_BINS: SpikeFlowNet(bins=10, seed=seed),
    }
    return {CLOSED: Entry(estimate_lk), CELLS: Entry(partial(estimate_lk, model="local"))} | {
        name: Entry(network.eval(), network.config["bins"], tuple(network.parameters()))
        for name, network in networks.items()
    }


def scattered(size_px: int, bins: int, seed: int, windows: int = 1) -> EventVolume:
    """One event in 20 bins and pixels at random: what a call costs hardly depends on where they are."""
    mean = torch.full((windows, 2, bins, size_px, size_px), 0.05)
    spacing = 0.05 / bins
    return EventVolume(
        torch.poisson(mean, generator=torch.Generator().manual_seed(seed)),
        (torch.arange(bins, dtype=torch.float64) + 0.5) * spacing,
        torch.full((bins,), spacing, dtype=torch.float64),
    )


def cases(names, sizes_px) -> list[tuple[str, str, int]]:
    """(estimator, kind, size): backward at SIZE_PX only, the variant of 10 bins too."""
    return [
        (name, kind, size)
        for name in names
        for size in sizes_px
        for kind in KINDS
        if size == SIZE_PX or (kind == "forward" and name != TEN_BINS)
    ]


def memory(seed: int, sizes_px: list[int]) -> list[float]:
    """Largest memory of a call of every case beyond what was in use, MB."""
    table = entries(seed)
    found = []
    for name, kind, size in cases(table, sizes_px):
        entry = table[name]
        entry.work(scattered(64, entry.bins, seed), kind)  # what the first call loads
        found.append(peak_mb(partial(entry.work, scattered(size, entry.bins, seed), kind)))
    return found


def stage(run: Run[Config]) -> str:
    """Time and memory of flow estimators."""
    seed = run.config.seed
    rounds = 1 if run.config.quick else 5
    threads = torch.get_num_threads(), dr.thread_count()
    torch.set_num_threads(1)
    dr.set_thread_count(1)
    sizes = SIZES_PX[:2] if run.config.quick else SIZES_PX
    estimators = entries(seed)
    works = {
        (name, kind, size): partial(estimators[name].work, scattered(size, estimators[name].bins, seed), kind)
        for name, kind, size in cases(estimators, sizes)
    }
    windows = scattered(SMALL_PX, 8, seed, WINDOWS)
    small = {
        (name, kind): partial(estimators[name].work, windows, kind)
        for name in (CLOSED, CELLS)
        for kind in KINDS
    }
    usual = {case: work for case, work in works.items() if case[2] == SIZE_PX} | small
    other = {case: work for case, work in works.items() if case not in usual}
    with run.progress(rounds * len(usual) + 2 * len(other) + 1, "flow") as progress:
        found = turns(usual, rounds, repeats=2, after_each=progress.advance)
        found |= turns(other, 2, repeats=2, warm=0, after_each=progress.advance)
        allocator = {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}
        peaks = apart(memory, seed, sizes, environment=allocator)
        progress.advance()
    torch.set_num_threads(threads[0])
    dr.set_thread_count(threads[1])
    rows = []
    for case, peak in zip(works, peaks, strict=True):
        name, kind, size = case
        entry = {"estimator": name, "kind": kind, "size_px": size, "weights": estimators[name].weights}
        times = {"wall_ms": 1e3 * found[case].wall, "cpu_ms": 1e3 * found[case].cpu, "peak_mb": peak}
        rows.append(entry | times | {"cpu_ns_per_pixel": 1e9 * found[case].cpu / size**2})
    run.record(**metrics(rows, "estimator", "kind", "size_px", prefix="flow"))
    for (name, kind), timing in ((case, found[case]) for case in small):
        run.record(**timing.metrics(f"{name.replace(' ', '_')}_{kind}_{WINDOWS}_windows_{SMALL_PX}px"))
    titles = {"wall_ms": "wall, ms", "cpu_ms": "CPU-ms", "peak_mb": "peak, MB"}
    run.section(
        "Flow estimators", "Backward: gradient of volume and weights. Peak: memory beyond what was in use."
    )
    run.table(
        f"One call, {SIZE_PX} x {SIZE_PX} pixels, medians",
        *table(
            select(rows, size_px=SIZE_PX), estimator="estimator", kind="work", weights="weights", **titles
        ),
    )
    grown = [row for row in select(rows, kind="forward") if row["estimator"] != TEN_BINS]
    titles |= {"cpu_ns_per_pixel": "CPU-ns per pixel"}
    run.table("Forward, by size", *table(grown, estimator="estimator", size_px="px a side", **titles))
    charts = []
    for key, label in (("wall_ms", "forward call, ms"), ("peak_mb", "peak memory, MB")):
        lines = {name: (sizes, column(grown, key, estimator=name)) for name in estimators if name != TEN_BINS}
        charts.append(Panel(lines, "pixels a side", label, "xy"))
    run.figure(panels(*charts), "flow_growth", "Cost of a forward call against image size.")
    return asked(run, judged(estimators, found, sizes), "Flow estimators, ratios by the processor", "wall")


def judged(estimators, found, sizes) -> list[Asked]:
    """What is asked is asked of processor time; the ratio by the clock stands beside it."""
    peer = found[PUBLISHED, "forward", SIZE_PX]

    def ratio(what, timing, other, per=1.0, **asked):
        return Asked(what, timing.cpu / other.cpu / per, beside=timing.wall / other.wall / per, **asked)

    over = f"over {PUBLISHED} forward"
    figures = [ratio(f"refiner {over}", found[REFINER, "forward", SIZE_PX], peer, most=ASKED_TIME)]
    share = estimators[REFINER].weights / estimators[PUBLISHED].weights
    figures.append(Asked(f"weights, refiner over {PUBLISHED}", share, most=ASKED_WEIGHTS))
    for kind in KINDS:
        whole, windows = found[CLOSED, kind, SIZE_PX], found[CLOSED, kind]
        figures.append(ratio(f"{CLOSED} {kind} {over}", whole, peer, most=ASKED_CLOSED[kind]))
        what = f"{CLOSED} {kind}, {WINDOWS} windows of {SMALL_PX} px, {over}"
        figures.append(ratio(what, windows, peer, most=ASKED_SMALL[kind]))
    for name in (CLOSED, CELLS, REFINER):
        first, last = (found[name, "forward", size] for size in (sizes[0], sizes[-1]))
        what = f"{name}, per pixel at {sizes[-1]} px over {sizes[0]} px"
        ends = {"least": 1 - ASKED_GROWTH, "most": 1 + ASKED_GROWTH}
        figures.append(ratio(what, last, first, (sizes[-1] / sizes[0]) ** 2, **ends))
    return figures
