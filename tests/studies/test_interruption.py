"""Runs that are interrupted, end on signals or full disks, and go on with the same numbers and
times."""

import contextlib
import errno
import os
import shlex
import signal
import subprocess
import sys

import pytest

from studies.frame.run import Run
from tests.processes import ROOT
from tests.studies import walk
from tests.studies.runs import numbers, ran
from tests.studies.smallest_study import Config

ELSEWHERE = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "4000"}


def started(folder, *arguments):
    command = [sys.executable, "-W", "error", "-m", "tests.studies.walk", *arguments]
    environment = {**ELSEWHERE, "PYTHONUNBUFFERED": "1"}
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, cwd=folder, env=environment, text=True, stdout=pipe, stderr=pipe
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Numbers of a walk that nothing interrupted."""
    folder = tmp_path_factory.mktemp("whole") / "out"
    assert ran(walk, "--out", folder) == 0
    return numbers(folder)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interrupted_and_resumed_gives_the_same_numbers(tmp_path, whole, number, code, capsys):
    folder = tmp_path / "with space"
    broken = started(tmp_path, "--out", folder.name, "--pause-s", "0.05")
    assert broken.stdout is not None
    while broken.stdout.readline() != "step 5\n":
        assert broken.poll() is None, broken.communicate()
    if number == signal.SIGINT:
        # it is there, and gets no further
        broken.send_signal(signal.SIGSTOP)
        assert ran(walk, "--resume", folder) == 2
        complaint = capsys.readouterr().err
        assert complaint.startswith(f"error: another process works on the run in '{folder}'")
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
    assert ran(walk, "--resume", folder) == 0
    assert "walking  40/40  loss" in capsys.readouterr().out
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
def test_what_libraries_make_of_a_full_disk_or_a_signal(
    out, command, error, number, code, sentence
):
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
    assert complaint.startswith(
        f"{sentence}; go on with: python -m studies.smallest_study --resume"
    )


def test_a_reader_that_goes_away_gets_no_traceback(tmp_path):
    for line in ("-m tests.studies.walk --help", "-m codesign --help", "-m studies"):
        shell = f"{shlex.quote(sys.executable)} {line} | head -c 1"
        done = subprocess.run(shell, shell=True, cwd=tmp_path, env=ELSEWHERE, capture_output=True)
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
        # stopped while judging: nothing is left but to judge again
        (10, None, 0.02, 10 * 0.02 + 0.06 + 1.5),
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
