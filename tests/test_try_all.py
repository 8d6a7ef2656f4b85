"""The commands that `make try-all` finds: those of the pages, none of a study that is not there."""

import re

import pytest

from tests.processes import ROOT, script


@pytest.fixture(scope="module")
def try_all():
    return script("try_all")


def test_every_study_that_a_page_names_is_there_and_is_tried(try_all):
    found = try_all.commands()
    tried = {re.split(r"[ .]", command)[-1] for command in (c.split(" --")[0] for c in found)}
    tried |= {
        module
        for module, target in try_all.MODULES.items()
        if any(c.split()[1] == target for c in found)
    }
    pages = "".join(p.read_text() for p in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")))
    named = set(re.findall(r"python -m studies\.([a-z_]+)", pages))
    assert named <= tried
    assert {path for path in named if not list((ROOT / "studies").glob(f"{path}*"))} == set()


@pytest.mark.parametrize(
    ("said", "plain"),
    [
        ('make lens-opt ARGS="--quick --out runs/mine"', "make lens-opt"),
        (
            ".venv/bin/python -m studies.train_flow --seed 1     # another",
            'make train-flow ARGS="--seed 1"',
        ),
        ("python -m studies.velocity_head [--steps 3]", "python -m studies.velocity_head"),
        ("make it", ""),
        ("codesign run NAME …", ""),
        ('make placement ARGS="--robot', ""),
    ],
)
def test_one_spelling_of_a_command(said, plain, try_all):
    assert try_all.normal(said) == plain
