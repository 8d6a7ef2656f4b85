"""Stage "flow": what event flow costs."""

import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import drjit as dr
import torch

from codesign.flow import Tracker, estimate_lk, load
from codesign.flow.baselines import FlowNetEvents, SpikeFlowNet
from codesign.flow.baselines.parts import count_weights
from codesign.flow.refiner import Refiner
from codesign.types import EventStream, EventVolume
from studies.frame.bench import cost
from studies.frame.run import Run
from studies.frame.show import Asked, tabulate
from studies.frame.sweep import sweep
from studies.speed_error import Config
from studies.train_flow.peers import ECN, IDNet

CLOSED = "closed form"
CELLS = "closed form with cells"
REFINER = "refiner"
PUBLISHED = "Spike-FlowNet form"
SIZE_PX = 256
SIZES_PX = (128, 256, 512, 1024)
SMALL = (64, 32)  # pixels a side and number of windows, as loops that design a lens take them
BOTH = ("forward", "forward_backward")
# of the processor time of the published width's forward pass, 119 ms where these were asked for;
# the small windows: a third of what the closed form took before it ran on kernels of its own
ASKED_FLOW = {
    (REFINER, "forward", SIZE_PX, 1): 1 / 10,
    (CLOSED, "forward", SIZE_PX, 1): 25 / 119,
    (CLOSED, "forward_backward", SIZE_PX, 1): 60 / 119,
    (CLOSED, "forward", *SMALL): 117 / 170 / 3,
    (CLOSED, "forward_backward", *SMALL): 305 / 170 / 3,
}
ASKED_GROWTH = 0.2
WINDOW_S = 1 / 30  # of a live stream
WINDOWS, WARM_UP = 12, 3
EVENTS = 20_000  # of a window: a DAVIS346 before things that move
LIVE = {f"{width} x {height}": (height, width) for height, width in ((180, 240), (260, 346))}


def stage(run: Run[Config]) -> list[Asked]:
    """Closed form, refiner, plain and spiking networks at 256 x 256 pixels, the closed form on 32
    windows of 64 x 64 pixels, and how cost grows with size. One call in float32 by one thread (two
    spin while they wait for each other, which counts as processor time), each in processes of its
    own, in turns. Backward: gradient of volume and weights. Peak: memory of the first call beyond
    what was in use. Networks are untrained: the same arithmetic."""
    config = run.config
    sizes = SIZES_PX[:2] if config.quick else SIZES_PX
    grown = (CLOSED, CELLS, REFINER, PUBLISHED)
    cases = [(name, kind, SIZE_PX, 1) for name in ESTIMATORS for kind in BOTH]
    cases += [(name, "forward", size, 1) for name in grown for size in sizes if size != SIZE_PX]
    cases += [(name, kind, *SMALL) for name in (CLOSED, CELLS) for kind in BOTH]
    labels = [_label(*case) for case in cases]
    rows = sweep(
        run,
        flow,
        "flow",
        processes=1,
        turns=config.rounds,
        given={"repeats": config.repeats, "seed": config.seed},
        case=dict(zip(labels, cases, strict=True)),
    )
    tabulate(run, "One call, medians", rows, "case", prefix="flow")
    cpu_s = dict(zip(cases, [row["cpu_s"] for row in rows], strict=True))
    peer = cpu_s[PUBLISHED, "forward", SIZE_PX, 1]
    figures = [
        Asked(f"{_label(*case)} over {PUBLISHED}: CPU", cpu_s[case] / peer, most=most)
        for case, most in ASKED_FLOW.items()
    ]
    for name in (CLOSED, CELLS, REFINER):
        first, last = (cpu_s[name, "forward", size, 1] / size**2 for size in (sizes[0], sizes[-1]))
        what = f"{name}, CPU per pixel at {sizes[-1]} px over {sizes[0]} px"
        figures.append(Asked(what, last / first, 1 - ASKED_GROWTH, 1 + ASKED_GROWTH))
    estimators = [CLOSED, CELLS, REFINER]
    rows = sweep(run, live, "live", 1, config.rounds, sensor=LIVE, estimator=estimators)
    tabulate(
        run, "A window of a live stream, all threads", rows, "sensor", "estimator", prefix="live"
    )
    for row in rows:
        what = f"live, {row['sensor']} px, {row['estimator']}: clock over the window's time"
        figures.append(Asked(what, row["wall_s"] / WINDOW_S, most=1.0))
    return figures


