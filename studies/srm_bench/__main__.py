"""Speed and memory of the spike response layer: against a 77-tap convolution, snnTorch's and norse's
two-state cells, and a memory copy, in one run.

2 x 128 x 128 pixels in float32, forward alone and with the gradient of the drive. Every layer runs in a
process of its own, in turns with the others, with two threads; each of its repeats follows a timed copy of
input, spikes and potential, the measure of what moving the data costs. Peers: pip install ".[bench]".
"""

import importlib.util
import json
import statistics
import subprocess
import sys
from dataclasses import dataclass
from typing import ClassVar

import matplotlib.pyplot as plt

from codesign.errors import DomainError
from studies.frame.run import Run, StudyConfig, main
from studies.frame.timing import Timing

STEPS = (200, 1000)
KINDS = ("forward", "forward_backward")
PEERS = {"snntorch": "snntorch", "norse": "norse"}
ASKED_COPIES = {"forward": 2.0, "forward_backward": 5.0}  # at most
ASKED_SPEED = {"convolution": 20.0, **dict.fromkeys(PEERS, 4.0)}  # at least, forward and backward
ARRAY_MB = 4 * 2 * 128 * 128 / 1e6  # one step of one array


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"repeats": 2, "rounds": 1}
    repeats: int = 7
    """Timed repeats per process; the convolution, which takes seconds, gets two."""
    rounds: int = 2
    """Times that every layer gets its turn."""


def study(run: Run[Config]) -> None:
    config = run.config
    if config.repeats < 2 or config.rounds < 1:
        raise DomainError(f"repeats {config.repeats}, rounds {config.rounds}: give at least 2 and 1.")
    repeats = config.repeats
    rounds = config.rounds
    steps = STEPS[:1] if config.quick else STEPS
    peers = [name for name, package in PEERS.items() if importlib.util.find_spec(package)]
    layers = ["codesign", "codesign-segments", "convolution", *peers]
    found: dict[tuple, list[dict]] = {}
    with run.progress(rounds * len(layers) * len(KINDS) * len(steps), "timing") as progress:
        for _ in range(rounds):
            for count in steps:
                for layer in layers:
                    for kind in KINDS:
                        found.setdefault((layer, kind, count), []).append(
                            in_process(
                                layer, kind, count, 2 if layer == "convolution" else repeats, config.seed
                            )
                        )
                        progress.advance()
    judged = compare(run, found)
    missing = sorted(set(PEERS) - set(peers))
    show(run, found, judged, missing)


