"""The study of a phase plate: its measure of contrast, its descent, and the page of a short run."""

import json
import math

import pytest
import torch

from codesign.lens import GeoLens, Surface
from codesign.lens.analysis import ideal_mtf
from studies import phase_plate
from studies.frame.config import configured
from studies.frame.run import main
from tests.studies.browser import check_page


def perfect(diameter_mm):
    surface = Surface(-100.0, 50.0, None, 12.0, conic=-1.0, is_stop=True, mirror=True)
    return GeoLens([surface], diameter_mm, half_field_deg=5.0).requires_grad_(False)


def test_contrast_is_the_transfer_of_a_perfect_lens():
    config = configured(phase_plate.Config, quick=True, pixel_um=6.0)
    found = phase_plate.contrast(config, perfect(4.0), math.inf, 0.0)
    truth = ideal_mtf([1 / (p * 6e-3) for p in phase_plate.PERIODS_PX], 12.5)
    # 1 % of an Airy pattern at f/12.5 lies beyond the 0.19 mm of samples, which lifts the rest as
    # much
    torch.testing.assert_close(found, truth.to(found), rtol=0, atol=0.015)


def test_a_defocused_lens_has_the_contrast_of_its_blur():
    # three waves of defocus: Stokseth's closed form, good to a few hundredths (JOSA 59, 1969)
    config = configured(phase_plate.Config, quick=True, pixel_um=25.0)
    geo = perfect(4.0)
    blurred = geo.replace(thickness_mm=geo.thickness_mm + 2.2)
    frequency = 1 / (torch.tensor(phase_plate.PERIODS_PX, dtype=torch.float64) * 25e-3)
    s = 2 * frequency / (4.0 / 50.0 / 0.5875618e-3)
    x = math.pi * (2.2 * 4.0 / 50.0) * frequency * (1 - s / 2)
    truth = (1 - 0.69 * s + 0.0076 * s**2 + 0.043 * s**3) * 2 * torch.special.bessel_j1(x).abs() / x
    found = phase_plate.contrast(config, blurred, math.inf, 0.0)
    torch.testing.assert_close(found, truth, rtol=0, atol=0.03)


@pytest.mark.slow
def test_a_short_run_improves_the_plate(tmp_path):
    out = tmp_path / "run"
    assert (
        main(phase_plate.study, phase_plate.Config, ["--quick", "--steps", "4", "--out", str(out)])
        == 0
    )
    metrics = json.loads((out / "metrics.json").read_text())
    gain = metrics["plate_over_open_contrast_8px"]
    assert gain > 1.2
    assert f"the plate has {gain:.2f} times the contrast" in (out / "report.html").read_text()
    assert metrics["plate_equal_stop_light_8px"] == 0.25  # the only one tried
    check_page("phase_plate", out)


def test_ranges_that_are_none_are_refused(capsys, tmp_path):
    arguments = ["--quick", "--near-m", "5", "--far-m", "0.3", "--out", str(tmp_path / "run")]
    assert main(phase_plate.study, phase_plate.Config, arguments) == 2
    assert "give near < far" in capsys.readouterr().err
