"""The list of studies and the commands that start them: complete, quick, and with a word for every
wrong name."""

import dataclasses

import pytest

from studies.frame import listing
from studies.frame.config import StudyConfig, configured, to_json
from studies.frame.run import _name
from tests import refusals
from tests.processes import ROOT, python
from tests.studies.runs import module_of

NAMES = list(listing.studies())


def test_every_folder_and_file_that_runs_is_listed_once():
    folders = [
        path.name for path in (ROOT / "studies").iterdir() if (path / "__main__.py").is_file()
    ]
    files = [
        path.stem
        for path in (ROOT / "studies").glob("*.py")
        if path.stem not in ("__init__", "__main__")
    ]
    listed = [name for members in listing.by_group().values() for name in members]
    assert sorted(listed) == sorted(folders + files)
    assert {"lens_opt", "train_flow", "stability"} <= set(listed)
    assert list(listing.GROUPS) == ["lens", "render", "events", "flow", "whole chain"]
    missing = [
        name for members in listing.GROUPS.values() for name in members if name not in listed
    ]
    assert not missing, "groups name studies that are gone"


def test_the_list_shows_the_question_of_every_study():
    lines = listing.show(100).splitlines()
    assert max(map(len, lines)) <= 100
    text = " ".join(" ".join(lines).split())
    for name, path in listing.studies().items():
        asked = listing.question(path)
        assert asked.endswith((".", "?")), f"{name}: its docstring begins with one sentence"
        assert f"{name} {asked}" in text
    assert "gradient_flow Are the gradients right, from the lens to the loss?" in text


def test_a_study_without_a_group_is_listed_too(tmp_path, monkeypatch):
    (tmp_path / "new.py").write_text(
        '"""Is it new? It is."""\n\nif __name__ == "__main__":\n    pass\n'
    )
    (tmp_path / "part.py").write_text('"""No study."""\n')
    monkeypatch.setattr(listing, "FOLDER", tmp_path)
    assert listing.by_group()[listing.OTHERS] == ["new"]
    assert listing.show().endswith("others\n  new  Is it new?")


def test_listing_imports_nothing_heavy():
    script = (
        "import sys; from codesign.__main__ import main; main(['list']);"
        "print([name for name in ('torch', 'numpy', 'mitsuba', 'drjit', 'matplotlib') if name in "
        "sys.modules])"
    )
    done = python("-c", script)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"
    listed = done.stdout.splitlines()[:-1]
    for command in (("-m", "codesign", "list"), ("-m", "studies")):
        assert python(*command).stdout.splitlines() == listed


def test_run_starts_the_module_and_hands_over_its_options():
    wrong = python("-m", "codesign", "run", "stability", "--colour", "red")
    assert wrong.returncode == 2
    assert "python -m studies.stability" in wrong.stderr
    assert "--colour" in wrong.stderr


@refusals.table(__file__, "names of studies")
def test_what_is_no_study_is_refused_in_a_sentence(row):
    for command in (("codesign", "run", row.call), (f"studies.{row.call}",)):
        done = python("-m", *command)
        assert done.returncode == 2
        assert done.stdout == ""
        assert done.stderr.startswith(f"error: {row.sentence}")
        assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("name", NAMES)
def test_quick_sets_options_of_the_study(name):
    kind = module_of(name).Config
    assert issubclass(kind, StudyConfig)
    usual = configured(kind, quick=False)
    quick = configured(kind, quick=True)
    changed = {
        field.name
        for field in dataclasses.fields(kind)
        if getattr(quick, field.name) != getattr(usual, field.name)
    }
    assert changed == {"quick", *kind.QUICK}, (
        "what --quick sets are options, at other values than usual"
    )
    to_json(name, quick)


@pytest.mark.parametrize("name", NAMES)
def test_a_run_has_the_name_of_its_study(name):
    assert _name(module_of(name).Config) == name
