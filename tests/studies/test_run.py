"""The frame of a study: exact state, interruption and resumption, refusals, metrics, a page that loads
nothing."""

import contextlib
import errno
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

from codesign.errors import CodesignError, DomainError, FileFormatError, NonFiniteError, ShapeError
from codesign.state import write_state
from studies.frame.config import StudyConfig
from studies.frame.machine import versions
from studies.frame.run import Run, main, open_run

ROOT = Path(__file__).resolve().parents[2]
# a noisy descent: its numbers depend on the generator, the momentum and the step counter, so a wrong resume
# shows
WALK = '''
"""A walk that can be interrupted."""
import sys, time
from dataclasses import dataclass
import torch
from studies.frame.run import Run, StudyConfig, main

@dataclass(frozen=True)
class Config(StudyConfig):
    steps: int = 40
    """Number of steps."""
    pause_s: float = 0.0

def study(run: Run[Config]):
    generator = torch.Generator().manual_seed(run.config.seed)
    x, velocity, first = torch.ones(3), torch.zeros(3, dtype=torch.float64), 0
    if (state := run.load_state()) is not None:
        x, velocity, first = state.tensors["x"], state.tensors["velocity"], state.numbers["step"]
        generator.set_state(state.tensors["generator"])
    step = first
    save = lambda: run.save_state({"x": x, "velocity": velocity, "generator": generator.get_state()}, {"step": step})
    run.on_interrupt(save)
    with run.progress(run.config.steps, "walking", done=first) as bar:
        while step < run.config.steps:
            velocity = 0.9 * velocity - 0.1 * x.double() + 0.01 * torch.randn(3, generator=generator)
            x = x + velocity.float()
            time.sleep(run.config.pause_s)
            step += 1
            run.say(f"step {step}")
            bar.advance(loss=x.square().sum())
    run.record(loss_last=x.square().sum(), x_0=x[0], steps=step, first_step=first)
    run.finish("A walk", "It went on.")

if __name__ == "__main__":
    sys.exit(main(study, Config))
'''


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"limit": 0.125}
    limit: float = 1.0
    sizes: tuple[int, ...] = (1, 2)


@pytest.fixture
def run(tmp_path):
    return open_run("test_run", Config(out=tmp_path / "out"))


def record_one(run: Run[Config]):
    """The smallest study."""
    run.record(limit=run.config.limit)
    run.finish("One number", "It was recorded.")


def contents(folder):
    return {path.name: path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}


def test_state_returns_every_bit(run, generator):
    tensors = {
        "float32": torch.randn(3, 4, generator=generator).T,
        "float64/odd name": torch.tensor([0.1, torch.nan, -0.0, torch.inf, 5e-324], dtype=torch.float64),
        "int64": torch.tensor([2**62 + 1, -1]),
        "bool": torch.tensor([True, False]),
        "scalar": torch.tensor(1 / 3),
        "empty": torch.zeros(0, 2),
        "file": torch.randn(2, generator=generator).requires_grad_(),
        "generator": generator.get_state(),
    }
    numbers = {"step": 7, "best": 0.1 + 0.2, "history": [1e-300, float("inf")], "name": "π"}
    run.save_state(tensors, numbers)
    stored = run.load_state()
    assert stored.numbers == numbers
    assert list(stored.tensors) == list(tensors)
    for name, tensor in tensors.items():
        back = stored.tensors[name]
        assert back.dtype == tensor.dtype
        assert back.shape == tensor.shape
        assert back.numpy().tobytes() == tensor.detach().numpy().tobytes()
    other = torch.Generator()
    other.set_state(stored.tensors["generator"])
    assert torch.equal(torch.randn(9, generator=other), torch.randn(9, generator=generator))


