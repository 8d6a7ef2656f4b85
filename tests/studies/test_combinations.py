"""The study of all layers and estimators, at its smallest: a pair that runs, a pair that is refused, the page."""

import json

from studies import combinations
from studies.frame.run import main

SMALL = ["--steps", "1", "--cases", "1", "--judged", "1", "--directions", "2"]


def test_a_run_tells_outcome_cost_gradients_and_refusals(tmp_path):
    pair = ["--layers", "counts", "--estimators", "closed-form"]
    assert main(combinations.study, combinations.Config, [*SMALL, *pair, "--out", str(tmp_path / "run")]) == 0
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert found["combinations_run"] == 1
    assert found["combinations_refused"] == 1
    assert found["counts_closed_form_certificate_cosine"] > 0.99
    assert 0 < found["counts_closed_form_error_last_mrad"] < 5
    page = (tmp_path / "run" / "report.html").read_text()
    assert "nothing to train" in page
