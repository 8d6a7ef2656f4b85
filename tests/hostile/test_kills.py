"""A run that was killed and resumed ends with the numbers of the run that nobody killed; hours by
``make kill-test``."""

import sys

import pytest

pytest.importorskip("resource", reason="kills are those of Unix")


@pytest.mark.skipif(
    sys.platform != "linux", reason="a full disk is set on a running process, which Linux alone can"
)
def test_a_killed_run_ends_with_the_same_numbers():
    from tests.hostile import kills

    figures, findings = kills.measure(1, 0, studies=("lens_tolerance",))
    assert not findings
    assert figures["kill_hits"] >= 1
    assert figures["killed_runs_equal"] == figures["killed_runs"] >= 1
