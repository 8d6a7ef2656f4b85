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


def record_one(run: Run[Config]):
    """The smallest study."""
    run.record(limit=run.config.limit)
    run.finish("One number", "It was recorded.")


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


@pytest.fixture
def run(out):
    return open_run("test_run", Config(out=out))


@pytest.fixture
def command(capsys):
    """Runs the smallest study: arguments to exit code and what stands on stderr."""

    def called(*arguments, study=record_one):
        code = main(study, Config, [str(each) for each in arguments])
        return code, capsys.readouterr().err

    return called


def stored(folder, name):
    return json.loads((folder / f"{name}.json").read_text())


def numbers(folder):
    return {k: v for k, v in stored(folder, "metrics").items() if k not in ("versions", "hardware")}


def contents(folder):
    return {path.name: path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}


# state


def test_state_returns_every_bit(run, generator):
    tensors = {
        "float32": torch.randn(3, 4, generator=generator).T,
        "float64/odd name": torch.tensor([0.1, torch.nan, -0.0, torch.inf, 5e-324], dtype=torch.float64),
        "int64": torch.tensor([2**62 + 1, -1]),
        "bool": torch.tensor([True, False]),
        "scalar": torch.tensor(1 / 3),
        "empty": torch.zeros(0, 2),
        "file": torch.randn(2, generator=generator).requires_grad_(),
    }
    given = {"step": 7, "best": 0.1 + 0.2, "history": [1e-300, float("inf")], "name": "π"}
    run.save_state(tensors, given)
    back = run.load_state()
    assert back.numbers == given
    assert list(back.tensors) == list(tensors)
    for name, tensor in tensors.items():
        found = back.tensors[name]
        assert (found.dtype, found.shape) == (tensor.dtype, tensor.shape)
        assert found.numpy().tobytes() == tensor.detach().numpy().tobytes()


def test_state_is_data_and_damage_is_named(run):
    assert run.load_state() is None
    run.save_state({"x": torch.ones(2)}, {})
    path = run.folder / "state.npz"
    with np.load(path, allow_pickle=False) as arrays:
        assert all(arrays[name].dtype != object for name in arrays.files)
    with pytest.raises(ShapeError, match="bfloat16"):
        run.save_state({"x": torch.ones(2, dtype=torch.bfloat16)}, {})
    # a refused state does not touch the last one
    assert torch.equal(run.load_state().tensors["x"], torch.ones(2))
    for damage in (b"", b"not a state", path.read_bytes()[:-30]):
        path.write_bytes(damage)
        with pytest.raises(FileFormatError, match="not a state file"):
            run.load_state()


def test_the_state_of_another_run_is_refused(tmp_path):
    def folder(name, study="test_run", **options):
        made = open_run(study, Config(out=tmp_path / name, **options))
        made.save_state({}, {"step": 1})
        return made.folder

    def resumed():
        return open_run("test_run", Config(resume=mine)).load_state()

    mine = folder("mine")
    assert resumed().numbers == {"step": 1}
    for other, reason in ((folder("a", "other"), "study"), (folder("b", limit=2.0), "configuration")):
        (mine / "state.npz").write_bytes((other / "state.npz").read_bytes())
        with pytest.raises(FileFormatError, match=f"another {reason}"):
            resumed()
    write_state(mine / "state.npz", {}, {"numbers": {}, "times": {"seconds": 0.0, "loops": {}}})
    with pytest.raises(FileFormatError, match=r"another version .*start a new run"):
        resumed()


# interruption


