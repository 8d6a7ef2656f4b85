"""Stage "flow": what event flow costs."""

import itertools
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import torch

from codesign import events, lens, pose, render
from codesign.flow import Tracker, estimate_lk, load
from codesign.flow.baselines import FlowNetEvents, SpikeFlowNet
from codesign.flow.baselines.parts import count_weights
from codesign.flow.export import export
from codesign.flow.metrics import aee
from codesign.flow.refiner import Refiner
from codesign.types import EventStream, EventVolume, FlowField
from scenes import trajectories, worlds
from studies.frame.bench import apart, cost, installed
from studies.frame.run import Run
from studies.frame.show import Asked, tabulate
from studies.frame.sweep import sweep
from studies.speed_error import Config
from studies.train_flow.peers import ECN, IDNet

CLOSED = "closed form"
CELLS = "closed form with cells"
REFINER = "refiner"
TWO_LEVELS = ", two levels, no warm start"
PUBLISHED = "Spike-FlowNet form"
SEARCH = "dense inverse search"
PEERS = {SEARCH: "cv2"}
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
VIEW = ((0.1, -1.5, 0.9), (0.0, 1.0, 0.6))  # from, to, in a room
TWIST = (0.4, 0.1, 0.5, 0.1, 0.3, 0.1)  # m/s, rad/s
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
    for what, seconds in apart(program_s).items():
        figures.append(Asked(f"CPU-s to {what} a refiner's program", seconds, most=10.0))
    return figures


def live_stage(run: Run[Config]) -> list[Asked]:
    """Live streams, 30 windows a second of a camera that moves through a room, on all threads: the
    clock over the time of a window, and the flow's error over that of zero flow; beside them dense
    inverse search, where OpenCV is installed. Medians over windows, the first three left out; in
    turns, each in a process of its own."""
    rows = sweep(
        run,
        live,
        "live",
        1,
        run.config.rounds,
        sensor=LIVE,
        estimator=[name for name in LIVE_ESTIMATORS if name not in PEERS or installed(PEERS)],
    )
    tabulate(
        run, "A window of a live stream, all threads", rows, "sensor", "estimator", prefix="live"
    )
    return [
        Asked(
            f"{row['sensor']} px, {row['estimator']}: clock over time",
            row["wall_s"] / WINDOW_S,
            most=1.0,
        )
        for row in rows
        if row["estimator"] not in PEERS
    ]


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


def inverse_search(volume: EventVolume) -> FlowField:
    """Dense inverse search (Kroeger et al., ECCV 2016) as OpenCV has it, between the event images of a
    window's halves: bytes, white where a pixel has three times the mean of those with events."""
    import cv2  # pyright: ignore[reportMissingImports]

    half = volume.counts.shape[2] // 2
    pair = [part.sum(0) for part in volume.counts[0].sum(0).split(half)[:2]]
    white = 3 * max(float(pair[0].sum() / (pair[0] > 0).sum().clamp_min(1)), 1.0)
    images = [(255 * (image / white).clamp(max=1)).byte().numpy() for image in pair]
    search = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    found = torch.from_numpy(search.calc(*images, None)).movedim(-1, 0)[None]
    before, after = (part.mean() for part in volume.centroid_s.split(half)[:2])
    whole_s = float(volume.collected_s.sum())
    seen = torch.ones_like(found[:, 0], dtype=torch.bool)
    return FlowField(found * (whole_s / float(after - before)), seen, whole_s)


FAST = {"levels_px": (4.0, 2.0), "steps": 2}
LIVE_ESTIMATORS: dict[str, Callable[[], Any]] = {
    CLOSED: lambda: estimate_lk,
    f"{CLOSED}{TWO_LEVELS}": lambda: partial(estimate_lk, **FAST),
    CELLS: lambda: partial(estimate_lk, model="local"),
    f"{CELLS}{TWO_LEVELS}": lambda: partial(estimate_lk, model="local", **FAST),
    REFINER: lambda: load("refiner"),
    SEARCH: lambda: inverse_search,
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


def program_s() -> dict[str, float]:
    """Processor seconds to write the refiner as a program for 48 x 64 pixels, and to read it."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "refiner.pt2"
        begun_s = time.process_time()
        export(load("refiner"), path, 48, 64)
        written_s = time.process_time()
        torch.export.load(path)
    return {"write": written_s - begun_s, "read": time.process_time() - written_s}


def live(sensor: tuple[int, int], estimator: str) -> dict[str, float]:
    """Windows of a stream of a camera that moves through a room, 30 a second: medians of their cost,
    and the flow's error over that of zero flow."""
    height, width = sensor
    camera = render.Camera(lens.Pinhole(6.4), width, height, 0.0185, 1)
    steps = 8  # frames to a window
    t_s = torch.arange(WINDOWS * steps + 1, dtype=torch.float64) * (WINDOW_S / steps)
    drive = trajectories.body_twist(pose.look_at(*VIEW), torch.tensor(TWIST), t_s)
    room = worlds.room()
    stream = events.simulate(render.frames(camera, room, drive), t_s, events.SensorModel(0.2, 0.2))
    true, valid = render.true_flow(camera, room, drive[::steps].unfold(0, 2, 1).permute(0, 3, 1, 2))
    edges = torch.searchsorted(stream.t_us, (t_s[::steps] * 1e6).round().long()).tolist()
    estimate, warm = LIVE_ESTIMATORS[estimator](), TWO_LEVELS not in estimator
    tracker = Tracker(estimate, window_s=WINDOW_S, size_px=sensor, warm_start=warm)
    clock, processor, found = [], [], []
    for part in itertools.starmap(slice, itertools.pairwise([*edges[:-1], len(stream)])):
        columns = (values[part] for values in (stream.t_us, stream.x, stream.y, stream.p))
        since = time.perf_counter(), time.process_time()
        done = tracker.add(EventStream(*columns, height, width))
        clock.append(time.perf_counter() - since[0])
        processor.append(time.process_time() - since[1])
        found += [window.field.flow_px[0] for window in done]
    errors = [
        aee(flow_px[None], *truth) / aee(0 * flow_px[None], *truth)
        for flow_px, truth in zip(found, zip(true, valid, strict=True), strict=False)
    ]
    wall_s = statistics.median(clock[WARM_UP:])
    return {
        "wall_s": wall_s,
        "cpu_s": statistics.median(processor[WARM_UP:]),
        "events_per_s": len(stream) / WINDOWS / wall_s,
        "error_over_zero_flow": statistics.median(map(float, errors)),
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