def test_state_is_data_and_damage_is_named(run):
    assert run.load_state() is None
    run.save_state({"x": torch.ones(2)}, {})
    with np.load(run.folder / "state.npz", allow_pickle=False) as stored:
        assert all(stored[name].dtype != object for name in stored.files)
    with pytest.raises(ShapeError, match="bfloat16"):
        run.save_state({"x": torch.ones(2, dtype=torch.bfloat16)}, {})
    assert torch.equal(run.load_state().tensors["x"], torch.ones(2)), (
        "a refused state must not touch the last one"
    )
    for damage in (b"", b"not a state", (run.folder / "state.npz").read_bytes()[:-30]):
        (run.folder / "state.npz").write_bytes(damage)
        with pytest.raises(FileFormatError, match="not a state file"):
            run.load_state()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupted_and_resumed_gives_the_same_numbers(tmp_path, number, code):
    (tmp_path / "walk.py").write_text(WALK)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-W", "error", "walk.py"]
    whole = subprocess.run(
        [*command, "--out", "whole"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert whole.returncode == 0, whole.stderr
    assert "walking  40/40  loss" in whole.stdout

    broken = subprocess.Popen(
        [*command, "--out", "with space", "--pause-s", "0.05"],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert broken.stdout is not None
    while broken.stdout.readline() != "step 5\n":
        assert broken.poll() is None, broken.communicate()
    broken.send_signal(signal.SIGSTOP)  # it is there, and gets no further
    second = subprocess.run(
        [*command, "--resume", "with space"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert second.returncode == 2
    assert second.stderr.startswith("error: another process works on the run in 'with space'")
    broken.send_signal(signal.SIGCONT)
    broken.send_signal(number)
    _, complaint = broken.communicate(timeout=60)
    assert broken.returncode == code, complaint
    left = [
        tmp_path / "with space" / name for name in (".decay-a_b3c4d5.mp4", ".state-abcdefgh.npz", ".mine")
    ]
    for path in left:  # as a killed run leaves them, and one that is none of ours
        path.write_bytes(b"half")
    assert (
        complaint.splitlines()[-1] == "interrupted; go on with: python -m studies.walk --resume 'with space'"
    )
    assert not (tmp_path / "with space" / "metrics.json").exists()

    resumed = subprocess.run(
        [*command, "--resume", "with space"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert resumed.returncode == 0, resumed.stderr
    first, second = (
        json.loads((tmp_path / folder / "metrics.json").read_text()) for folder in ("whole", "with space")
    )
    assert 5 <= second.pop("first_step") < 40, "the second session must start where the first one stopped"
    assert first.pop("first_step") == 0
    assert {k: v for k, v in first.items() if k not in ("versions", "hardware")} == {
        k: v for k, v in second.items() if k not in ("versions", "hardware")
    }
    assert (tmp_path / "with space" / "report.html").exists()
    assert [path.exists() for path in left] == [False, False, True]
    assert not (tmp_path / "with space" / ".lock").exists()


def test_a_reader_that_goes_away_gets_no_traceback(tmp_path):
    (tmp_path / "walk.py").write_text(WALK)
    for command in ("walk.py --help", "-m codesign --help", "-m codesign list", "-m studies"):
        done = subprocess.run(
            f"{shlex.quote(sys.executable)} {command} | head -c 1",
            shell=True,
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "4000"},
            capture_output=True,
            check=False,
        )
        assert done.stderr == b"", command


FORKED = """
import os, signal
from codesign.interrupt import Interruption
with Interruption() as interruption:
    interruption.in_loop = True
    ready, told = os.pipe()
    if not (worker := os.fork()):
        os.write(told, b"!")
        signal.pause()
    os.read(ready, 1)
    os.kill(worker, signal.SIGTERM)
    print(os.waitstatus_to_exitcode(os.waitpid(worker, 0)[1]), interruption.requested)
"""


def test_a_forked_worker_ends_when_its_pool_does():
    """Handlers go to forked workers too: one that waited for its next step would never end."""
    done = subprocess.run(
        [sys.executable, "-c", FORKED], capture_output=True, text=True, check=True, timeout=60, cwd=ROOT
    )
    assert done.stdout == "-15 False\n"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("limit", "much"),
        ("limit", True),
        ("limit", None),
        ("sizes", [1, "2"]),
        ("sizes", 3),
        ("sizes", [1, [2]]),
        ("seed", 0.5),
        ("quick", 1),
        ("device", "tpu"),
        ("device", ["cpu"]),
        ("out", 7),
    ],
)
def test_a_configuration_of_other_types_is_one_sentence(tmp_path, capsys, name, value):
    out = open_run("test_run", Config(out=tmp_path / "out")).folder
    stored = json.loads((out / "config.json").read_text())
    (out / "config.json").write_text(json.dumps({**stored, name: value}))
    assert main(record_one, Config, ["--resume", str(out)]) == 2
    complaint = capsys.readouterr().err
    assert f": {name} is " in complaint
    assert ", which is no " in complaint
    assert complaint.count("\n") == 1


def test_the_state_of_another_run_is_refused(tmp_path):
    def folder(name, study="test_run", **options):
        made = open_run(study, Config(out=tmp_path / name, **options))
        made.save_state({}, {"step": 1})
        return made.folder

    def resumed(at):
        return open_run("test_run", Config(resume=at)).load_state()

    mine = folder("mine")
    assert resumed(mine).numbers == {"step": 1}
    for other, reason in ((folder("a", "other"), "study"), (folder("b", limit=2.0), "configuration")):
        (mine / "state.npz").write_bytes((other / "state.npz").read_bytes())
        with pytest.raises(FileFormatError, match=f"another {reason}"):
            resumed(mine)
    write_state(mine / "state.npz", {}, {"numbers": {}, "times": {"seconds": 0.0, "loops": {}}})
    with pytest.raises(FileFormatError, match=r"another version .*start a new run"):
        resumed(mine)


@pytest.mark.parametrize(
    ("error", "number", "code", "sentence"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), None, 2, "error: the disk is full"),
        (ImportError("while a library was loaded"), signal.SIGTERM, 143, "interrupted"),
        (ImportError("while a library was loaded"), None, None, ""),
    ],
)
def test_what_libraries_make_of_a_full_disk_or_a_signal(tmp_path, capsys, error, number, code, sentence):
    def study(run):
        if number:
            with contextlib.suppress(KeyboardInterrupt):
                signal.raise_signal(number)
        raise error

    study.__module__ = __name__
    if code is None:
        with pytest.raises(ImportError):
            main(study, Config, ["--out", str(tmp_path / "out")])
        return
    assert main(study, Config, ["--out", str(tmp_path / "out")]) == code
    assert capsys.readouterr().err.startswith(f"{sentence}; go on with: python -m studies.test_run --resume")


def test_second_interrupt_ends_at_once(run):
    saved = []
    run.on_interrupt(lambda: saved.append(True))
    with run._interruption as interruption, run.progress(3, "waiting"):
        signal.raise_signal(signal.SIGINT)
        assert interruption.requested
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert not saved, "in the middle of a step the state is not whole"


def counted(run: Run[Config]):
    """A study of ``sizes[0]`` steps of 20 ms, the first of every session 60 ms longer, and some judging, which
    ends with Ctrl-C where limit is 9."""
    stored = run.load_state()
    done = first = stored.numbers["done"] if stored else 0
    run.on_interrupt(lambda: run.save_state({}, {"done": done}))
    with run.progress(run.config.sizes[0], "stepping", done=first) as bar:
        while done < run.config.sizes[0]:
            clock.now += 0.02 + 0.06 * (done == first)
            done += 1
            bar.advance()
            if done == run.config.sizes[1] and not run.resumed:
                signal.raise_signal(signal.SIGINT)
    with run.progress(2, "judging") as judging:
        for _ in range(2):
            clock.now += 0.5
            if run.config.limit == 9 and not run.resumed:
                signal.raise_signal(signal.SIGINT)
            judging.advance()
    assert bar.seconds_per_step is not None
    run.record(seconds_per_step=bar.seconds_per_step, seconds=run.seconds)
    run.finish("Steps", "They were counted.")


class Clock:
    """Stands in for time.monotonic."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


clock = Clock()


@pytest.mark.parametrize(
    ("steps", "stop_at", "seconds_per_step", "seconds"),
    [
        (10, 4, 0.02, 10 * 0.02 + 2 * 0.06 + 1.0),  # stopped between steps (after the next one)
        (10, None, 0.02, 10 * 0.02 + 0.06 + 1.5),  # stopped while judging: nothing is left but to judge again
        (1, None, 0.08, 0.08 + 1.5),  # one step alone: it is all that was timed
    ],
)
def test_time_per_step_counts_every_session(
    tmp_path, capsys, monkeypatch, steps, stop_at, seconds_per_step, seconds
):
    monkeypatch.setattr("studies.frame.progress.time.monotonic", clock)
    limit = "1" if stop_at else "9"
    out = str(tmp_path / "out")
    options = ["--out", out, "--sizes", str(steps), str(stop_at or 0), "--limit", limit]
    assert main(counted, Config, options) == 130
    assert f"--resume {out}" in capsys.readouterr().err
    clock.now += 1000.0  # between the sessions
    assert main(counted, Config, ["--resume", out]) == 0
    found = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert found["seconds_per_step"] == pytest.approx(seconds_per_step, rel=1e-9)
    assert found["seconds"] == pytest.approx(seconds, rel=1e-9)
    # a run that is complete can be resumed as well, and writes its page again
    (tmp_path / "out" / "report.html").unlink()
    assert main(counted, Config, ["--resume", out]) == 0
    assert (tmp_path / "out" / "report.html").exists()


def test_command_leaves_what_the_contract_names(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(record_one, Config, ["--limit", "0.5", "--sizes", "3", "4", "5"]) == 0
    (folder,) = (tmp_path / "runs" / "test_run").iterdir()
    assert set(contents(folder)) == {"config.json", "metrics.json", "report.html"}
    config, metrics = (json.loads((folder / f"{name}.json").read_text()) for name in ("config", "metrics"))
    assert config == {
        "study": "test_run",
        "quick": False,
        "out": None,
        "seed": 0,
        "device": config["device"],
        "resume": None,
        "limit": 0.5,
        "sizes": [3, 4, 5],
    }
    assert config["device"] in ("cpu", "cuda"), "the stored device is the one that computed"
    assert metrics["limit"] == 0.5
    assert metrics["versions"].keys() == {
        "python",
        "codesign",
        "torch",
        "mitsuba",
        "drjit",
        "numpy",
        "kornia",
        "commit",
    }
    assert metrics["versions"]["torch"] == torch.__version__
    assert metrics["hardware"]["cores"] >= 1
    assert "report.html" in capsys.readouterr().out


@pytest.mark.parametrize("place", ["file/sub", "file"])
def test_unwritable_folder_is_one_sentence(tmp_path, capsys, place):
    (tmp_path / "file").write_text("kept")
    assert main(record_one, Config, ["--out", str(tmp_path / place)]) == 2
    complaint = capsys.readouterr().err
    assert re.fullmatch(
        r"error: the output folder '.*file(/sub)?' cannot be (made|read) \(Not a directory\); choose a "
        r"folder you may write to with --out\.\n",
        complaint,
    )
    assert contents(tmp_path) == {"file": b"kept"}


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a folder that even root cannot write into")
def test_folder_without_write_access_is_one_sentence(capsys):
    assert main(record_one, Config, ["--out", "/proc/self/results"]) == 2
    assert capsys.readouterr().err.startswith("error: the output folder '/proc/self/results' cannot be made")


def test_earlier_results_are_left_alone(tmp_path, capsys):
    out = ["--out", str(tmp_path / "out")]
    assert main(record_one, Config, out) == 0
    before = contents(tmp_path)
    assert main(record_one, Config, out) == 2
    assert "already holds a run of this study" in capsys.readouterr().err
    assert main(record_one, Config, [*out, "--resume", str(tmp_path / "out"), "--limit", "3"]) == 2
    assert "--limit is 3.0, but the run to resume was started with 1.0" in capsys.readouterr().err
    assert contents(tmp_path) == before
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "config.json").write_text("{}")
    assert main(record_one, Config, ["--out", str(tmp_path / "photos")]) == 2
    assert "holds other things (config.json)" in capsys.readouterr().err


def test_bad_input_can_be_repaired_in_the_same_folder(tmp_path, capsys):
    def refuse(run):
        raise DomainError("limit is 9,\nbut at most 2 is allowed; lower it.")

    out = ["--out", str(tmp_path / "out")]
    assert main(refuse, Config, [*out, "--limit", "9"]) == 2
    assert capsys.readouterr().err == "error: limit is 9, but at most 2 is allowed; lower it.\n"
    assert main(record_one, Config, [*out, "--limit", "2"]) == 0
    assert json.loads((tmp_path / "out" / "config.json").read_text())["limit"] == 2


def test_resume_needs_a_run_of_the_same_study(tmp_path, capsys):
    assert main(record_one, Config, ["--resume", str(tmp_path / "nowhere")]) == 2
    assert "is not a run that can be resumed" in capsys.readouterr().err
    open_run("other", Config(out=tmp_path / "other"))
    assert main(record_one, Config, ["--resume", str(tmp_path / "other")]) == 2
    assert "is a run of the study 'other'" in capsys.readouterr().err
    stored = json.loads((tmp_path / "other" / "config.json").read_text())
    (tmp_path / "other" / "config.json").write_text(
        json.dumps({**stored, "study": "test_run", "colour": "red"})
    )
    assert main(record_one, Config, ["--resume", str(tmp_path / "other")]) == 2
    assert "another version of this study (fields that differ: colour)" in capsys.readouterr().err


def test_hints_can_be_pasted_into_a_shell(tmp_path, capsys):
    """Read back by a shell's rules, the command of a hint names the folder as it is."""
    folder = tmp_path / "it's a folder; rm"
    open_run("test_run", Config(out=folder)).record(number=1)
    assert main(record_one, Config, ["--out", str(folder)]) == 2
    first = capsys.readouterr().err
    stored = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**stored, "study": "other"}))
    assert main(record_one, Config, ["--resume", str(folder)]) == 2
    second = capsys.readouterr().err
    for complaint, study in ((first, "test_run"), (second, "other")):
        command = complaint[complaint.index("python -m") :]
        assert shlex.split(command) == ["python", "-m", f"studies.{study}", "--resume", str(folder)]