def _label(name, kind, size, windows):
    return f"{name}, {kind}, {windows} x {size} px"


def like_the_refiner(network, seed):
    return network.with_weights(count_weights(Refiner()), seed=seed)


ESTIMATORS: dict[str, Callable[[int], Any]] = {
    CLOSED: lambda seed: estimate_lk,
    CELLS: lambda seed: partial(estimate_lk, model="local"),
    REFINER: lambda seed: Refiner(),
    "FlowNetEvents, equal weights": partial(like_the_refiner, FlowNetEvents),
    f"{PUBLISHED}, equal weights": partial(like_the_refiner, SpikeFlowNet),
    "ECN, equal weights": partial(like_the_refiner, ECN),
    "ECN": lambda seed: ECN(seed=seed),
    "IDNet, equal weights": partial(like_the_refiner, IDNet),
    "IDNet, small": lambda seed: IDNet(seed=seed),
    PUBLISHED: lambda seed: SpikeFlowNet(seed=seed),
    f"{PUBLISHED}, 10 bins": lambda seed: SpikeFlowNet(bins=10, seed=seed),
}


def flow(case: tuple[str, str, int, int], repeats: int, seed: int) -> dict[str, float]:
    """Cost of one estimator, and its learned numbers."""
    torch.set_num_threads(1)
    dr.set_thread_count(1)
    name, kind, size, windows = case
    estimate: Any = ESTIMATORS[name](seed)
    learned = ()
    bins = 8
    if isinstance(estimate, torch.nn.Module):
        learned = tuple(estimate.eval().parameters())
        bins = getattr(estimate, "config", {}).get("bins", bins)

    def work(volume):
        if kind == "forward":
            with torch.no_grad():
                return estimate(volume)
        counts = volume.counts.detach().requires_grad_()
        field = estimate(EventVolume(counts, volume.centroid_s, volume.collected_s))
        # confidences have weights that the flow does not use
        return torch.autograd.grad(
            field.flow_px.square().sum(), (counts, *learned), allow_unused=True
        )

    # what the first call loads
    work(scattered(64, bins, seed))
    volume = scattered(size, bins, seed, windows)
    return cost(lambda: work(volume), repeats) | {"weights": sum(p.numel() for p in learned)}


def live(sensor: tuple[int, int], estimator: str) -> dict[str, float]:
    """Medians over windows of a stream of scattered events, 30 a second."""
    draw = torch.Generator().manual_seed(0)
    count = WINDOWS * EVENTS
    t_us = torch.randint(round(1e6 * WINDOW_S * WINDOWS), (count,), generator=draw).sort().values
    y, x, on = (torch.randint(most, (count,), generator=draw) for most in (*sensor, 2))
    estimate = load("refiner") if estimator == REFINER else ESTIMATORS[estimator](0)
    tracker = Tracker(estimate, window_s=WINDOW_S)
    clock, processor = [], []
    for rows in zip(*(values.split(EVENTS) for values in (t_us, x, y, 2 * on - 1)), strict=True):
        since = time.perf_counter(), time.process_time()
        tracker.add(EventStream(*rows, *sensor))
        clock.append(time.perf_counter() - since[0])
        processor.append(time.process_time() - since[1])
    wall_s = statistics.median(clock[WARM_UP:])
    return {
        "wall_s": wall_s,
        "cpu_s": statistics.median(processor[WARM_UP:]),
        "events_per_s": EVENTS / wall_s,
    }


def scattered(size_px: int, bins: int, seed: int, windows: int = 1) -> EventVolume:
    """One event in 20 bins and pixels at random: what a call costs hardly depends on where they
    are."""
    mean = torch.full((windows, 2, bins, size_px, size_px), 0.05)
    spacing = 0.05 / bins
    return EventVolume(
        torch.poisson(mean, generator=torch.Generator().manual_seed(seed)),
        (torch.arange(bins, dtype=torch.float64) + 0.5) * spacing,
        torch.full((bins,), spacing, dtype=torch.float64),
    )
