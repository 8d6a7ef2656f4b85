"""The folder of a run and its configuration: what is left there, refused, and taken up again."""

import json
import re
import shlex
import subprocess
from pathlib import Path

import pytest
import torch

from codesign.errors import DomainError, FileFormatError
from studies.frame.run import main, open_run
from tests import refusals
from tests.processes import ROOT
from tests.studies.runs import contents, numbers, stored
from tests.studies.smallest_study import Config, record_one


def test_command_leaves_what_the_contract_names(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    assert command("--limit", 0.5, "--sizes", 3, 4, 5) == (0, "")
    (folder,) = (tmp_path / "runs" / "smallest_study").iterdir()
    assert set(contents(folder)) == {"config.json", "metrics.json", "report.html"}
    config = stored(folder, "config")
    # the device is the one that computed
    assert config.pop("device") in ("cpu", "cuda")
    frame = {"study": "smallest_study", "quick": False, "out": None, "seed": 0, "resume": None}
    assert config == {**frame, "limit": 0.5, "sizes": [3, 4, 5]}
    metrics = stored(folder, "metrics")
    assert metrics["limit"] == 0.5
    packages = {"codesign", "torch", "mitsuba", "drjit", "numpy", "kornia"}
    assert metrics["versions"].keys() == {"python", "commit", *packages}
    assert metrics["versions"]["torch"] == torch.__version__
    assert metrics["hardware"]["cores"] >= 1
    if (ROOT / ".git").exists():
        head = subprocess.run(
            ["git", "-C", ROOT, "rev-parse", "HEAD"], capture_output=True, text=True, check=True
        )
        assert metrics["versions"]["commit"].removesuffix("+changes") == head.stdout.strip()


@refusals.table(__file__, "configurations")
def test_a_configuration_of_other_types_is_one_sentence(run, command, row):
    path = run.folder / "config.json"
    path.write_text(json.dumps(stored(run.folder, "config") | json.loads(row.call)))
    code, complaint = command("--resume", run.folder)
    assert code == 2
    assert f": {row.sentence}" in complaint
    assert complaint.count("\n") == 1


@pytest.mark.parametrize("place", ["file/sub", "file", "/proc/self/results"])
def test_unwritable_folder_is_one_sentence(tmp_path, command, place):
    if place[0] == "/" and not Path("/proc/self").is_dir():
        pytest.skip("needs a folder that even root cannot write into")
    (tmp_path / "file").write_text("kept")
    code, complaint = command("--out", tmp_path / place)
    assert code == 2
    reason = r"cannot be (made|read) \(.*\); choose a folder you may write to with --out\."
    told = rf"error: the output folder '.*' {reason}\n"
    assert re.fullmatch(told, complaint)
    assert contents(tmp_path) == {"file": b"kept"}


def test_earlier_results_are_left_alone_and_hints_can_be_pasted(tmp_path, command):
    out = tmp_path / "it's a folder; rm"
    assert command("--out", out)[0] == 0
    before = contents(tmp_path)
    code, complaint = command("--out", out)
    assert code == 2
    assert "already holds a run of this study" in complaint
    # read back by a shell's rules, the command of a hint names the folder as it is
    hint = shlex.split(complaint[complaint.index("python -m") :])
    assert hint == ["python", "-m", "studies.smallest_study", "--resume", str(out)]
    assert contents(tmp_path) == before
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "config.json").write_text("{}")
    code, complaint = command("--out", tmp_path / "photos")
    assert code == 2
    assert "holds other things (config.json)" in complaint


def test_bad_input_can_be_repaired_in_the_same_folder(out, command):
    def refuse(run):
        raise DomainError("limit is 9,\nbut at most 2 is allowed; lower it.")

    said = "error: limit is 9, but at most 2 is allowed; lower it.\n"
    assert command("--out", out, "--limit", 9, study=refuse) == (2, said)
    assert command("--out", out, "--limit", 2)[0] == 0
    assert stored(out, "config")["limit"] == 2


def test_resume_needs_a_run_of_the_same_study(tmp_path, command):
    other = open_run("other", Config(out=tmp_path / "other")).folder
    newer = stored(other, "config") | {"study": "smallest_study", "colour": "red"}
    for folder, sentence in (
        (tmp_path / "nowhere", "is not a run that can be resumed"),
        (other, "study 'other'"),
    ):
        code, complaint = command("--resume", folder)
        assert code == 2
        assert sentence in complaint
    (other / "config.json").write_text(json.dumps(newer))
    code, complaint = command("--resume", other)
    assert code == 2
    assert "another version of this study (fields that differ: colour)" in complaint