def test_resume_takes_the_stored_configuration(tmp_path):
    made = open_run("test_run", Config(out=tmp_path / "out", limit=0.25, sizes=(9,), seed=4))
    made.record(early=1)
    again = open_run("test_run", Config(resume=tmp_path / "out"))
    assert again.config == made.config
    assert again.resumed
    again.record(late=2)
    stored = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (stored["early"], stored["late"]) == (1, 2)


@pytest.mark.parametrize(
    ("typed", "ran"),
    [
        ([], 1.0),
        (["--quick"], 0.125),
        (["--quick", "--limit", "0.5"], 0.5),
        (["--limit", "0.5", "--quick"], 0.5),
        (["--quick", "--limit", "1.0"], 1.0),  # the default, but typed
        (["--limit", "0.5"], 0.5),
    ],
)
def test_what_is_typed_comes_before_what_quick_sets(tmp_path, typed, ran):
    out = tmp_path / "out"
    assert main(record_one, Config, ["--out", str(out), *typed]) == 0
    config, metrics = (json.loads((out / f"{name}.json").read_text()) for name in ("config", "metrics"))
    assert (metrics["limit"], config["limit"], config["quick"]) == (ran, ran, "--quick" in typed)
    assert config["sizes"] == [1, 2]


def test_a_run_that_other_code_goes_on_with_says_so(tmp_path, monkeypatch, capsys):
    commits = iter(["a1", "a1", "b2", "b2"])
    monkeypatch.setattr("studies.frame.machine._commit", lambda root: next(commits))
    run = open_run("test_run", Config(out=tmp_path / "out"))
    said = []
    for _ in range(3):
        run.save_state({}, {})
        run = open_run("test_run", Config(resume=tmp_path / "out"))
        run.record(one=1.0)
        said.append(json.loads((tmp_path / "out" / "metrics.json").read_text())["versions"]["commit"])
    assert said == ["a1", "a1, b2", "a1, b2"]
    assert capsys.readouterr().out.count("made so far by commit a1, and goes on with b2") == 1


