"""`import codesign`: quick, without LLVM, with everything behind it."""

import importlib
import pickle
import sys
import tomllib
from importlib.metadata import version

import pytest
import yaml

import codesign
from codesign import mount
from tests.processes import ROOT, python

# for the toolkit itself
PRIVATE = {
    *("arrays", "__init__", "__main__", "atomic", "checks", "doctor", "doors", "former"),
    *("interrupt", "optional", "place", "plain_yaml", "reading", "task", "waiting"),
}


def test_the_import_alone_loads_nothing_heavy():
    script = (
        "import sys, codesign; heavy = ('torch', 'numpy', 'drjit', 'mitsuba', 'kornia', 'matplotlib'); "
        "print([name for name in heavy if name in sys.modules])"
    )
    done = python("-c", script)
    assert done.stdout == "[]\n"


def test_every_room_is_reachable_from_the_package():
    standing = {
        path.stem
        for path in (ROOT / "codesign").iterdir()
        if path.suffix == ".py" or (path / "__init__.py").exists()
    }
    # a class and two functions are shown there beside them
    rooms = {name for name in codesign.__all__ if name.islower()} - {"select", "show"}
    assert rooms == standing - PRIVATE
    assert set(codesign.__all__) <= set(dir(codesign))
    script = (
        "import codesign; print(codesign.errors.DomainError.__name__, codesign.lens.load.__name__)"
    )
    done = python("-c", script)
    assert done.stdout == "DomainError load\n"


def test_the_version_is_that_of_the_installed_package():
    assert codesign.__version__ == version("codesign")


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match=r"no attribute 'lenses'; it has .*backend, errors"):
        _ = codesign.lenses  # pyright: ignore


def test_annotations_are_announced():
    assert (ROOT / "codesign" / "py.typed").read_text() == ""


@pytest.mark.parametrize(("room", "name"), [("place", "Mount"), ("task", "EgoVelocity")])
def test_the_former_rooms_of_mounts_still_import_and_say_the_new_one(room, name):
    sys.modules.pop(f"codesign.{room}", None)
    with pytest.warns(FutureWarning, match=f"codesign.{room} is codesign.mount now"):
        found = importlib.import_module(f"codesign.{room}")
    assert getattr(found, name) is getattr(mount, name)


@pytest.mark.filterwarnings("ignore::FutureWarning")
def test_a_mount_pickled_under_its_former_name_is_read():
    written = pickle.dumps(mount.Mount((0.2, 0, 0.45), (0.1, 0.1, 0.15)), protocol=0)
    former = written.replace(b"ccodesign.mount.pose\n", b"ccodesign.place.mount\n")
    assert former != written
    assert isinstance(pickle.loads(former), mount.Mount)


def test_the_citation_is_whole_and_names_this_version():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    # what the format 1.2.0 requires
    assert {"cff-version", "message", "title", "authors"} <= cited.keys()
    assert cited["cff-version"] == "1.2.0"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (cited["version"], cited["license"]) == (project["version"], project["license"])
