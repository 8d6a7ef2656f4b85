"""The wheel as setuptools builds it out of the source archive, without a network: what it puts beside
other people's packages, and that it works where there is no checkout."""

import tarfile
import zipfile
from pathlib import Path

import pytest

from tests.processes import ROOT, python

SOURCES = ("codesign", "scenes", "studies", "pyproject.toml", "setup.py", "README.md", "LICENSE")
BUILD = "from setuptools import build_meta; build_meta.build_{}('.')"
DATA = {".txt", ".npz", ".safetensors", ".jinja", ".urdf", ".csv", ".typed"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel's path; built from links, so that no build/ is left in the checkout."""
    source = tmp_path_factory.mktemp("source")
    for name in SOURCES:
        (source / name).symlink_to(ROOT / name)
    packed = python("-c", BUILD.format("sdist"), cwd=source, PYTHONPATH="")
    assert packed.returncode == 0, packed.stderr
    [archive] = source.glob("*.tar.gz")
    with tarfile.open(archive) as file:
        file.extractall(source / "unpacked", filter="data")
    [there] = (source / "unpacked").iterdir()
    built = python("-c", BUILD.format("wheel"), cwd=there, PYTHONPATH="")
    assert built.returncode == 0, built.stderr
    [path] = there.glob("*.whl")
    return path


@pytest.fixture
def installed(wheel, tmp_path):
    """The folder that holds what the wheel installs."""
    zipfile.ZipFile(wheel).extractall(tmp_path / "installed")
    return tmp_path / "installed"


def test_codesign_is_the_only_top_level_package_and_every_file_is_in_it(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"codesign"}
    here = {
        ("" if room == "codesign" else "codesign/_shipped/") + path.relative_to(ROOT).as_posix()
        for room in ("codesign", "scenes", "studies")
        for path in (ROOT / room).rglob("*")
        if path.suffix in {".py", *DATA}
    }
    assert {name for name in names if name.startswith("codesign/")} == here


def test_it_hides_nobodys_packages_and_finds_its_own(installed, tmp_path):
    for name in ("scenes", "studies"):
        (tmp_path / f"{name}.py").write_text("whose = 'mine'")
    own = "import codesign, scenes, studies; print(scenes.whose, studies.whose)"
    assert python("-c", own, cwd=tmp_path, PYTHONPATH=str(installed)).stdout == "mine mine\n"
    shipped = "import codesign; codesign.shipped.on_path(); import scenes; print(scenes.__file__)"
    found = python("-c", shipped, cwd=tmp_path, PYTHONPATH=str(installed)).stdout.strip()
    assert Path(found) == installed / "codesign" / "_shipped" / "scenes" / "__init__.py"


def test_a_study_and_what_it_starts_run_out_of_it(installed, tmp_path):
    (tmp_path / "studies.py").write_text("raise SystemExit('not mine')")
    script = (
        "import subprocess, sys; from codesign.__main__ import main\n"
        "try: main(['run', 'lens_report', '--help'])\n"
        "except SystemExit: subprocess.run([sys.executable, '-m', 'studies'], check=True)"
    )
    done = python("-c", script, cwd=tmp_path, PYTHONPATH=str(installed))
    assert done.returncode == 0, done.stderr
    assert "usage: codesign run lens_report" in done.stdout
    assert done.stdout.count(python("-m", "studies", PYTHONPATH="").stdout) == 1
