"""The doctor and the renderer check, in processes of their own: a bad LLVM may abort the process,
and must not."""

from pathlib import Path

import pytest

from codesign import backend, doctor
from tests.processes import python

LLVM_15 = Path("/usr/lib/x86_64-linux-gnu/libLLVM-15.so")


@pytest.fixture(params=["absent", "llvm 15"])
def unfit(request):
    """A library path that must be refused, and what the sentence says was found there."""
    if request.param == "absent":
        return "/nonexistent.so", "no usable LLVM library was found"
    if not LLVM_15.exists():
        pytest.skip(f"{LLVM_15} is not installed on this machine")
    return str(LLVM_15), "LLVM 15."


def test_doctor_approves_a_machine_that_renders():
    done = python("-m", "codesign", "doctor")
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    names = " ".join(line[8:].split()[0] for line in lines[:-1])
    assert names == "Python torch mitsuba drjit LLVM CUDA threads extras render"
    assert lines[-1].startswith("Ready")
    assert "llvm_ad_mono" in done.stdout
    found = backend.llvm_version()
    assert found is not None
    assert ".".join(map(str, found)) in done.stdout


def test_doctor_names_the_extras_that_are_missing(monkeypatch):
    offered = [
        "torch>=2.6",
        'pip; extra == "video"',
        'no-such-package>=1; extra == "event-files"',
        "absent[part]; extra == 'export'",
        'absent; extra == "dev"',
    ]
    monkeypatch.setattr(doctor, "requires", lambda name: offered)
    finding = doctor._extras()
    assert (finding.ok, finding.found) == (None, "not installed: event-files,export")
    assert finding.remedy.startswith("pip install 'codesign[event-files,export]'")
    monkeypatch.setattr(doctor, "requires", lambda name: offered[:2])
    assert doctor._extras().found == "every one is installed"


def test_doctor_refuses_an_unfit_llvm(unfit):
    path, sentence = unfit
    done = python("-m", "codesign", "doctor", DRJIT_LIBLLVM_PATH=path)
    assert done.returncode == 2
    assert sentence in done.stdout
    assert path in done.stdout
    assert f"{backend.MINIMUM_LLVM} or newer" in done.stdout
    assert backend.install_hint() in done.stdout
    assert done.stdout.splitlines()[-1].startswith("Not ready")


def test_renderer_check_raises_instead_of_aborting(unfit, tmp_path):
    path, sentence = unfit
    script = "from codesign import backend, errors\ntry:\n    backend.mitsuba()\nexcept errors.BackendError as error:\n    print('refused:', error)"
    done = python("-c", script, DRJIT_LIBLLVM_PATH=path, XDG_CACHE_HOME=str(tmp_path))
    assert done.returncode == 0, f"ended with {done.returncode}: {done.stderr}"
    assert f"refused: {sentence}" in done.stdout
    assert "unset DRJIT_LIBLLVM_PATH" in done.stdout
    assert backend.install_hint() in done.stdout


def test_doctor_survives_a_broken_drjit(tmp_path):
    (tmp_path / "drjit.py").write_text(
        "raise OSError('libdrjit-core.so: cannot open shared object file')"
    )
    done = python("-m", "codesign", "doctor", PYTHONPATH=str(tmp_path))
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "libdrjit-core.so: cannot open shared object file" in done.stdout
    assert "make setup" in done.stdout


def test_trial_render_is_remembered(tmp_path):
    script = (
        "from codesign import backend\n"
        "backend.require_renderer()\n"
        "backend.require_renderer.cache_clear()\n"
        "backend.trial_render = lambda device: (False, 'tried again')\n"
        "backend.require_renderer()"
    )
    done = python("-c", script, XDG_CACHE_HOME=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "codesign" / "trial_render.json").is_file()


def test_help_names_the_doctor_and_the_studies():
    done = python("-m", "codesign", "--help")
    assert done.returncode == 0
    assert "doctor" in done.stdout
    assert "python -m studies." in done.stdout
    assert python("-m", "codesign", "surgeon").returncode == 2
