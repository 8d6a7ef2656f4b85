"""Train a flow network on events rendered on the fly, or on a data set.

The budget is processor time (--cpu-minutes, all threads, making the data included) or a number of
steps (--steps). With --steps the result depends on the options and the seed alone, and a resumed
run gives the same numbers bit for bit on the same machine and number of threads. Several processes
share every batch: torchrun --nproc-per-node 2 -m studies.train_flow ... With --race the refiner,
networks of its size and your own are trained alike, and judged side by side.
"""

import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import torch

from codesign.errors import CodesignError
from codesign.train import Budget, Clock, Cosine, join, loop
from codesign.train.parallel import place
from studies.frame.run import Run, StudyConfig, main
from studies.train_flow.race import race
from studies.train_flow.setup import prepare
from studies.train_flow.watch import Watch


@dataclass(frozen=True)
class Config(StudyConfig):
    GPU: ClassVar = True
    QUICK: ClassVar = {
        "steps": 12,
        "batch": 2,
        "validation_windows": 4,
        "final_windows": 8,
        "validate_every": 6,
        "save_every": 6,
    }
    network: str = "refiner"
    """Which network: refiner, flownet-events, spike-flownet, ecn or idnet, or module:Class of your
    own."""
    options: tuple[str, ...] = ()
    """Arguments of the network's constructor, name=number."""
    weights: int = 0
    """Number of weights wanted of a network that comes in sizes; 0 leaves its own."""
    mix: str = "real"
    """Windows to train on (scenes.windows.sets)."""
    data: Path | None = None
    """Data set (ours, DSEC, MVSEC) or recording to train on instead; its last tenth is what is
    judged on. Without true
    flow: --loss contrast."""
    window_frames: int = 1
    """Frame intervals per window of a data set."""
    window_ms: float = 20.0
    """Length of the windows of a recording."""
    loss: Literal["supervised", "contrast", "photometric"] = "supervised"
    """What is made small."""
    unit: Literal["px", "motion"] = "motion"
    """Errors count in pixels, or as shares of the window's own root mean square flow
    (supervised)."""
    claim_weight: float = 0.3
    """Weight of the likelihood that teaches a network its confidence (supervised)."""
    smoothness: float = 0.1
    """Weight of the roughness of the flow (contrast, photometric)."""
    steps: int | None = None
    """Number of steps; reproducible."""
    cpu_minutes: float | None = None
    """Processor time to spend, minutes; 20 without --steps. With --steps: the run stops there even
    if steps are left."""
    batch: int = 16
    """Windows per step, over all processes."""
    height_px: int = 64
    """Height of the windows; of the piece cut out of a data set's."""
    width_px: int = 64
    """Width likewise."""
    bins: int = 8
    """Time bins of the windows."""
    reuse: int = 16
    """Times that windows are shown, turned and mirrored in between; making them costs more than a
    step."""
    learning_rate: float = 2e-3
    """Largest step of AdamW."""
    weight_decay: float = 1e-4
    """Decay of AdamW."""
    warm_up: float = 0.05
    """Share of the budget over which the step grows; then it falls as a half cosine to a
    hundredth."""
    clip: float = 1.0
    """Longest gradient; longer ones are shortened to it, and counted."""
    average: float = 0.998
    """Decay per step of a running average of the weights, which is then what is judged and kept; 0
    for none."""
    validate_on: tuple[str, ...] = ()
    """Sets to judge on; all when left out."""
    validate_every: int = 1000
    """Steps between validations."""
    validation_windows: int = 48
    """Windows of each set in between."""
    final_windows: int = 256
    """Windows of each set at the end."""
    save_every: int = 250
    """Steps between checkpoints."""
    start: str | None = None
    """Network file to begin with: "refiner" or a path."""
    mixed_precision: bool = False
    """bfloat16 where it is safe; CUDA only."""
    threads: int = 1
    """Threads of torch per process; 0 for all cores."""
    race: bool = False
    """Train the refiner and networks of as many weights with every one of --seeds, and judge them
    side by side."""
    own: tuple[str, ...] = ()
    """Networks of your own to race too: module:Class, run from the folder of the module."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of a race: every network sees the same windows with the same seed."""
    jobs: int = 2
    """Trainings of a race at a time, one thread each."""


def study(run: Run[Config]) -> None:
    if run.config.race:
        race(run)
        return
    ranks = join()
    config = run.config
    ranks.tell((config, run.folder, run.resumed))
    job, ranks, clock = begin(config, run.folder, run.resumed, ranks)
    watch = Watch(run, job, clock)
    with watch:
        train(config, job, clock, watch.after_step)
    ranks.leave()
    watch.finish()


def follow():
    """What every process but the first does: the same steps, without a word."""
    # the first process decides when to stop, and takes the others with it
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    ranks = join()
    config, folder, resumed = ranks.tell()
    try:
        job, ranks, clock = begin(config, folder, resumed, ranks)
        train(config, job, clock)
    except CodesignError:
        time.sleep(3)  # the first process says why; torchrun ends all when one has ended
        return 2
    ranks.leave()
    return 0


def begin(config, folder, resumed, ranks):
    """Job, device and clock of this process; every unfit option, file or data set is refused
    here."""
    torch.set_num_threads(config.threads or os.cpu_count() or 1)
    ranks = ranks.on(config.device)
    clock = Clock()
    return prepare(config, folder, resumed, ranks, clock), ranks, clock


def train(config, job, clock, after_step=None):
    """All steps that the budget leaves; ``after_step`` is told the share of it that is spent."""
    loop.run(
        job.learner,
        job.batches,
        job.progress,
        budget(config),
        Cosine(config.warm_up),
        clock=clock,
        after_step=after_step,
    )


def budget(config):
    """Budget of a run: steps where --steps is given, 20 processor minutes where nothing is."""
    minutes = config.cpu_minutes
    if config.steps is None and minutes is None:
        minutes = 20.0
    return Budget(config.steps, None if minutes is None else 60 * minutes)


def run_here(arguments=None):
    """Exit code of this process: the first one runs the study; the others follow it, and end
    here."""
    if place()[0] == 0:
        return main(study, Config, arguments)
    code = follow()
    sys.stdout.flush()
    # threads of the connection may still be ending, and the interpreter's own end aborts on them
    # now and then
    os._exit(code)


if __name__ == "__main__":
    sys.exit(run_here())