def started(folder, *arguments):
    (folder / "walk.py").write_text(WALK)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-W", "error", "walk.py", *arguments]
    return subprocess.Popen(
        command,
        cwd=folder,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Numbers of a walk that nothing interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    said, complaint = started(folder, "--out", "out").communicate(timeout=120)
    assert "walking  40/40  loss" in said, complaint
    return numbers(folder / "out")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupted_and_resumed_gives_the_same_numbers(tmp_path, whole, number, code):
    folder = tmp_path / "with space"
    broken = started(tmp_path, "--out", folder.name, "--pause-s", "0.05")
    assert broken.stdout is not None
    while broken.stdout.readline() != "step 5\n":
        assert broken.poll() is None, broken.communicate()
    if number == signal.SIGINT:
        # it is there, and gets no further
        broken.send_signal(signal.SIGSTOP)
        second = started(tmp_path, "--resume", folder.name)
        complaint = second.communicate(timeout=120)[1]
        assert second.returncode == 2
        assert complaint.startswith("error: another process works on the run in 'with space'")
        broken.send_signal(signal.SIGCONT)
    broken.send_signal(number)
    _, complaint = broken.communicate(timeout=60)
    assert broken.returncode == code, complaint
    last = complaint.splitlines()[-1]
    assert last == "interrupted; go on with: python -m studies.walk --resume 'with space'"
    assert not (folder / "metrics.json").exists()
    # as a killed run leaves them, and one that is none of ours
    left = [folder / name for name in (".decay-a_b3c4d5.mp4", ".state-abcdefgh.npz", ".mine")]
    for path in left:
        path.write_bytes(b"half")
    resumed = started(tmp_path, "--resume", folder.name)
    complaint = resumed.communicate(timeout=120)[1]
    assert resumed.returncode == 0, complaint
    found = numbers(folder)
    assert 5 <= found["first_step"] < 40
    assert found == {**whole, "first_step": found["first_step"]}
    assert (folder / "report.html").exists()
    assert [path.exists() for path in left] == [False, False, True]
    assert not (folder / ".lock").exists()


def test_second_interrupt_ends_at_once(run):
    saved = []
    run.on_interrupt(lambda: saved.append(True))
    with run._interruption as interruption, run.progress(3, "waiting"):
        signal.raise_signal(signal.SIGINT)
        assert interruption.requested
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert not saved, "in the middle of a step the state is not whole"


@pytest.mark.parametrize(
    ("error", "number", "code", "sentence"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), None, 2, "error: the disk is full"),
        (ImportError("while a library was loaded"), signal.SIGTERM, 143, "interrupted"),
        (ImportError("while a library was loaded"), None, None, ""),
    ],
)
def test_what_libraries_make_of_a_full_disk_or_a_signal(out, command, error, number, code, sentence):
    def study(run):
        if number:
            with contextlib.suppress(KeyboardInterrupt):
                signal.raise_signal(number)
        raise error

    if code is None:
        with pytest.raises(ImportError):
            command("--out", out, study=study)
        return
    ended, complaint = command("--out", out, study=study)
    assert ended == code
    assert complaint.startswith(f"{sentence}; go on with: python -m studies.test_run --resume")


def test_a_reader_that_goes_away_gets_no_traceback(tmp_path):
    (tmp_path / "walk.py").write_text(WALK)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "4000"}
    for line in ("walk.py --help", "-m codesign --help", "-m studies"):
        shell = f"{shlex.quote(sys.executable)} {line} | head -c 1"
        done = subprocess.run(
            shell, shell=True, cwd=tmp_path, env=environment, capture_output=True, check=False
        )
        assert done.stderr == b"", line


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
    command = [sys.executable, "-c", FORKED]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60, cwd=ROOT)
    assert done.stdout == "-15 False\n"


class Clock:
    """Stands in for time.monotonic."""

    now = 0.0

    def __call__(self):
        return self.now


clock = Clock()


def counted(run: Run[Config]):
    """A study of ``sizes[0]`` steps of 20 ms, the first of every session 60 ms longer, and some
    judging, which ends with Ctrl-C where limit is 9."""
    earlier = run.load_state()
    done = first = earlier.numbers["done"] if earlier else 0
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
    run.record(seconds_per_step=bar.seconds_per_step or 0, seconds=run.seconds)
    run.finish("Steps", "They were counted.")


@pytest.mark.parametrize(
    ("steps", "stop_at", "seconds_per_step", "seconds"),
    [
        (10, 4, 0.02, 10 * 0.02 + 2 * 0.06 + 1.0),  # stopped between steps (after the next one)
        (10, None, 0.02, 10 * 0.02 + 0.06 + 1.5),  # stopped while judging: nothing is left but to judge again
        (1, None, 0.08, 0.08 + 1.5),  # one step alone: it is all that was timed
    ],
)
def test_time_per_step_counts_every_session(
    out, command, monkeypatch, steps, stop_at, seconds_per_step, seconds
):
    monkeypatch.setattr("studies.frame.progress.time.monotonic", clock)
    options = ["--sizes", steps, stop_at or 0, "--limit", 1 if stop_at else 9]
    assert command("--out", out, *options, study=counted)[0] == 130
    # between the sessions
    clock.now += 1000.0
    assert command("--resume", out, study=counted)[0] == 0
    found = numbers(out)
    assert found["seconds_per_step"] == pytest.approx(seconds_per_step, rel=1e-9)
    assert found["seconds"] == pytest.approx(seconds, rel=1e-9)
    # a run that is complete can be resumed as well, and writes its page again
    (out / "report.html").unlink()
    assert command("--resume", out, study=counted)[0] == 0
    assert (out / "report.html").exists()


# configuration and folder


