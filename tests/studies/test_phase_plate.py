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


def perfect(diameter_mm):
    surface = Surface(-100.0, 50.0, None, 12.0, conic=-1.0, is_stop=True, mirror=True)
    return GeoLens([surface], diameter_mm, half_field_deg=5.0).requires_grad_(False)


def test_contrast_is_the_transfer_of_a_perfect_lens():
    config = configured(phase_plate.Config, quick=True, pixel_um=6.0)
    found = phase_plate.contrast(config, perfect(4.0), math.inf, 0.0)
    truth = ideal_mtf([c / 6e-3 for c in phase_plate.CYCLES_PER_PX], 12.5)
    # 1 % of an Airy pattern at f/12.5 lies beyond the 0.19 mm of samples, which lifts the rest as much
    torch.testing.assert_close(found, truth.to(found), rtol=0, atol=0.015)


def test_a_defocused_lens_has_the_contrast_of_its_blur():
    # three waves of defocus: Stokseth's closed form, good to a few hundredths (JOSA 59, 1969)
    config = configured(phase_plate.Config, quick=True, pixel_um=25.0)
    geo = perfect(4.0)
    blurred = geo.replace(thickness_mm=geo.thickness_mm + 2.2)
    frequency = torch.tensor(phase_plate.CYCLES_PER_PX, dtype=torch.float64) / 25e-3
    s = 2 * frequency / (4.0 / 50.0 / 0.5875618e-3)
    x = math.pi * (2.2 * 4.0 / 50.0) * frequency * (1 - s / 2)
    truth = (1 - 0.69 * s + 0.0076 * s**2 + 0.043 * s**3) * 2 * torch.special.bessel_j1(x).abs() / x
    found = phase_plate.contrast(config, blurred, math.inf, 0.0)
    torch.testing.assert_close(found, truth, rtol=0, atol=0.03)


@pytest.mark.slow
def test_a_short_run_meets_the_closed_forms_and_improves_the_plate(tmp_path):
    out = tmp_path / "run"
    assert main(phase_plate.study, phase_plate.Config, ["--quick", "--steps", "4", "--out", str(out)]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["propagation_fresnel_error_max"] <= 1e-4
    assert metrics["propagation_airy_error_max"] <= 1e-4
    assert metrics["propagation_energy_error"] <= 1e-10
    assert metrics["plate_over_open_contrast_8px_worst"] > 1.2
    page = (out / "report.html").read_text()
    assert f"the plate has {metrics['plate_over_open_contrast_8px_worst']:.2f} times the contrast" in page
    assert metrics["stop_of_equal_contrast_8px_light"] == 0.25  # the only one tried


def test_ranges_that_are_none_are_refused(capsys, tmp_path):
    arguments = ["--quick", "--near-m", "5", "--far-m", "0.3", "--out", str(tmp_path / "run")]
    assert main(phase_plate.study, phase_plate.Config, arguments) == 2
    assert "give near < far" in capsys.readouterr().err


def test_blur_keeps_light_and_shifts_with_its_kernel():
    picture = torch.rand(128, 128, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    kernel = torch.zeros(64, 64, dtype=torch.float64)
    kernel[32, 32] = 3.0
    torch.testing.assert_close(phase_plate.blurred(picture, kernel), picture)  # a point, whatever its light
    kernel[32, 32], kernel[30, 35] = 0.0, 1.0  # two up, three to the right
    torch.testing.assert_close(phase_plate.blurred(picture, kernel), picture.roll((-2, 3), (0, 1)))


def test_a_moving_edge_fires_its_contrast():
    # a step of ln 4 in the logarithm: 6 thresholds of 0.2 at every pixel it crosses, one sign
    picture = torch.full((128, 128), 50.0, dtype=torch.float64)
    picture[:, 64:] = 200.0
    signed, every = phase_plate.counts(picture)
    assert signed.shape == (46, 46)
    assert set(signed.unique().tolist()) == {0.0, -6.0}
    assert torch.equal(every, signed.abs())
