"""Training of flow networks: unfit options, files and checkpoints are refused with one sentence, before the
first step."""

import json

import pytest

from studies.frame.run import main
from studies.train_flow import __main__ as train_flow
from tests.flow_training_case import register, tables_kept, train, undraw


@pytest.fixture(autouse=True)
def registered():
    with tables_kept():
        register()
        yield


@pytest.fixture
def undrawn(monkeypatch):
    undraw(monkeypatch.setattr)


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda folder: (folder / "checkpoint.json").write_text("{"), "is no whole JSON file"),
        (lambda folder: next(folder.glob("*.safetensors")).write_bytes(b"short"), "is damaged"),
        (lambda folder: next(folder.glob("*.safetensors")).unlink(), "no file lies at"),
        (lambda folder: edit(folder, version=9), "format version 9"),
        (lambda folder: edit(folder, network="refiner"), "written with network refiner, this run has linear"),
        (lambda folder: edit(folder, seed=5), "written with seed 5, this run has 0"),
        (lambda folder: edit(folder, tensors="../network.safetensors"), "outside its folder"),
    ],
)
@pytest.mark.usefixtures("undrawn")
def test_a_checkpoint_that_does_not_fit_is_named(tmp_path, capsys, damage, sentence):
    assert train(tmp_path / "run", "--steps", "1") == 0
    damage(tmp_path / "run" / "checkpoint")
    capsys.readouterr()
    assert main(train_flow.study, train_flow.Config, ["--resume", str(tmp_path / "run")]) == 2
    assert sentence in capsys.readouterr().err


def edit(folder, **changes):
    path = folder / "checkpoint.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--network", "refinr"], "network 'refinr' is unknown; choose one of ecn, flownet-events"),
        (["--options", "depth=3"], "has no option 'depth'; it has bins, gain"),
        (["--options", "gain"], "give name=number"),
        (["--weights", "500"], "which 'linear' does not"),
        (["--mix", "fog"], "--mix fog is unknown; choose one of"),
        (["--validate-on", "fog"], "--validate-on fog is unknown"),
        (["--loss", "guess"], "--loss guess is unknown; choose one of supervised"),
        (["--loss", "photometric"], "needs frames, and these windows have none"),
        (["--bins", "5"], "the windows have 2 time bins, the network 5"),
        (["--steps", "0"], "--steps is 0"),
        (["--cpu-minutes", "-1"], "--cpu-minutes is -1.0"),
        (["--batch", "0"], "--batch is 0; at least 1"),
        (["--warm-up", "1"], "warm-up 1.0"),
        (["--mixed-precision"], "--mixed-precision needs CUDA"),
        (["--start", "nowhere.safetensors"], "no file lies at nowhere.safetensors"),
    ],
)
@pytest.mark.usefixtures("undrawn")
def test_what_is_unfit_is_refused_before_the_first_step(tmp_path, capsys, options, sentence):
    made = []
    register(before=lambda indices: made.append(list(indices)), frames=False)
    assert train(tmp_path / "run", *options) == 2
    complaint = capsys.readouterr().err
    assert sentence in complaint
    assert len(complaint.splitlines()) == 1
    assert made in ([], [[0]]), "one window may be looked at, no more"
    assert not (tmp_path / "run" / "checkpoint").exists()


@pytest.mark.usefixtures("undrawn")
def test_a_loss_that_is_not_finite_ends_the_run(tmp_path, capsys):
    assert train(tmp_path / "run", "--steps", "2", "--options", "gain=1e30") == 2
    assert "step 0: loss inf" in capsys.readouterr().err
