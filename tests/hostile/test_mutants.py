"""Damaged and hostile files end in one sentence of ours, or in a value that has a meaning; a minute
of ``make fuzz``."""

import json
import os

import numpy as np
import pytest
import torch

from codesign import events
from codesign.errors import CodesignError, FileFormatError
from codesign.reading import check_room, open_regular, read_json
from tests.hostile import fuzz, seeds_events
from tests.hostile.mutate import changed_bytes
from tests.hostile.reader import judged, seed_of
from tests.processes import python

MUTANTS = 80  # of every seed
# a scene, a robot and a picture of OpenEXR take half a second each
FEWER = {"tests.hostile.seeds_scenes": 30}
SEEDS = fuzz.seeds()


@pytest.mark.parametrize("module", sorted({module for module, _ in SEEDS}))
def test_mutants_end_in_a_sentence_or_a_value_with_a_meaning(module):
    count = FEWER.get(module, MUTANTS)
    done = python("-m", "tests.hostile.reader", module, "all", "1", "1", str(count))
    said = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert said, done.stderr[-2000:]
    assert "done" in said[-1], f"the process ended at {said[-1]}: {done.stderr[-2000:]}"
    assert [line for line in said if "kind" in line] == []


@pytest.mark.parametrize(
    "file", sorted(path.name for path in fuzz.CRASHES.iterdir() if path.name != "reasons.json")
)
def test_what_went_wrong_once_does_not_again(file, tmp_path):
    stem, _, _ = file.rpartition("-")
    module, name = next(seed for seed in SEEDS if seed[1] == f"{stem}{os.path.splitext(file)[1]}")
    path = tmp_path / name
    path.write_bytes((fuzz.CRASHES / file).read_bytes())
    assert judged(path, seed_of(module, name)[1]) == ("", "")


@pytest.mark.parametrize("name", ["events.npz", "dsec.h5", "events.aedat4"])
def test_checksums_let_no_changed_event_through(name, tmp_path):
    content = seeds_events.SEEDS[name][0]()
    dice = np.random.default_rng(7)
    path = tmp_path / name
    refused = 0
    for _ in range(200):
        path.write_bytes(changed_bytes(content, dice))
        try:
            back = events.read(path)
        except FileFormatError:
            refused += 1
        else:
            assert all(
                torch.equal(getattr(back, key), getattr(seeds_events.stream(), key))
                for key in ("t_us", "x", "y", "p")
            )
    assert refused > 60, "the faults hit what is checked"


def test_pipes_folders_and_long_files_are_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.npz")
    for path in (tmp_path / "pipe.npz", tmp_path):
        with pytest.raises(FileFormatError, match="not a regular file"):
            open_regular(path)
    for name in ("a\0b", "x" * 300):
        with pytest.raises(FileFormatError, match="cannot be read"):
            open_regular(tmp_path / name)
    (tmp_path / "a.json").write_text("[" * 100_000)
    with pytest.raises(FileFormatError, match="no whole JSON"):
        read_json(tmp_path / "a.json")
    with pytest.raises(FileFormatError, match="has 100000 bytes, more than the 9"):
        open_regular(tmp_path / "a.json", 9)
    with pytest.raises(CodesignError, match="announces 1000000 x 1000000 values"):
        check_room("a", (10**6, 10**6), 8)
