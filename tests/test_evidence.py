"""Figures in README and docs are those that docs/evidence.json has, and say when they are old."""

import math
import re
import subprocess

import pytest

from tests.processes import ROOT, script

parts = script("evidence_parts")  # which the other takes its parts from
evidence = script("evidence")


def figures():
    return {
        name: text for part in evidence.kept().values() for name, text in part["figures"].items()
    }


def test_pages_have_the_figures_that_are_kept():
    for page in evidence.pages():
        text = page.read_text(encoding="utf-8")
        assert evidence.written(text, figures()) == text, page
        # a half-written mark would be typed by hand from then on
        assert len(re.findall("<!--fig:", text)) == len(evidence.MARK.findall(text)), page


def test_what_is_kept_is_what_the_parts_make():
    assert set(evidence.kept()) <= set(evidence.PARTS)
    for name, part in evidence.kept().items():
        made = evidence.PARTS[name]
        assert part["command"] == f"python -m studies.{made.command}"
        assert set(part["figures"]) == set(made.figures)
        assert set(part["measured"]) == set(made.measured)
        assert part["pictures"] == list(made.pictures)
        assert all((ROOT / "docs" / name).exists() for name in made.pictures)


def test_texts_of_metrics():
    metrics = {"a_median_p": 0.714, "a_low95_p": 0.5651, "a_high95_p": 0.92}
    assert parts.ratio("a", "p")(metrics) == "0.71 (0.57 to 0.92)"
    logs = {"x_as_it_is_b_c": math.log(0.84), "y_as_it_is_b_c": math.log(0.72), "y_turned_b_c": 1.0}
    assert parts.gains("b_c")(logs) == "16 to 28 %"
    with pytest.raises(KeyError):
        evidence.written("<!--fig:nowhere--><!--/-->", {})


@pytest.mark.parametrize("name", evidence.kept())
def test_figures_are_of_this_code(name):
    git = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    if git.returncode:
        pytest.skip("this is no checkout of git")
    old = evidence.stale(evidence.kept()[name])
    if old:
        command = evidence.PARTS[name].command
        anew = "to be raced anew" if "--raw" in command else f"make evidence ARGS={name}"
        pytest.xfail(f"{', '.join(old)} changed since its figures: {anew}")


def test_what_is_drawn_from_a_raw_table_is_of_the_code_that_made_the_table():
    assert evidence.run_at("lens_opt --quick") == "HEAD"
    table = "docs/lens_motion.csv"
    commit = evidence.run_at(f"lens_motion --raw {table}")
    if not commit:
        pytest.skip("this is no checkout of git")
    assert evidence.trees((table,), commit) == evidence.trees((table,))
