"""The commands of setup/bench.py, on the processor: a slowdown fails, a missing GPU is said, and the
page is of its JSON."""

import json
import time

import torch

from tests.processes import python, script

bench = script("bench")


def test_a_slowdown_fails_and_says_of_what():
    def row(ratio, yardstick="rows"):
        return {"over_yardstick": ratio, "yardstick": yardstick}

    kept = {"trace": row(2.0), "lost": row(1.0), "moved": row(1.0, "copy")}
    said = bench.worse({"trace": row(2.5), "new": row(1.0), "moved": row(9.0)}, kept)
    assert said == [
        "lost: no longer measured",
        "trace: 2.5 times its rows, 2 when committed",
        "new: not in docs/bench.json; measure with --write",
        "moved: not in docs/bench.json; measure with --write",
    ]
    assert bench.worse({"trace": row(2.3), "lost": row(0.1), "moved": row(1, "copy")}, kept) == []


def test_a_ratio_is_that_of_work_and_yardstick(monkeypatch):
    """Work of three seconds beside a yardstick of two, by a clock that counts calls."""
    passed = [0.0]

    def spend(seconds):
        passed[0] += seconds

    monkeypatch.setattr(time, "process_time", lambda: passed[0])
    monkeypatch.setattr(bench, "yardsticks", lambda device: {"rows": (lambda: spend(2.0), 4.0)})
    work = bench.Work(lambda: spend(3.0), 6.0, "rays")
    monkeypatch.setattr(bench, "works", lambda device, small: {"trace": work})
    row = bench.timed(torch.device("cpu"), 3, small=True)["trace"]
    assert (row["over_yardstick"], row["ms"], row["million_per_s"]) == (1.5, 3000.0, 2.0)
    assert (row["least_ns"], row["yardstick_ns"]) == (500.0, 5e8)


def test_a_work_stands_beside_the_nearer_of_its_limits():
    """Of 200 ns a unit its two surfaces take 50, a copy of its 8 bytes 1.5."""
    trace = {"unit": "rays", "moved_b": 8, "bare": 2, "yardstick_ns": 25.0, "least_ns": 200.0}
    table = bench.limits({"trace": trace, "other": {"moved_b": 0}}, 0.1875)
    assert table.splitlines()[2:] == ["| trace | 200 | ray | 1.5 | 50 | 25 % |"]


def test_every_work_has_a_committed_ratio():
    kept = json.loads(bench.KEPT.read_text())["works"]
    assert set(kept) == set(bench.works(torch.device("cpu"), small=True))


def test_without_a_gpu_it_says_what_is_missing(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert bench.main(["cuda"]) == 2
    assert "install an NVIDIA driver" in capsys.readouterr().out


def test_the_same_path_runs_on_the_processor(tmp_path):
    out = tmp_path / "out"
    asked = ["cuda", "--device", "cpu", "--quick", "--rounds", "1", "--out", str(out)]
    done = python("setup/bench.py", *asked)
    assert done.returncode == 0, done.stderr
    result = json.loads((out / "speed.json").read_text())
    written = (out / "speed_cuda.md").read_text()
    for name, row in result["works"].items():
        assert f"| {name} | {row['ms']:.3g} |" in written
    assert f"{result['training']['training step, float32']['ms']:.3g} ms" in written
