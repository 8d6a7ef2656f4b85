"""Training of flow networks: what is learnt, resumed, shared between processes, and counted."""

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from codesign.flow import checkpoint, losses
from studies.frame.run import main
from studies.train_flow import __main__ as train_flow
from studies.train_flow import setup as train_flow_setup
from tests.flow_training_case import (
    BASE,
    TRUE_WEIGHTS,
    Linear,
    Made,
    metrics_of,
    register,
    state_of,
    tables_kept,
    train,
    undraw,
)

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def registered():
    with tables_kept():
        register()
        yield


@pytest.fixture
def undrawn(monkeypatch):
    undraw(monkeypatch.setattr)


def test_training_finds_the_known_answer(tmp_path):
    """At the end of a falling schedule AdamW is within about its last step sizes of the answer: 1e-2 of
    weights of order 1."""
    assert (
        train(
            tmp_path / "run",
            "--steps",
            "250",
            "--learning-rate",
            "0.05",
            "--weight-decay",
            "0",
            "--clip",
            "10",
            "--average",
            "0",
            "--reuse",
            "1",
        )
        == 0
    )
    network = checkpoint.load(tmp_path / "run" / "network.safetensors")
    assert torch.allclose(network.get_parameter("layer.weight")[:, :, 0, 0], TRUE_WEIGHTS, atol=1e-2)
    found = metrics_of(tmp_path / "run")
    assert found["steps"] == 250
    assert found["windows_shown"] == 1000
    assert found["weights"] == 8
    assert found["unseen_ratio"] < 0.02
    assert found["unseen_windows"] == 8
    assert found["unseen_worse_percent"] == 0
    assert (tmp_path / "run" / "curves.png").exists()
    assert list((tmp_path / "run" / "tensorboard").iterdir())


@pytest.mark.bits
@pytest.mark.parametrize(
    "more", [(), ("--average", "0.9", "--reuse", "3")], ids=["plain", "average and reuse"]
)
@pytest.mark.usefixtures("undrawn")
def test_three_steps_and_three_are_six_bit_for_bit(tmp_path, capsys, more):
    options = ["--steps", "6", "--save-every", "100", "--validate-every", "2", *more]
    assert train(tmp_path / "whole", *options) == 0
    made = []

    def interrupt(indices):
        made.append(len(indices))
        if len(made) == 4:  # the probe, then three steps
            signal.raise_signal(signal.SIGINT)

    register(before=interrupt)
    assert train(tmp_path / "parts", *options) == 130
    assert (
        json.loads((tmp_path / "parts" / "checkpoint" / "checkpoint.json").read_text())["progress"]["step"]
        == 3
    )
    register()
    assert main(train_flow.study, train_flow.Config, ["--resume", str(tmp_path / "parts")]) == 0
    whole = state_of(tmp_path / "whole")
    parts = state_of(tmp_path / "parts")
    assert whole.keys() == parts.keys()
    assert [name for name in whole if whole[name] != parts[name]] == []
    assert (
        checkpoint.read(tmp_path / "whole" / "network.safetensors").weights["layer.weight"].tolist()
        == checkpoint.read(tmp_path / "parts" / "network.safetensors").weights["layer.weight"].tolist()
    )
    same = [
        name
        for name in metrics_of(tmp_path / "whole")
        if not name.startswith(("cpu_", "versions", "hardware"))
    ]
    assert {name: metrics_of(tmp_path / "whole")[name] for name in same} == {
        name: metrics_of(tmp_path / "parts")[name] for name in same
    }
    assert "step 6" in capsys.readouterr().out


@pytest.mark.usefixtures("undrawn")
def test_a_killed_run_goes_on_from_its_last_checkpoint(tmp_path):
    options = ["--steps", "6", "--save-every", "2"]
    assert train(tmp_path / "whole", *options) == 0
    made = []

    def killed(indices):
        made.append(len(indices))
        if len(made) == 6:  # in the fifth step, with nothing saved since the fourth
            raise MemoryError("killed")

    register(before=killed)
    with pytest.raises(MemoryError):
        train(tmp_path / "parts", *options)
    (tmp_path / "parts" / "checkpoint" / "step_0000009.safetensors").write_bytes(
        b"cut short while it was written"
    )
    register()
    assert main(train_flow.study, train_flow.Config, ["--resume", str(tmp_path / "parts")]) == 0
    assert state_of(tmp_path / "whole") == state_of(tmp_path / "parts")


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("name", ["supervised", "motion", "contrast", "photometric"])
def test_the_loss_is_the_one_that_is_asked_for(tmp_path, name):
    """The loss of the first step, put together by hand from the published terms."""
    options = (
        ["--loss", "supervised", "--unit", "motion"] if name == "motion" else ["--loss", name, "--unit", "px"]
    )
    given = Linear()
    torch.nn.init.constant_(given.layer.weight, 0.2)
    checkpoint.save(given, tmp_path / "given.safetensors")
    assert (
        train(
            tmp_path / "run",
            *options,
            "--steps",
            "1",
            "--smoothness",
            "0.3",
            "--start",
            str(tmp_path / "given.safetensors"),
        )
        == 0
    )
    (path,) = (tmp_path / "run" / "checkpoint").glob("*.safetensors")
    windows = Made().batch(range(4))
    flow = given(windows.volume).flow_px.detach()
    truth = windows.truth.flow_px
    error2 = (flow - truth).square().sum(1)
    length2 = truth.square().sum(1)

    def charbonnier(squared):
        return ((squared + 1e-4).sqrt() - 1e-2).mean()

    expected = {
        "supervised": lambda: charbonnier(error2),
        "motion": lambda: charbonnier(error2 / (1 + length2.mean((1, 2), keepdim=True))),
        "contrast": lambda: losses.contrast_loss(windows.volume, flow) + 0.3 * losses.smoothness_loss(flow),
        "photometric": lambda: (
            losses.photometric_loss(windows.frames, flow) + 0.3 * losses.smoothness_loss(flow)
        ),
    }[name]()
    assert checkpoint.read_tensors(path)[0]["curve/loss"].item() == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.usefixtures("undrawn")
