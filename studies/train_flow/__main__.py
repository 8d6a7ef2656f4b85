"""Train a flow network on events rendered on the fly, or on a data set.

The budget is processor time (--cpu-minutes, all threads, making the data included) or a number of steps
(--steps). With --steps the result depends on the
options and the seed alone, and a resumed run gives the same numbers bit for bit on the same machine and
number of threads. Several processes share
every batch: torchrun --nproc-per-node 2 -m studies.train_flow ...
"""

import math
import os
import signal
import sys
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import torch

from codesign.errors import CodesignError, DomainError, NonFiniteError
from studies.frame.run import Run, StudyConfig, main
from studies.train_flow.parallel import join, place
from studies.train_flow.setup import prepare
from studies.train_flow.sources import to_device
from studies.train_flow.watch import Watch


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {
        "steps": 12,
        "batch": 2,
        "validation_windows": 4,
        "final_windows": 8,
        "validate_every": 6,
        "save_every": 6,
    }
    network: str = "refiner"
    """Which network: refiner, flownet-events or spike-flownet."""
    options: tuple[str, ...] = ()
    """Arguments of the network's constructor, name=number."""
    weights: int = 0
    """Number of weights wanted of a network that comes in sizes; 0 leaves its own."""
    mix: str = "delivered"
    """Windows to train on (studies.train_flow.sources)."""
    data: Path | None = None
    """Folder of a data set (ours, DSEC, MVSEC) to train on instead; its last tenth is what is judged on."""
    window_frames: int = 1
    """Frame intervals per window of a data set."""
    loss: str = "supervised"
    """supervised, contrast or photometric."""
    unit: Literal["px", "motion"] = "motion"
    """Errors count in pixels, or as shares of the window's own root mean square flow (supervised)."""
    claim_weight: float = 0.1
    """Weight of the likelihood that teaches a network its confidence (supervised)."""
    smoothness: float = 0.1
    """Weight of the roughness of the flow (contrast, photometric)."""
    steps: int | None = None
    """Number of steps; reproducible."""
    cpu_minutes: float | None = None
    """Processor time to spend, minutes; 20 without --steps. With --steps: the run stops there even if steps
    are left."""
    batch: int = 8
    """Windows per step, over all processes."""
    height_px: int = 64
    """Height of the windows; of the piece cut out of a data set's."""
    width_px: int = 64
    """Width likewise."""
    bins: int = 8
    """Time bins of the windows."""
    reuse: int = 4
    """Times that windows are shown, turned and mirrored in between; making them costs as much as a step."""
    learning_rate: float = 2e-3
    """Largest step of AdamW."""
    weight_decay: float = 1e-4
    """Decay of AdamW."""
    warm_up: float = 0.05
    """Share of the budget over which the step grows; then it falls as a half cosine to a hundredth."""
    clip: float = 5.0
    """Longest gradient; longer ones are shortened to it, and counted."""
    average: float = 0.998
    """Decay per step of a running average of the weights, which is then what is judged and kept; 0 for
    none."""
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


class Clock:
    """Processor seconds of this process by kind of work."""

    def __init__(self):
        self.spent = {"data": 0.0, "training": 0.0, "validation": 0.0}

    @contextmanager
    def __call__(self, kind):
        began = time.process_time()
        try:
            yield
        finally:
            self.spent[kind] += time.process_time() - began


def study(run: Run[Config]) -> None:
    ranks = join()
    config = run.config
    ranks.tell((config, run.folder, run.resumed))
    job, ranks, clock = begin(config, run.folder, run.resumed, ranks)
    watch = Watch(run, config, job, clock)
    with watch:
        train(config, job, ranks, clock, watch.after_step)
    ranks.leave()
    watch.finish()


