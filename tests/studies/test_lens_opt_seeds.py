"""lens_opt over seeds: differences of finished runs, made up here, are pooled as they should be."""

import json
import math
from types import SimpleNamespace

import pytest

from studies import lens_opt_seeds
from studies.frame.run import main
from tests.studies.browser import check_page

LENSES = ("nominal", "detuned", "refocused", "spots", "edge", "optimised", "after_spots")
# of flow errors, over those of the spot designer
RATIO = {
    "optimised": 0.9,
    "after_spots": 0.97,
    "edge": 1.0,
}
WOBBLE = {0: (0.99, 1.01, 1.0), 1: (1.01, 0.99, 1.0)}  # of the flow design, by seed and case


def finished(run, seed):
    """What lens_opt_seeds reads of a finished run."""
    cases_mrad = (0.3, 0.5, 0.8)
    errors = {name: [RATIO.get(name, 1.0) * e for e in cases_mrad] for name in LENSES}
    errors["optimised"] = [e * w for e, w in zip(errors["optimised"], WOBBLE[seed], strict=True)]
    found = {name: [{"flow_error_mrad": e} for e in row] for name, row in errors.items()}
    metrics = {
        f"{key}_{name}": 1.0 for key in ("flow_error_mrad_hard", "rms_spot_um") for name in LENSES
    }
    return SimpleNamespace(
        metrics=metrics, load_state=lambda: SimpleNamespace(numbers={"found": found})
    )


def test_differences_of_all_seeds_are_pooled_and_the_page_says_who_wins(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(lens_opt_seeds, "_one", finished)
    folder = tmp_path / "seeds"
    assert (
        main(
            lens_opt_seeds.study, lens_opt_seeds.Config, ["--seeds", "0", "1", "--out", str(folder)]
        )
        == 0
    )
    metrics = json.loads((folder / "metrics.json").read_text())
    mean = math.log(0.9) + (math.log(0.99) + math.log(1.01)) / 3
    assert metrics["spots_log_ratio"] == pytest.approx(mean, rel=1e-9)
    assert metrics["spots_log_ratio_low"] < mean < metrics["spots_log_ratio_high"] < 0
    assert metrics["spots_seeds_better"] == 2
    check_page("lens_opt_seeds", folder)
    assert metrics["after_spots_log_ratio"] == pytest.approx(math.log(0.97), rel=1e-9)
    assert capsys.readouterr().out.splitlines()[-1].startswith("The flow design wins")


def test_a_seed_given_twice_is_refused(tmp_path, capsys):
    arguments = ["--seeds", "1", "1", "--out", str(tmp_path / "twice")]
    assert main(lens_opt_seeds.study, lens_opt_seeds.Config, arguments) == 2
    assert "give at least one seed, and none twice" in capsys.readouterr().err