def test_a_run_begins_with_the_weights_it_is_given(tmp_path, capsys):
    given = Linear()
    with torch.no_grad():
        given.layer.weight.copy_(TRUE_WEIGHTS[:, :, None, None])
    checkpoint.save(given, tmp_path / "given.safetensors")
    assert (
        train(
            tmp_path / "run",
            "--start",
            str(tmp_path / "given.safetensors"),
            "--steps",
            "1",
            "--learning-rate",
            "1e-9",
        )
        == 0
    )
    assert metrics_of(tmp_path / "run")["unseen_ratio"] < 1e-6
    assert (
        train(
            tmp_path / "other",
            "--start",
            str(tmp_path / "given.safetensors"),
            "--steps",
            "1",
            "--network",
            "flownet-events",
        )
        == 2
    )
    assert "holds a 'linear', --network is 'flownet-events'" in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_gradients_that_are_shortened_are_counted(tmp_path):
    """The gradient of a mean distance w.r.t. TRUE_WEIGHTS' estimate is of order 1: never above 1e3, always
    above 1e-6."""
    assert train(tmp_path / "none", "--steps", "5", "--clip", "1000") == 0
    assert train(tmp_path / "all", "--steps", "5", "--clip", "1e-6") == 0
    assert metrics_of(tmp_path / "none")["clipped_steps"] == 0
    assert metrics_of(tmp_path / "all")["clipped_steps"] == 5


@pytest.mark.usefixtures("undrawn")
def test_processor_time_is_a_budget(tmp_path):
    """A step costs milliseconds, so the run ends within a tenth of a budget of 0.6 s."""
    assert train(tmp_path / "run", "--cpu-minutes", "0.01") == 0
    found = metrics_of(tmp_path / "run")
    assert 0.01 <= found["cpu_data_minutes"] + found["cpu_training_minutes"] < 0.011
    assert found["steps"] > 5


@pytest.mark.usefixtures("undrawn")
def test_the_last_tenth_of_a_data_set_is_judged_on_alone(tmp_path, monkeypatch):
    class Folder(Made):
        def __len__(self):
            return 30

    asked = []
    opened = []
    monkeypatch.setattr(
        train_flow_setup,
        "open_windows",
        lambda *options: opened.append(options) or Folder(before=lambda indices: asked.append(list(indices))),
    )
    assert (
        train(
            tmp_path / "run",
            "--data",
            str(tmp_path),
            "--window-frames",
            "2",
            "--steps",
            "14",
            "--validate-every",
            "100",
        )
        == 0
    )
    assert opened == [(tmp_path, 2, 2, (16, 16), 0, 0.02)]
    probe = asked[0]
    steps = asked[1:15]
    judged = asked[15]
    assert probe == [0, 13, 26]
    seen = [index for batch in steps for index in batch]
    assert sorted(seen[:27]) == list(range(27)), "each window once before any comes again"
    assert max(seen) == 26
    assert judged == [27, 28, 29]
    assert metrics_of(tmp_path / "run")["held_out_windows"] == 3


@pytest.mark.usefixtures("undrawn")
def test_two_processes_learn_what_one_does(tmp_path):
    """Halves of a batch are averaged in another order: float32 sums of 1024 terms differ by 1e-5 at most, and
    AdamW takes steps of at most 1e-2 times the relative change of a gradient, so three steps stay within
    1e-5."""
    assert train(tmp_path / "one", "--steps", "3", "--learning-rate", "0.01") == 0
    arguments = [*BASE, "--steps", "3", "--learning-rate", "0.01", "--out", str(tmp_path / "two")]
    script = f"""
import sys
from tests.flow_training_case import register, train_flow, undraw
register()
undraw()
sys.exit(train_flow.run_here({arguments!r}))
"""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "OMP_NUM_THREADS": "1",
        "WORLD_SIZE": "2",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
    }

    def start(rank):
        return subprocess.Popen(
            [sys.executable, "-c", script],
            env={**environment, "RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    processes = [start(0), start(1)]  # with the variables that torchrun sets
    try:
        said = [process.communicate(timeout=300)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
    assert [process.returncode for process in processes] == [0, 0], said
    assert "Done: " in said[0]
    assert said[1] == "", "one process speaks"
    one, two = (
        checkpoint.load(tmp_path / name / "network.safetensors").get_parameter("layer.weight")
        for name in ("one", "two")
    )
    assert torch.allclose(one, two, atol=1e-5, rtol=0)
    assert not torch.equal(one, Linear().layer.weight)
    losses = [
        checkpoint.read_tensors(next((tmp_path / name / "checkpoint").glob("*.safetensors")))[0]["curve/loss"]
        for name in ("one", "two")
    ]
    assert torch.allclose(*losses, rtol=1e-5)
