"""Runs of the smallest study."""

import pytest

from studies.frame.run import main, open_run
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
