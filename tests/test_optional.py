"""Packages that the core does without: nothing needs them to be imported, and a missing one is
named in a sentence."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions

import pytest
import torch

from codesign import events
from codesign.errors import CodesignError, MissingPackageError
from codesign.optional import optional, require
from codesign.types import EventStream
from tests.processes import ROOT, python

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = {
    extra: {re.split(r"[^A-Za-z0-9_-]", line)[0] for line in lines}
    for extra, lines in PROJECT["optional-dependencies"].items()
}
LEFT_OUT = "h5py hdf5plugin lz4 zstandard imageio imageio_ffmpeg tifffile tensorboard"


CALLS = {
    "events.read('a.aedat4')": ("lz4", "event-files"),
    "events.write('b.aedat4', stream)": ("lz4", "event-files"),
    "events.read('a.h5')": ("hdf5plugin", "event-files"),
    "events.write('b.h5', stream)": ("hdf5plugin", "event-files"),
    "events.write_video('b.mp4', [picture], 10)": ("imageio-ffmpeg", "video"),
    "events.write_video('b.gif', [picture], 10)": ("imageio", "video"),
    "events.open_frames('a.mp4')": ("imageio-ffmpeg", "video"),
}
# one process for all: importing the toolkit is what takes the time
SCRIPT = f"""
import sys
sys.modules.update(dict.fromkeys('{LEFT_OUT}'.split()))  # importing one of them raises ModuleNotFoundError
import codesign, scenes.textures, scenes.worlds
for name in codesign.__all__:
    getattr(codesign, name)
from studies.lens_opt import __main__
import numpy, torch
from codesign import events
from codesign.errors import CodesignError
from codesign.types import EventStream
zero = torch.zeros(1, dtype=torch.int64)
stream = EventStream(zero, zero, zero, zero + 1, 2, 2)
picture = numpy.zeros((4, 4), numpy.uint8)
for call in {tuple(CALLS)}:
    try:
        eval(call)
    except CodesignError as error:
        print(type(error).__name__, error)
"""


def test_without_the_extras_all_is_imported_and_a_missing_package_is_one_sentence(tmp_path):
    zero = torch.zeros(1, dtype=torch.int64)
    for ending in ("aedat4", "h5"):
        events.write(tmp_path / f"a.{ending}", EventStream(zero, zero, zero, zero + 1, 2, 2))
    (tmp_path / "a.mp4").write_bytes(b"no video")
    before = sorted(tmp_path.iterdir())
    done = python("-c", SCRIPT, cwd=tmp_path, PYTHONPATH=str(ROOT))
    assert done.returncode == 0, done.stderr
    for said, (package, extra) in zip(done.stdout.splitlines(), CALLS.values(), strict=True):
        assert re.fullmatch(
            rf"MissingPackageError [^;]+ needs {package}; install it with: pip install 'codesign\[{extra}\]'",
            said,
        )
        assert package in EXTRAS[extra], "the extra brings the package"
    assert sorted(tmp_path.iterdir()) == before, "what cannot be written leaves nothing behind"


def test_the_stand_in_is_the_module_once_it_is_there():
    later = optional("zipfile", "event-files", "this")
    import zipfile

    assert later.ZipFile is zipfile.ZipFile
    absent = optional("no_such_package.part", "video", "this", "zipfile")
    with pytest.raises(
        MissingPackageError, match=r"^this needs no-such-package; install it with: pip install"
    ):
        _ = absent.anything
    assert issubclass(MissingPackageError, (CodesignError, ImportError))
    assert not hasattr(absent, "__wrapped__"), "inspection imports nothing"
    with pytest.raises(MissingPackageError, match="pip install 'codesign\\[video\\]'"):
        require("no_such_package", "video", "this")


def test_a_package_that_cannot_be_imported_is_named(tmp_path, monkeypatch):
    (tmp_path / "half_installed.py").write_text("raise ImportError('libgone.so: no such file')")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(
        MissingPackageError,
        match=r"half_installed, which is installed .* \(libgone.so: no such file\)",
    ):
        require("half_installed", "video", "this")


def test_sources_name_extras_that_exist_and_no_other_package_is_imported_at_the_top():
    core = {re.split(r"[^A-Za-z0-9_-]", line)[0] for line in PROJECT["dependencies"]}
    named = set()
    modules = set()
    for top in ("codesign", "scenes", "studies"):
        for path in (ROOT / top).rglob("*.py"):
            text = path.read_text()
            named |= set(re.findall(r'(?:optional|require)\(\s*[\w".]+,\s*"([\w-]+)",', text))
            for node in ast.parse(text).body:
                if isinstance(node, ast.Import):
                    modules |= {alias.name.split(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom):
                    modules.add((node.module or "").split(".")[0])
    assert named <= EXTRAS.keys()
    assert {"event-files", "video", "export", "training-logs"} <= named
    where = packages_distributions()
    own = {"codesign", "scenes", "studies", *sys.stdlib_module_names}
    asked = {where[module][0] for module in modules - own}
    assert {name.lower() for name in asked} <= {name.lower() for name in core}