def in_process(layer, kind, steps, repeats, seed):
    """One layer in its own process; returns what it printed."""
    command = [
        sys.executable,
        "-m",
        "studies.srm_bench.layers",
        layer,
        kind,
        str(steps),
        str(repeats),
        str(seed),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise DomainError(
            f"{layer} ({kind}, {steps} steps) ended with code {done.returncode}: "
            f"{(done.stderr.strip().splitlines() or [''])[-1][:200]}"
        )
    return json.loads(done.stdout.splitlines()[-1])


def timing(parts, prefix=""):
    return Timing(
        *(tuple(t for part in parts for t in part[f"{prefix}{name}"]) for name in ("wall_s", "cpu_s"))
    )


def compare(run, found):
    """Record every figure; returns rows (what, found, asked, met)."""
    judged = []
    for (layer, kind, count), parts in found.items():
        work = timing(parts)
        copy = timing(parts, "copy_")
        name = f"{layer.replace('-', '_')}_{kind}_{count}"
        memory = statistics.median(part["peak_bytes"] for part in parts) / 1e6
        run.record(
            **{
                f"{name}_wall_s": work.wall,
                f"{name}_wall_iqr_s": work.wall_iqr,
                f"{name}_cpu_s": work.cpu,
                f"{name}_copy_wall_s": copy.wall,
                f"{name}_copy_cpu_s": copy.cpu,
                f"{name}_over_copy_wall": work.wall / copy.wall,
                f"{name}_over_copy_cpu": work.cpu / copy.cpu,
                f"{name}_peak_mb": memory,
            }
        )
        if layer == "codesign":
            asked = ASKED_COPIES[kind]
            judged.append(
                (
                    f"{kind.replace('_', ' + ')}, T = {count}: time of so many copies",
                    work.wall / copy.wall,
                    work.cpu / copy.cpu,
                    f"<= {asked:g}",
                    work.wall / copy.wall <= asked,
                )
            )
            if (
                kind == "forward_backward"
                # output: spikes, potential and the gradient of the drive; the potential is the one array kept
                # between
            ):
                arrays = memory / (ARRAY_MB * count)
                run.record(**{f"{name}_peak_arrays": arrays})
                judged.append(
                    (
                        f"memory beside the input, T = {count}, in arrays of its size",
                        arrays,
                        None,
                        "<= 3",
                        arrays <= 3.1,
                    )
                )
    for (layer, kind, count), parts in found.items():
        if layer in ASKED_SPEED and kind == "forward_backward":
            ours = timing(found["codesign", kind, count])
            theirs = timing(parts)
            asked = ASKED_SPEED[layer]
            run.record(
                **{
                    f"speed_over_{layer.replace('-', '_')}_{count}": theirs.wall / ours.wall,
                    f"cpu_speed_over_{layer.replace('-', '_')}_{count}": theirs.cpu / ours.cpu,
                }
            )
            judged.append(
                (
                    f"speed over {layer}, T = {count}",
                    theirs.wall / ours.wall,
                    theirs.cpu / ours.cpu,
                    f">= {asked:g}",
                    theirs.wall / ours.wall >= asked,
                )
            )
    return judged


def show(run, found, judged, missing):
    for what, wall, _, asked, met in judged:
        run.card(what, f"{wall:.2f}", f"asked: {asked}{'' if met else ' (missed)'}")
    run.section(
        "Against what was asked",
        "Ratios of median wall-clock times; the processor's beside them, since the machine may be shared.",
    )
    run.table(
        "Ratios",
        ("what", "wall", "CPU", "asked", "met"),
        [(what, wall, cpu, asked, "yes" if met else "no") for what, wall, cpu, asked, met in judged],
    )
    rows = []
    for (layer, kind, count), parts in found.items():
        work = timing(parts)
        copy = timing(parts, "copy_")
        rows.append(
            (
                layer,
                kind.replace("_", " + "),
                count,
                work.wall,
                work.wall_iqr,
                work.cpu,
                copy.wall,
                copy.cpu,
                statistics.median(p["peak_bytes"] for p in parts) / 1e6,
            )
        )
    run.section(
        "Layers",
        "The convolution is SLAYER's: finite kernels, a sequential reset, no gradient through it, time last "
        "as it lays its tensors out.",
    )
    run.table(
        "Seconds of one call",
        ("layer", "work", "T", "wall, median", "IQR", "CPU", "copy wall", "copy CPU", "peak MB"),
        rows,
        "Copy: input, spikes and potential cloned just before. Peak: memory of the first call beyond what "
        "was in use, input not counted.",
    )
    counts = sorted({count for *_, count in found})
    figure, axes = plt.subplots(
        1, len(counts), figsize=(4.5 * len(counts), 3), layout="constrained", squeeze=False
    )
    for axis, count in zip(axes[0], counts, strict=True):
        names = [layer for layer, kind, steps in found if kind == "forward_backward" and steps == count]
        axis.barh(
            names, [timing(found[name, "forward_backward", count]).wall for name in names], color="#1b6ca8"
        )
        axis.axvline(
            timing(found["codesign", "forward_backward", count], "copy_").wall, color="firebrick", linewidth=1
        )
        axis.set(xscale="log", xlabel=f"seconds, forward + backward, T = {count}")
        axis.invert_yaxis()
    run.figure(figure, "layers", "Red: a copy of input, spikes and potential.")
    missed = [what for what, *_, met in judged if not met]
    lead = ("All figures are met." if not missed else f"**Missed in this run:** {'; '.join(missed)}.") + (
        f" Not installed, hence not compared: {', '.join(missing)}." if missing else ""
    )
    run.finish(
        "Spike response layer", f"Time and memory of spiking layers on the same input, in one run. {lead}"
    )


if __name__ == "__main__":
    sys.exit(main(study, Config))