def test_resume_takes_the_stored_configuration_and_metrics(tmp_path):
    made = open_run("smallest_study", Config(out=tmp_path / "out", limit=0.25, sizes=(9,), seed=4))
    made.record(early=1)
    again = open_run("smallest_study", Config(resume=tmp_path / "out"))
    assert again.resumed
    assert again.config == made.config
    again.record(late=2)
    assert numbers(tmp_path / "out") == {"early": 1, "late": 2}
    (tmp_path / "out" / "metrics.json").write_text('{"loss": "0.5"}')
    with pytest.raises(FileFormatError, match="is damaged; remove it to go on"):
        open_run("smallest_study", Config(resume=tmp_path / "out"))


@pytest.mark.parametrize(
    ("typed", "ran"),
    [
        ([], 1.0),
        (["--quick"], 0.125),
        (["--quick", "--limit", "0.5"], 0.5),
        (["--limit", "1.0", "--quick"], 1.0),  # the default, but typed
    ],
)
def test_what_is_typed_comes_before_what_quick_sets(out, command, typed, ran):
    assert command("--out", out, *typed)[0] == 0
    config = stored(out, "config")
    assert numbers(out)["limit"] == config["limit"] == ran
    assert config["quick"] == ("--quick" in typed)


def test_resume_refuses_only_what_differs_from_the_stored_run(out, command):
    assert command("--out", out, "--quick", "--limit", 0.5)[0] == 0
    for typed in ([], ["--quick"], ["--limit", 0.5], ["--out", out], ["--device", "auto"]):
        assert command("--resume", out, *typed)[0] == 0, typed
        assert numbers(out)["limit"] == 0.5
    # neither the default nor the quick value is what ran, so typing it is refused like any other
    for typed in (["--limit", 1.0], ["--limit", 0.125], ["--no-quick"], ["--seed", 1]):
        code, complaint = command("--resume", out, *typed)
        assert code == 2, typed
        assert "but the run to resume was started with" in complaint
        assert complaint.count("\n") == 1


def test_resume_takes_anew_how_it_is_computed(out, command, monkeypatch):
    assert command("--out", out)[0] == 0
    monkeypatch.setattr(Config, "ANEW", ("limit",))
    assert command("--resume", out, "--limit", 0.25)[0] == 0
    assert numbers(out)["limit"] == 0.25
    assert command("--resume", out, "--seed", 1)[0] == 2


def test_a_run_that_other_code_goes_on_with_says_so(out, monkeypatch, capsys):
    commits = iter(["a1", "a1", "b2", "b2"])
    monkeypatch.setattr("studies.frame.machine._commit", lambda root: next(commits))
    run = open_run("smallest_study", Config(out=out))
    said = []
    for _ in range(3):
        run.save_state({}, {})
        run = open_run("smallest_study", Config(resume=out))
        run.record(one=1.0)
        said.append(stored(out, "metrics")["versions"]["commit"])
    assert said == ["a1", "a1, b2", "a1, b2"]
    assert capsys.readouterr().out.count("made so far by commit a1, and goes on with b2") == 1


def test_wrong_options_exit_with_two_and_help_explains_them(command, capsys, monkeypatch):
    for arguments, code in ((["--limit", "much"], 2), (["--colour", "red"], 2), (["--help"], 0)):
        with pytest.raises(SystemExit) as ended:
            main(record_one, Config, arguments)
        assert ended.value.code == code
    shown = capsys.readouterr().out
    for option in ("quick", "out", "seed", "device", "limit"):
        assert f"--{option}" in shown
    assert "Folder of an interrupted run" in shown
    said = "error: option --limit is inf; give a finite number, or leave the option out.\n"
    assert command("--limit", "inf") == (2, said)
    said = "error: this study computes on the processor; leave --device out.\n"
    assert command("--device", "cuda") == (2, said)
    monkeypatch.setattr(Config, "GPU", True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    code, complaint = command("--device", "cuda")
    assert code == 2
    assert "no CUDA device" in complaint


def test_what_was_begun_on_a_gpu_goes_on_where_there_is_one(out, command, monkeypatch):
    assert command("--out", out)[0] == 0
    begun = out / "config.json"
    begun.write_text(begun.read_text().replace('"device": "cpu"', '"device": "cuda"'))
    monkeypatch.setattr(Config, "GPU", True)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    said = "error: the run to resume was begun on a GPU; go on on a machine that has one, or start a new run.\n"
    assert command("--resume", out) == (2, said)
