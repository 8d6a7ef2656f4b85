"""What event flow costs: closed form, refiner, plain and spiking networks at 256 x 256 pixels in one run, the closed
form on 32 windows of 64 x 64, and how cost grows from 128 to 1024 pixels a side.

Time of one call, batch of one, float32, the estimators in turns; memory in a process of its own that gives
freed blocks back. Networks are untrained: the same arithmetic. The spiking network runs as fast as its form
allows (docs/flow_baselines.md), on the volume of 8 bins that the others get; its published 10 are beside it.
"""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import matplotlib.pyplot as plt
import torch

from codesign.errors import DomainError
from studies.flow_cost.table import (
    CELLS,
    CLOSED,
    KINDS,
    PUBLISHED,
    REFINER,
    SIZE_PX,
    SMALL_PX,
    STEPS,
    TEN_BINS,
    WINDOWS,
    entries,
    grown,
    kinds,
    scattered,
)
from studies.frame.run import Run, StudyConfig, main
from studies.frame.timing import Timing, measure

SIZES_PX = (128, 256, 512, 1024)
ASKED_TIME = 1 / 10
ASKED_WEIGHTS = 1 / 25
ASKED_GROWTH = 0.2
# of the processor time of the published width's forward pass, 119 ms where these were asked for: the closed form
# forward, and with gradients
ASKED_CLOSED = {"forward": 25 / 119, "forward_backward": 60 / 119}
# the same for the small windows: a third of what the closed form took before it ran on kernels of its own (117 and 305
# of 170 ms, in one run)
ASKED_SMALL = {"forward": 117 / 170 / 3, "forward_backward": 305 / 170 / 3}


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"rounds": 1}
    repeats: int = 2
    """Timed calls per turn."""
    rounds: int = 5
    """Turns of every estimator at 256 x 256 pixels; growth gets two."""
    threads: int = 1
    """Threads of torch and of drjit; more than one wait for each other in processor time."""


def study(run: Run[Config]) -> None:
    config = run.config
    if config.repeats < 2 or config.rounds < 1 or config.threads < 1:
        raise DomainError(
            f"repeats {config.repeats}, rounds {config.rounds}, threads {config.threads}: give at least 2, "
            "1 and 1."
        )
    torch.set_num_threads(config.threads)
    dr.set_thread_count(config.threads)
    rounds = config.rounds
    sizes = SIZES_PX[:2] if config.quick else SIZES_PX
    table = entries(config.seed)
    growing = [name for name in table if grown(name)]
    found: dict[tuple, list[Timing]] = {}
    small: dict[tuple, list[Timing]] = {}
    windows = scattered(SMALL_PX, table[CLOSED].bins, config.seed, WINDOWS)
    with run.progress((rounds + 1) * len(table) + 2 * len(sizes) * len(growing), "timing") as progress:
        for turn in range(rounds):
            for name, entry in table.items():
                volume = scattered(SIZE_PX, entry.bins, config.seed)
                for kind in kinds(name):
                    found.setdefault((name, kind, SIZE_PX), []).append(
                        measure(
                            lambda e=entry, v=volume, k=kind: e.work(v, k),
                            config.repeats,
                            warm=1 if turn else 2,
                        )
                    )
                progress.advance()
            for name in (CLOSED, CELLS):
                for kind in KINDS:
                    small.setdefault((name, kind), []).append(
                        measure(
                            lambda e=table[name], k=kind: e.work(windows, k),
                            config.repeats,
                            warm=1 if turn else 2,
                        )
                    )
        for turn in range(2):
            for size in sizes:
                for name in growing:
                    if size != SIZE_PX:
                        entry = table[name]
                        volume = scattered(size, entry.bins, config.seed)
                        found.setdefault((name, KINDS[0], size), []).append(
                            measure(lambda e=entry, v=volume: e.work(v, KINDS[0]), 2, warm=0 if turn else 1)
                        )
                    progress.advance()
        memory = in_process(config.seed, sizes)
        progress.advance()
    timings = joined(found)
    judged = record(run, table, timings, memory, sizes) + closed_form(run, timings, joined(small))
    show(run, table, timings, memory, sizes, judged)


