"""Studies with --device: on a second device, and on a GPU, they find what the processor finds."""

import pytest

from codesign.errors import DomainError
from tests import second_device
from tests.processes import python
from tests.studies.runs import contents, module_of, numbers, ran

RUNS = {
    "lens_opt": "--quick --cases 1 --scored 1 --developed 1 --spot-steps 1 --steps 1 --judged 2 --samples 4 "
    "--train-network --flow flownet --weights 20000",
    "make_dataset": "--quick --frames 30 --size 32 --world outdoor",
}
# how names begin of figures of one run alone, and of the gradient to numbers of the lens, which
# on another device do not hold what reaches them through each other
VARY = ("session_", "seconds", "gradient_norm_lens")


def figures(folder):
    return {k: v for k, v in numbers(folder).items() if not k.startswith(VARY)}


@pytest.mark.parametrize("name", RUNS)
def test_on_a_second_device_a_study_finds_the_same(name, tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    assert ran(module_of(name), RUNS[name], "--out", here) == 0
    done = python("-m", second_device.__name__, name, *RUNS[name].split(), "--out", str(there))
    assert done.returncode == 0, done.stderr
    # threads add gradients in any order
    assert figures(there) == pytest.approx(figures(here), rel=1e-4)
    assert contents(there).get("manifest.json") == contents(here).get("manifest.json")


@pytest.mark.cuda
@pytest.mark.parametrize("name", RUNS)
def test_on_a_gpu_a_study_finds_the_same(name, tmp_path):
    """An event more or less in a thousand changes errors by a percent or so."""
    found = {}
    for device in ("cpu", "cuda"):
        options = f"{RUNS[name]} --device {device}"
        assert ran(module_of(name), options, "--out", tmp_path / device) == 0
        found[device] = figures(tmp_path / device)
    assert found["cuda"].keys() == found["cpu"].keys()
    judged = [key for key in found["cpu"] if key.endswith("_hard_detuned") or key == "events"]
    assert judged
    for key in judged:
        assert found["cuda"][key] == pytest.approx(found["cpu"][key], rel=0.02), key


def test_a_choice_by_processor_time_is_refused_on_a_gpu():
    study = module_of("make_dataset")
    with pytest.raises(DomainError, match=r"^--tolerance chooses by processor time"):
        study.checked(study.Config(tolerance=0.3, device="cuda"))
    assert study.checked(study.Config(tolerance=0.3)).tolerance == 0.3
