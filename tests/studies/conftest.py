"""Runs of the smallest study, and what any study refuses."""

import pytest

from studies.frame.run import main, open_run
from tests.studies.runs import ran
from tests.studies.smallest_study import Config, record_one


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


@pytest.fixture
def run(out):
    return open_run("smallest_study", Config(out=out))


@pytest.fixture
def command(capsys):
    """Runs the smallest study: arguments to exit code and what stands on stderr."""

    def called(*arguments, study=record_one):
        code = main(study, Config, [str(each) for each in arguments])
        return code, capsys.readouterr().err

    return called


@pytest.fixture
def refuses(tmp_path, monkeypatch, capsys):
    """Sees that a study refuses the words of a row of refusals.txt, typed in ``tmp_path`` after
    options that are right: exit code 2, one line, and no table of what was looked at."""
    monkeypatch.chdir(tmp_path)

    def seen(study, row, options=""):
        capsys.readouterr()
        assert ran(study, f"{options} {row.call} --out", tmp_path / "run") == 2
        said = capsys.readouterr().err
        assert said.startswith("error: ")
        assert row.sentence in said
        assert said.count("\n") == 1
        assert not list((tmp_path / "run").glob("*.jsonl"))

    return seen
