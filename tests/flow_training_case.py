"""A training run small enough for tests: a linear network, windows with one known answer, and the
command on both."""

import json
import os
import socket
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import torch
from torch import nn

from codesign.flow import checkpoint
from codesign.types import EventVolume, FlowField, FlowWindows
from scenes.windows import sets
from studies.frame.run import main
from studies.train_flow import __main__ as train_flow
from studies.train_flow import watch
from tests.numbers import f64, seeded

ROOT = Path(__file__).resolve().parents[1]
BINS = 2
SIDE = 16
# flow of a window is this times its counts, pixel by pixel
TRUE_WEIGHTS = torch.tensor([[0.5, -0.25, 1.0, 0.0], [-1.0, 0.75, 0.25, 0.5]])


class Linear(nn.Module):
    """Flow linear in the counts of its pixel: training has one known answer, TRUE_WEIGHTS."""

    def __init__(self, bins=BINS, gain=1.0):
        super().__init__()
        self.config = {"bins": bins, "gain": gain}
        self.layer = nn.Conv2d(2 * bins, 2, 1, bias=False)

    def predictions(self, volume):
        flow = self.config["gain"] * self.layer(volume.counts.flatten(1, 2))
        return [FlowField(flow, torch.ones_like(flow[:, 0], dtype=torch.bool), 1.0)]

    def forward(self, volume):
        return self.predictions(volume)[-1]


class Own(Linear):
    """The same, in no table of networks."""


class Made:
    """Source of windows whose flow is TRUE_WEIGHTS times the counts; ``before`` is called with the
    indices of every batch; blind: no pixel has known flow."""

    def __init__(self, seed=0, frames=True, before=lambda indices: None, blind=False):
        self.seed = seed
        self.blind = blind
        self.frames = frames
        self.before = before

    def batch(self, indices):
        self.before(indices)
        draws = [seeded(1000 * self.seed + index) for index in indices]
        counts = torch.stack(
            [torch.randn(2, BINS, SIDE, SIDE, generator=draw).square() for draw in draws]
        )
        flow = torch.einsum("fc,bchw->bfhw", TRUE_WEIGHTS, counts.flatten(1, 2))
        valid = torch.full((len(counts), SIDE, SIDE), not self.blind)
        times = (f64([0.25, 0.75]), f64([0.5, 0.5]))
        return FlowWindows(
            EventVolume(counts, *times),
            FlowField(flow, valid, 1.0),
            counts[:, 0] if self.frames else None,
        )


def register(before=lambda indices: None, frames=True):
    """Put the network and the source where the command finds them."""
    checkpoint.NETWORKS["linear"] = f"{Linear.__module__}:Linear"
    sets.TRAINING["made"] = lambda shape, seed: [(1.0, Made(seed, frames, before))]
    sets.VALIDATION.clear()
    sets.VALIDATION["unseen"] = lambda shape, seed: Made(seed + 77)


@contextmanager
def tables_kept():
    """The tables of networks and sources are as they were afterwards."""
    tables: list[dict[str, Any]] = [checkpoint.NETWORKS, sets.TRAINING, sets.VALIDATION]
    before = [dict(table) for table in tables]
    try:
        yield
    finally:
        for table, content in zip(tables, before, strict=True):
            table.clear()
            table.update(content)


def undraw(replace=setattr):
    """Leave out the figures, which nobody looks at here and which take most of the time."""
    for name in ("curves", "pictures"):
        replace(watch, name, lambda *_: plt.figure(figsize=(1, 1)))


OPTIONS = (
    "--network linear --mix made --bins 2 --height-px 16 --width-px 16 --batch 4 --final-windows 8 "
    "--validation-windows 4 --device cpu"
)
BASE = OPTIONS.split()


def train(folder, options=""):
    return main(
        train_flow.study, train_flow.Config, [*BASE, "--out", str(folder), *options.split()]
    )


def resume(folder):
    return main(train_flow.study, train_flow.Config, ["--resume", str(folder)])


def in_two_processes(script, *arguments):
    """(exit codes, outputs) of a script run by two processes, with the variables that torchrun
    sets."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    shared = {
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "1",
        "WORLD_SIZE": "2",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
    }
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", script, *map(str, arguments)],
            env={**os.environ, **shared, "RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank in (0, 1)
    ]
    try:
        said = [process.communicate(timeout=300)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
    return [process.returncode for process in processes], said


def state_of(folder):
    """Every tensor of the checkpoint in a folder, as bytes."""
    (path,) = folder.glob("step_*.safetensors")
    return {
        name: tensor.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()
        for name, tensor in checkpoint.read_tensors(path)[0].items()
    }


def metrics_of(folder):
    return json.loads((folder / "metrics.json").read_text())