def joined(found):
    """All turns of each key as one Timing."""
    return {
        key: Timing(
            *(tuple(t for part in parts for t in getattr(part, what)) for what in ("wall_s", "cpu_s"))
        )
        for key, parts in found.items()
    }


def closed_form(run, timings, small):
    """Rows as of ``record``: the closed form over the forward pass of the published width. Judged by the
    processor's time, since it was asked for so."""
    judged = []
    peer = timings[PUBLISHED, KINDS[0], SIZE_PX]
    for (name, kind), timing in small.items():
        key = f"{plain(name)}_{kind}_{WINDOWS}_windows_{SMALL_PX}px"
        run.record(**{f"{key}_wall_s": timing.wall, f"{key}_cpu_s": timing.cpu})
    for kind in KINDS:
        for size, timing, asked in (
            (f"{SIZE_PX}px", timings[CLOSED, kind, SIZE_PX], ASKED_CLOSED[kind]),
            (f"{WINDOWS}_windows_{SMALL_PX}px", small[CLOSED, kind], ASKED_SMALL[kind]),
        ):
            wall = timing.wall / peer.wall
            cpu = timing.cpu / peer.cpu
            run.record(**{f"closed_form_{kind}_{size}_over_spike_flownet_form_cpu": cpu})
            what = (
                f"closed form, {kind.replace('_', ' + ')}, {size.replace('_', ' ')}, over {PUBLISHED} forward"
            )
            judged.append((what, wall, cpu, f"<= {asked:.2f} (CPU)", cpu <= asked))
    return judged


def in_process(seed, sizes):
    """Peak memory, MB, by (name, kind, size), measured in a process whose allocator keeps no large block that
    was freed."""
    command = [sys.executable, "-m", "studies.flow_cost.table", str(seed), *map(str, sizes)]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"},
    )
    if done.returncode:
        raise DomainError(
            f"the measurement of memory ended with code {done.returncode}: "
            f"{(done.stderr.strip().splitlines() or [''])[-1][:200]}"
        )
    return {
        (name, kind, size): peak / 1e6 for name, kind, size, peak in json.loads(done.stdout.splitlines()[-1])
    }


def plain(name):
    """A name for metrics.json."""
    return "_".join("".join(c if c.isalnum() else " " for c in name.lower()).split())


def record(run, table, timings, memory, sizes):
    """Write every figure down; returns rows (what, by the clock, by the processor, asked, met)."""
    for (name, kind, size), timing in timings.items():
        key = f"{plain(name)}_{kind}_{size}px"
        run.record(
            **{
                f"{key}_wall_s": timing.wall,
                f"{key}_wall_iqr_s": timing.wall_iqr,
                f"{key}_cpu_s": timing.cpu,
                f"{key}_peak_mb": memory[name, kind, size],
            }
        )
    for name, entry in table.items():
        run.record(**{f"{plain(name)}_weights": entry.weights})
    judged = []
    refiner = timings[REFINER, "forward", SIZE_PX]
    for other in (PUBLISHED, TEN_BINS, STEPS):
        peer = timings[other, "forward", SIZE_PX]
        wall = refiner.wall / peer.wall
        cpu = refiner.cpu / peer.cpu
        run.record(**{f"refiner_over_{plain(other)}_wall": wall, f"refiner_over_{plain(other)}_cpu": cpu})
        if other == PUBLISHED:  # the fastest of the three
            judged.append(
                (f"forward time, refiner over {other}", wall, cpu, f"<= {ASKED_TIME:g}", wall <= ASKED_TIME)
            )
    share = table[REFINER].weights / table[PUBLISHED].weights
    run.record(refiner_over_spike_flownet_form_weights=share)
    judged.append(
        (f"weights, refiner over {PUBLISHED}", share, None, f"<= {ASKED_WEIGHTS:g}", share <= ASKED_WEIGHTS)
    )
    for name in filter(grown, table):
        small, large = (timings[name, "forward", size] for size in (sizes[0], sizes[-1]))
        pixels = (sizes[-1] / sizes[0]) ** 2
        wall = large.wall / small.wall / pixels
        cpu = large.cpu / small.cpu / pixels
        run.record(**{f"{plain(name)}_growth_wall": wall, f"{plain(name)}_growth_cpu": cpu})
        if name in (CLOSED, REFINER):
            judged.append(
                (
                    f"time per pixel at {sizes[-1]} px over {sizes[0]} px a side, {name}",
                    wall,
                    cpu,
                    f"{1 - ASKED_GROWTH:g} to {1 + ASKED_GROWTH:g}",
                    abs(wall - 1) <= ASKED_GROWTH,
                )
            )
    return judged


