"""Training of flow networks from the command line: what is learnt, resumed, shared between
processes, raced, and refused."""

import json
import signal
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from codesign.flow import checkpoint, losses
from studies.train_flow import __main__ as train_flow
from studies.train_flow import race as races
from studies.train_flow import setup as train_flow_setup
from tests import refusals
from tests.flow_training_case import (
    BASE,
    OPTIONS,
    TRUE_WEIGHTS,
    Linear,
    Made,
    Own,
    in_two_processes,
    metrics_of,
    register,
    resume,
    state_of,
    tables_kept,
    train,
    undraw,
)
from tests.studies.browser import check_page
from tests.studies.runs import ran, stored


@pytest.fixture(autouse=True)
def registered():
    with tables_kept():
        register()
        yield


@pytest.fixture
def undrawn(monkeypatch):
    undraw(monkeypatch.setattr)


def weight_of(folder):
    return checkpoint.load(folder / "network.safetensors").get_parameter("layer.weight").detach()


def test_training_finds_the_known_answer(tmp_path):
    """At the end of a falling schedule AdamW is within about its last step sizes of the answer:
    1e-2 of weights of order 1."""
    options = "--steps 250 --learning-rate 0.05 --weight-decay 0 --clip 10 --average 0 --reuse 1"
    assert train(tmp_path, options) == 0
    check_page("train_flow", tmp_path)
    assert torch.allclose(weight_of(tmp_path)[:, :, 0, 0], TRUE_WEIGHTS, atol=1e-2)
    found = metrics_of(tmp_path)
    expected = {"steps": 250, "windows_shown": 1000, "weights": 8, "unseen_windows": 8}
    assert {name: found[name] for name in expected} == expected
    assert found["unseen_ratio"] < 0.02
    assert found["unseen_worse_percent"] == 0
    assert (tmp_path / "curves.png").exists()
    assert list((tmp_path / "tensorboard").iterdir())


@pytest.mark.bits
@pytest.mark.usefixtures("undrawn")
def test_three_steps_and_three_are_six_bit_for_bit(tmp_path, capsys):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    options = "--steps 6 --save-every 100 --validate-every 2 --average 0.9 --reuse 3"
    assert train(whole, options) == 0
    made = []

    def interrupt(indices):
        made.append(len(indices))
        # the probe, then three steps
        if len(made) == 4:
            signal.raise_signal(signal.SIGINT)

    register(before=interrupt)
    assert train(parts, options) == 130
    assert stored(parts / "checkpoint", "checkpoint")["progress"]["step"] == 3
    # cut short while it was written
    (parts / "checkpoint" / "step_0000009.safetensors").write_bytes(b"cut short")
    register()
    assert resume(parts) == 0
    assert state_of(whole / "checkpoint") == state_of(parts / "checkpoint")
    assert torch.equal(weight_of(whole), weight_of(parts))
    one, two = (metrics_of(folder) for folder in (whole, parts))
    assert {name for name in one if one[name] != two[name]} <= {
        name for name in one if name[:4] == "cpu_"
    }
    assert "step 6" in capsys.readouterr().out


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "kind",
    [
        "supervised --unit px",
        "supervised --unit motion",
        "contrast --smoothness 0.3",
        "photometric --smoothness 0.3",
    ],
)
def test_the_loss_is_the_one_that_is_asked_for(tmp_path, kind):
    """The loss of the first step, put together by hand from the published terms."""
    given = Linear()
    torch.nn.init.constant_(given.layer.weight, 0.2)
    checkpoint.save(given, tmp_path / "given.safetensors")
    start = f"--start {tmp_path / 'given.safetensors'}"
    assert train(tmp_path / "run", f"--loss {kind} --steps 1 {start}") == 0
    windows = Made().batch(range(4))
    flow = given(windows.volume).flow_px.detach()
    truth = windows.truth.flow_px
    if "supervised" in kind:
        unit2 = 1 + truth.square().sum(1).mean((1, 2), keepdim=True) if "motion" in kind else 1
        expected = (((flow - truth).square().sum(1) / unit2 + 1e-4).sqrt() - 1e-2).mean()
    else:
        by_frames = losses.photometric_loss(windows.frames, flow)
        fit = losses.contrast_loss(windows.volume, flow) if "contrast" in kind else by_frames
        expected = fit + 0.3 * losses.smoothness_loss(flow)
    (path,) = (tmp_path / "run" / "checkpoint").glob("*.safetensors")
    assert checkpoint.read_tensors(path)[0]["curve/loss"].item() == pytest.approx(
        float(expected), rel=1e-5
    )


@pytest.mark.usefixtures("undrawn")
def test_processor_time_is_a_budget(tmp_path):
    """A step costs milliseconds, so the run ends within a tenth of a budget of 0.6 s."""
    assert train(tmp_path, "--cpu-minutes 0.01 --clip 1e-6") == 0
    found = metrics_of(tmp_path)
    assert 0.01 <= found["cpu_data_minutes"] + found["cpu_training_minutes"] < 0.011
    # a gradient of order 1 is always shortened to 1e-6
    assert found["clipped_steps"] == found["steps"] > 5