def test_resume_refuses_only_what_differs_from_the_stored_run(tmp_path, capsys):
    out = tmp_path / "out"
    assert main(record_one, Config, ["--out", str(out), "--quick", "--limit", "0.5"]) == 0
    for typed in ([], ["--quick"], ["--limit", "0.5"], ["--out", str(out)], ["--device", "auto"]):
        assert main(record_one, Config, ["--resume", str(out), *typed]) == 0, typed
        assert json.loads((out / "metrics.json").read_text())["limit"] == 0.5
    capsys.readouterr()
    # neither the default nor the quick value is what ran, so typing it is refused like any other
    for typed in (["--limit", "1.0"], ["--limit", "0.125"], ["--no-quick"], ["--seed", "1"]):
        assert main(record_one, Config, ["--resume", str(out), *typed]) == 2, typed
        complaint = capsys.readouterr().err
        assert "but the run to resume was started with" in complaint
        assert complaint.count("\n") == 1


def test_wrong_options_exit_with_two(capsys, monkeypatch):
    for arguments in (["--limit", "much"], ["--colour", "red"], ["--device", "tpu"]):
        with pytest.raises(SystemExit) as ended:
            main(record_one, Config, arguments)
        assert ended.value.code == 2
    assert main(record_one, Config, ["--limit", "inf"]) == 2
    assert "--limit is inf; give a finite number, or leave the option out." in capsys.readouterr().err
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(record_one, Config, ["--device", "cuda"]) == 2
    assert "no CUDA device" in capsys.readouterr().err