def show(run, table, timings, memory, sizes, judged):
    for what, wall, _, asked, met in judged:
        run.card(what, f"{wall:.3g}", f"asked: {asked}{'' if met else ' (missed)'}")
    run.section(
        "Against what was asked",
        "Ratios of median wall-clock times; the processor's beside them, since the machine may be shared.",
    )
    run.table(
        "Ratios",
        ("what", "wall", "CPU", "asked", "met"),
        [(what, wall, cpu, asked, "yes" if met else "no") for what, wall, cpu, asked, met in judged],
    )
    run.section(f"{SIZE_PX} x {SIZE_PX} pixels", "Backward: gradient of volume and weights.")
    rows = []
    for name, entry in table.items():
        for kind in kinds(name):
            timing = timings[name, kind, SIZE_PX]
            rows.append(
                (
                    name,
                    kind.replace("_", " + "),
                    entry.weights,
                    entry.bins,
                    1e3 * timing.wall,
                    1e3 * timing.wall_iqr,
                    1e3 * timing.cpu,
                    memory[name, kind, SIZE_PX],
                )
            )
    run.table(
        "One call",
        ("estimator", "work", "weights", "bins", "wall ms", "IQR", "CPU ms", "peak MB"),
        rows,
        "Peak: memory beyond what was in use before the call.",
    )
    run.section(
        "Growth",
        "Forward. Fixed costs of a call make small images dear per pixel; caches make large ones dear.",
    )
    rows = [
        (
            name,
            size,
            1e3 * timings[name, "forward", size].wall,
            1e9 * timings[name, "forward", size].wall / size**2,
            1e9 * timings[name, "forward", size].cpu / size**2,
            memory[name, "forward", size],
            1e6 * memory[name, "forward", size] / size**2,
        )
        for name in table
        if grown(name)
        for size in sizes
    ]
    run.table(
        "By size",
        (
            "estimator",
            "px a side",
            "wall ms",
            "wall ns per pixel",
            "CPU ns per pixel",
            "peak MB",
            "peak bytes per pixel",
        ),
        rows,
    )
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for name in filter(grown, table):
        axes[0].plot(
            sizes,
            [1e3 * timings[name, "forward", size].wall for size in sizes],
            "o-",
            label=name,
            markersize=3,
        )
        axes[1].plot(sizes, [memory[name, "forward", size] for size in sizes], "o-", markersize=3)
    for axis, label in zip(axes, ("milliseconds of a forward call", "peak memory, MB"), strict=True):
        axis.set(xscale="log", yscale="log", xlabel="pixels a side", ylabel=label)
        axis.set_xticks(sizes, [str(size) for size in sizes], minor=False)
        axis.minorticks_off()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    run.figure(figure, "growth", "Cost of a forward call against image size.")
    missed = [what for what, *_, met in judged if not met]
    run.finish(
        "Cost of event flow",
        "All figures are met." if not missed else f"**Missed in this run:** {'; '.join(missed)}.",
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