@pytest.mark.usefixtures("undrawn")
def test_the_last_tenth_of_a_data_set_is_judged_on_alone(tmp_path, monkeypatch):
    class Folder(Made):
        def __len__(self):
            return 30

    asked = []
    opened = []

    def open_windows(*options):
        opened.append(options)
        return Folder(before=lambda indices: asked.append(list(indices)))

    monkeypatch.setattr(train_flow_setup, "open_windows", open_windows)
    options = f"--data {tmp_path} --mix real --window-frames 2 --steps 14 --validate-every 100"
    assert train(tmp_path / "run", options) == 0
    assert opened == [(tmp_path, 2, 2, (16, 16), 0, 0.02)]
    assert asked[:30] == [[k] for k in range(30)], "whether they hold events"
    del asked[:30]
    probe, *steps = asked[:15]
    assert probe == [0, 13, 25]
    seen = [index for batch in steps for index in batch]
    assert sorted(seen[:26]) == list(range(26)), "each window once before any comes again"
    assert max(seen) == 25, "window 26 ends within the first that is held out"
    assert asked[15] == [27, 28, 29]
    assert metrics_of(tmp_path / "run")["held_out_windows"] == 3


@pytest.mark.parametrize("empty", [15, 16])
def test_windows_that_are_mostly_empty_are_warned_of(empty, recwarn):
    class Cut(list):
        def batch(self, indices):
            counts = torch.tensor([self[k] for k in indices])
            return SimpleNamespace(volume=SimpleNamespace(counts=counts))

    whole = Cut([0] * empty + [3] * (30 - empty))
    train_flow_setup._warn_of_empty(SimpleNamespace(data="mine"), whole)
    said = [str(each.message) for each in recwarn]
    assert bool(said) == (empty == 16)
    assert all("16 of 30 windows of 'mine'" in each for each in said)


SHARED = """
import sys
from tests.flow_training_case import register, train_flow, undraw
register()
undraw()
sys.exit(train_flow.run_here(sys.argv[1:]))
"""


@pytest.mark.usefixtures("undrawn")
def test_two_processes_learn_what_one_does(tmp_path):
    """Halves of a batch are averaged in another order: float32 sums of 1024 terms differ by 1e-5 at
    most, and AdamW takes steps of at most 1e-2 times the relative change of a gradient, so three
    steps stay within 1e-5."""
    options = "--steps 3 --learning-rate 0.01"
    one, two = tmp_path / "one", tmp_path / "two"
    assert train(one, options) == 0
    codes, said = in_two_processes(SHARED, *BASE, *options.split(), "--out", two)
    assert codes == [0, 0], said
    assert "Done: " in said[0]
    assert said[1] == "", "one process speaks"
    torch.testing.assert_close(weight_of(one), weight_of(two), atol=1e-5, rtol=0)
    assert not torch.equal(weight_of(one), Linear().layer.weight)


def test_a_race_trains_every_network_with_every_seed_and_judges_them_alike(tmp_path, monkeypatch):
    """Ours errs by half of the flow, the rival by a quarter; the commands of trainings are looked
    at, not run."""

    def judging(seed, bins, windows, world_windows, real_windows):
        return {"unseen": (Made(seed), windows), "worlds": (Made(3), world_windows)}

    monkeypatch.setattr(races, "NAMES", {"refiner": "refiner"})
    monkeypatch.setattr(races, "judging", judging)
    commands = {}

    def trained(job, command, children):
        options = dict(zip(command[3::2], command[4::2], strict=True))
        commands[job[0], options["--seed"]] = options
        network, share = (Linear(), 0.5) if job[0] == "refiner" else (Own(), 0.75)
        with torch.no_grad():
            network.layer.weight.copy_(share * TRUE_WEIGHTS[:, :, None, None])
        Path(options["--out"]).mkdir()
        checkpoint.save(network, Path(options["--out"]) / "network.safetensors")

    monkeypatch.setattr(races, "_trained", trained)
    own = "tests.flow_training_case:Own"
    options = f"--own {own} --seeds 0 1 --cpu-minutes 3 --learning-rate 0.01 --final-windows 6"
    assert ran(train_flow, f"--race {options} --out", tmp_path / "run") == 0
    check_page("train_flow", tmp_path / "run")
    assert sorted(commands) == [("refiner", "0"), ("refiner", "1"), (own, "0"), (own, "1")]
    assert commands[own, "1"]["--learning-rate"] == "0.01"
    assert commands["refiner", "0"]["--learning-rate"] == "0.002"
    assert {each["--cpu-minutes"] for each in commands.values()} == {"3.0"}
    found = metrics_of(tmp_path / "run")
    assert found["unseen_refiner_ratio_seed0"] == pytest.approx(0.5, rel=1e-5)
    assert found["unseen_tests_flow_training_case_Own_ratio_seed1"] == pytest.approx(0.25, rel=1e-5)
    assert found["unseen_refiner_over_tests_flow_training_case_Own_worst"] == pytest.approx(
        2, rel=1e-4
    )
    assert (found["unseen_windows"], found["worlds_windows"]) == (6, 2)
    assert (found["shares_met"], found["shares_asked"]) == (0, 2)


def edit(folder, **changes):
    changed = stored(folder, "checkpoint") | changes
    (folder / "checkpoint.json").write_text(json.dumps(changed))


@refusals.table(__file__, "checkpoints of train_flow")
@pytest.mark.usefixtures("undrawn")
def test_a_checkpoint_that_does_not_fit_is_named(tmp_path, capsys, row):
    assert train(tmp_path / "run", "--steps 1") == 0
    eval(row.call, {"folder": tmp_path / "run" / "checkpoint", "edit": edit})
    capsys.readouterr()
    assert resume(tmp_path / "run") == 2
    assert row.sentence in capsys.readouterr().err


@refusals.table(__file__, "train_flow")
@pytest.mark.usefixtures("undrawn")
def test_what_is_unfit_is_refused_before_the_first_step(tmp_path, refuses, row):
    made = []
    register(before=lambda indices: made.append(list(indices)), frames=False)
    refuses(train_flow, row, OPTIONS)
    if "gain=1e30" not in row.call:
        assert made in ([], [[0]]), "one window may be looked at, no more"
    assert not (tmp_path / "run" / "checkpoint").exists()