def test_help_explains_every_option(capsys):
    with pytest.raises(SystemExit) as ended:
        main(record_one, Config, ["--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert all(
        option in shown
        for option in (
            "--quick",
            "--out",
            "--seed",
            "--device",
            "--resume",
            "--limit",
            "Folder of an interrupted run",
        )
    )


@pytest.mark.parametrize("value", [float("nan"), torch.tensor(torch.inf), np.float32(-np.inf)])
def test_metrics_refuse_what_is_not_finite(run, value):
    run.record(good_mm=np.float64(2.5), count=torch.tensor(3), flag=True)
    with pytest.raises(NonFiniteError, match="metric bad"):
        run.record(fine=1.0, bad=value)
    stored = json.loads((run.folder / "metrics.json").read_text())
    assert {k: v for k, v in stored.items() if k not in ("versions", "hardware")} == {
        "good_mm": 2.5,
        "count": 3,
        "flag": 1,
    }


def test_metrics_refuse_what_is_not_a_number(run):
    for name, value in (("versions", 1), ("spot", "12"), ("spots", torch.ones(2))):
        with pytest.raises(DomainError):
            run.record(**{name: value})


def test_page_holds_everything_and_loads_nothing(run):
    run.card("RMS spot", "12.3 µm", "detuned: 41 µm")
    run.section(
        "Result",
        "The **lens** is `sharp` <script>alert(1)</script> https://example.org/a.png\n\n- one\n- two",
    )
    figure, axes = plt.subplots()
    axes.plot([0, 1], [1, 0])
    path = run.figure(figure, "loss", "The loss *falls*.")
    assert not plt.fignum_exists(figure.number)
    run.table(
        "Spots",
        ["field", "rms_um", "rays"],
        [["axis", 1234.56, 8], ["edge", -0.000125, None], ["corner", 1.5e-7, 0]],
    )
    (run.folder / "events.gif").write_bytes(b"GIF89a")
    run.video("events.gif", "Events.")
    run.record(loss_last=0.5)
    html = run.finish("A sharper lens", "It is *better*.").read_text()
    loaded = re.findall(
        r"""(?:src|href|srcset|data|action|poster)\s*=\s*["']([^"']*)|url\(([^)]*)\)|@import\s*([^;]*)""",
        html,
    )
    assert all(any(each) and next(filter(None, each)).startswith("data:") for each in loaded)
    assert html.count("data:image/png;base64,") == 1
    assert html.count("data:image/gif;base64,R0lGODlh") == 1
    assert "<script" not in html
    assert "The <strong>lens</strong> is <code>sharp</code> &lt;script&gt;" in html
    assert "<li>two</li>" in html
    assert '<td>axis</td><td class="number">1235</td><td class="number">8</td>' in html
    assert '<td class="number">−0.000125</td><td class="number">–</td>' in html
    assert '<td class="number">1.5·10⁻⁷</td>' in html
    assert 'alt="The loss falls."' in html
    assert "12.3 µm" in html
    assert "loss_last" in html
    assert plt.imread(path).shape[1] > 600, "figures are sharp enough to print"


def test_page_refuses_what_it_cannot_show(run):
    with pytest.raises(FileFormatError, match="one of"):
        run.video("scene.exr", "A scene.")
    with pytest.raises(FileFormatError, match="cannot be read"):
        run.video("absent.mp4", "Nothing.")
    with pytest.raises(ShapeError, match="row 1 has 1 cells for 2 columns"):
        run.table("T", ["a", "b"], [[1, 2], [3]])
    with pytest.raises(CodesignError, match="leads out of the run's folder"):
        run.path("../elsewhere.png")


def test_the_commit_is_that_of_the_checkout():
    if not (ROOT / ".git").exists():
        pytest.skip("not a checkout of git")
    said = subprocess.run(
        ["git", "-C", ROOT, "rev-parse", "HEAD"], capture_output=True, text=True, check=True
    )
    assert versions()["commit"].removesuffix("+changes") == said.stdout.strip()