def follow():
    """What every process but the first does: the same steps, without a word."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # the first process decides when to stop, and takes the others with it
    ranks = join()
    config, folder, resumed = ranks.tell()
    try:
        job, ranks, clock = begin(config, folder, resumed, ranks)
        train(config, job, ranks, clock, lambda share: None)
    except CodesignError:
        time.sleep(3)  # the first process says why; torchrun ends all when one has ended
        return 2
    ranks.leave()
    return 0


def begin(config, folder, resumed, ranks):
    """Job, device and clock of this process; every unfit option, file or data set is refused here."""
    torch.set_num_threads(config.threads or os.cpu_count() or 1)
    ranks = ranks.on(config.device)
    clock = Clock()
    return prepare(config, folder, resumed, ranks, clock), ranks, clock


def train(config, job, ranks, clock, after_step):
    """All steps that the budget leaves. ``after_step`` is told the share of the budget that is spent."""
    learner = job.learner
    progress = job.progress
    parameters = learner.parameters
    earlier = progress.data_s, progress.training_s
    spent_s = sum(earlier) + ranks.sum(clock.spent["data"])[0]
    share = share_done(config, progress.step, spent_s)
    if share >= 1.0 and progress.step == 0:
        raise DomainError(
            f"--cpu-minutes {config.cpu_minutes} is over before the first step: making the first windows "
            f"took {spent_s / 60:.2f}; give more."
        )
    while share < 1.0:
        with clock("data"):
            windows = job.batches(progress.step)
        with clock("training"):
            windows = to_device(windows, ranks.device)
            rate = learning_rate(config, share)
            for group in learner.optimiser.param_groups:
                group["lr"] = rate
            with torch.autocast(ranks.device.type, torch.bfloat16, enabled=config.mixed_precision):
                predictions = learner.network.predictions(windows.volume)
            loss = job.objective(predictions, windows)
            learner.optimiser.zero_grad(set_to_none=False)
            loss.backward()
            for parameter in parameters:
                if parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)
            ranks.average_gradients(parameters)
            norm = float(torch.nn.utils.clip_grad_norm_(parameters, config.clip))
        blind = int((~windows.truth.valid.flatten(1).any(1)).sum())
        mean_loss, blind, data_s, training_s = ranks.sum(
            float(loss.detach()) / ranks.count, blind, clock.spent["data"], clock.spent["training"]
        )
        if not (math.isfinite(norm) and math.isfinite(mean_loss)):
            raise NonFiniteError(
                f"step {progress.step}: loss {mean_loss:.4g}, gradient norm {norm:.4g}; lower "
                "--learning-rate, or look for the window that causes it."
            )
        with clock("training"):
            learner.optimiser.step()
            learner.follow(progress.step)
        progress.data_s = earlier[0] + data_s
        progress.training_s = earlier[1] + training_s
        progress.step += 1
        progress.clipped += norm > config.clip
        progress.blind += int(blind)
        progress.loss.append(mean_loss)
        progress.norm.append(norm)
        progress.rate.append(rate)
        share = share_done(config, progress.step, progress.data_s + progress.training_s)
        after_step(share)


def share_done(config, step, spent_s):
    """Share of the budget that is spent, 1 at its end: steps where --steps is given, processor seconds of all
    processes otherwise."""
    if config.steps is None:
        return spent_s / (60 * (config.cpu_minutes or 20.0))
    if config.cpu_minutes is not None and spent_s >= 60 * config.cpu_minutes:
        return 1.0
    return step / config.steps


def learning_rate(config, share):
    """Step of AdamW when this share of the budget is spent: grows linearly over the warm-up, then falls as a
    half cosine to a hundredth."""
    if share < config.warm_up:
        return config.learning_rate * (0.01 + 0.99 * share / config.warm_up)
    fallen = (share - config.warm_up) / (1 - config.warm_up)
    return config.learning_rate * (0.01 + 0.495 * (1 + math.cos(math.pi * fallen)))


def run_here(arguments=None):
    """Exit code of this process: the first one runs the study; the others follow it, and end here."""
    if place()[0] == 0:
        return main(study, Config, arguments)
    code = follow()
    sys.stdout.flush()
    os._exit(
        code
        # threads of the connection may still be ending, and the interpreter's own end aborts on them now and then
    )


if __name__ == "__main__":
    sys.exit(run_here())