def test_command_leaves_what_the_contract_names(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    assert command("--limit", 0.5, "--sizes", 3, 4, 5) == (0, "")
    (folder,) = (tmp_path / "runs" / "test_run").iterdir()
    assert set(contents(folder)) == {"config.json", "metrics.json", "report.html"}
    config = stored(folder, "config")
    # the device is the one that computed
    assert config.pop("device") in ("cpu", "cuda")
    given = {"quick": False, "out": None, "seed": 0, "resume": None, "limit": 0.5, "sizes": [3, 4, 5]}
    assert config == {"study": "test_run", **given}
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


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("limit", True),
        ("limit", None),
        ("sizes", [1, "2"]),
        ("sizes", 3),
        ("seed", 0.5),
        ("quick", 1),
        ("device", "tpu"),
        ("device", ["cpu"]),
        ("out", 7),
    ],
)
def test_a_configuration_of_other_types_is_one_sentence(run, command, name, value):
    path = run.folder / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), name: value}))
    code, complaint = command("--resume", run.folder)
    assert code == 2
    assert re.search(f": {name} is .*, which is no ", complaint)
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
    assert hint == ["python", "-m", "studies.test_run", "--resume", str(out)]
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
    path = other / "config.json"
    newer = json.dumps({**json.loads(path.read_text()), "study": "test_run", "colour": "red"})
    for folder, sentence in (
        (tmp_path / "nowhere", "is not a run that can be resumed"),
        (other, "study 'other'"),
    ):
        code, complaint = command("--resume", folder)
        assert code == 2
        assert sentence in complaint
    path.write_text(newer)
    code, complaint = command("--resume", other)
    assert code == 2
    assert "another version of this study (fields that differ: colour)" in complaint


def test_resume_takes_the_stored_configuration_and_metrics(tmp_path):
    made = open_run("test_run", Config(out=tmp_path / "out", limit=0.25, sizes=(9,), seed=4))
    made.record(early=1)
    again = open_run("test_run", Config(resume=tmp_path / "out"))
    assert again.resumed
    assert again.config == made.config
    again.record(late=2)
    assert numbers(tmp_path / "out") == {"early": 1, "late": 2}


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
    assert (numbers(out)["limit"], config["limit"], config["quick"]) == (ran, ran, "--quick" in typed)


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


def test_a_run_that_other_code_goes_on_with_says_so(out, monkeypatch, capsys):
    commits = iter(["a1", "a1", "b2", "b2"])
    monkeypatch.setattr("studies.frame.machine._commit", lambda root: next(commits))
    run = open_run("test_run", Config(out=out))
    said = []
    for _ in range(3):
        run.save_state({}, {})
        run = open_run("test_run", Config(resume=out))
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
    for option in ("--quick", "--out", "--seed", "--device", "--limit", "Folder of an interrupted run"):
        assert option in shown
    said = "error: option --limit is inf; give a finite number, or leave the option out.\n"
    assert command("--limit", "inf") == (2, said)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    code, complaint = command("--device", "cuda")
    assert code == 2
    assert "no CUDA device" in complaint


# what a run shows


def test_metrics_are_finite_numbers(run):
    run.record(good_mm=np.float64(2.5), count=torch.tensor(3), flag=True)
    for bad in (float("nan"), torch.tensor(torch.inf), np.float32(-np.inf)):
        with pytest.raises(NonFiniteError, match="metric bad"):
            run.record(fine=1.0, bad=bad)
    for name, value in (("versions", 1), ("spot", "12"), ("spots", torch.ones(2))):
        with pytest.raises(DomainError):
            run.record(**{name: value})
    assert numbers(run.folder) == {"good_mm": 2.5, "count": 3, "flag": 1}


def test_page_holds_everything_and_loads_nothing(run):
    run.card("RMS spot", "12.3 µm", "detuned: 41 µm")
    run.section(
        "Result", "The **lens** is `sharp` <script>alert(1)</script> https://example.org\n\n- one\n- two"
    )
    figure, axes = plt.subplots()
    axes.plot([0, 1], [1, 0])
    path = run.figure(figure, "loss", "The loss *falls*.")
    assert not plt.fignum_exists(figure.number)
    rows = [["axis", 1234.56, 8], ["edge", -0.000125, None], ["corner", 1.5e-7, 0]]
    run.table("Spots", ["field", "rms_um", "rays"], rows)
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
    for piece in (
        "The <strong>lens</strong> is <code>sharp</code> &lt;script&gt;",
        "<li>two</li>",
        '<td>axis</td><td class="number">1235</td><td class="number">8</td>',
        '<td class="number">−0.000125</td><td class="number">–</td>',
        '<td class="number">1.5·10⁻⁷</td>',
        'alt="The loss falls."',
        "12.3 µm",
        "loss_last",
    ):
        assert piece in html
    assert plt.imread(path).shape[1] > 600, "figures are sharp enough to print"


@pytest.mark.parametrize(
    ("call", "kind", "sentence"),
    [
        (lambda run: run.video("scene.exr", "A scene."), FileFormatError, "one of"),
        (lambda run: run.video("absent.mp4", "Nothing."), FileFormatError, "cannot be read"),
        (
            lambda run: run.table("T", ["a", "b"], [[1, 2], [3]]),
            ShapeError,
            "row 1 has 1 cells for 2 columns",
        ),
        (lambda run: run.path("../elsewhere.png"), CodesignError, "leads out of the run's folder"),
    ],
)
def test_page_refuses_what_it_cannot_show(run, call, kind, sentence):
    with pytest.raises(kind, match=sentence):
        call(run)
