"""What every test may ask for: reference data, a seeded generator, a screenless matplotlib."""

import importlib.util
import os
import re
from contextlib import nullcontext
from pathlib import Path

import drjit
import pytest

import codesign  # noqa: F401  (first: it sets OpenMP's wait policy before torch is imported)

import torch  # isort: skip

from tests.rounding_case import RoundsByPlace  # isort: skip

os.environ.setdefault("MPLBACKEND", "Agg")
# small tensors: a second thread costs more than it gives, and drjit's spin while they wait
torch.set_num_threads(int(os.environ.get("CODESIGN_TEST_THREADS", "1")))
drjit.set_thread_count(torch.get_num_threads())
# modules that extras of pyproject.toml bring
EXTRAS = {
    *("h5py", "hdf5plugin", "lz4", "zstandard", "imageio", "imageio_ffmpeg", "tifffile"),
    *("trimesh", "collada"),
    *("yourdfpy", "lxml", "tensorboard", "cma", "optuna", "onnx", "onnxscript", "viser"),
}
ABSENT = {name for name in EXTRAS if importlib.util.find_spec(name) is None}
ROOT = Path(__file__).resolve().parents[1]
SHARED = next(
    (folder for folder in (ROOT / "shared", ROOT.parent / "shared") if folder.is_dir()), None
)
SUBSET = ROOT / "tests" / "data"  # of the reference values; see its README.md


def _without_extras(report, path):
    """The report of a file or test that fails for want of a package of an extra, as skipped."""
    said = report.longreprtext + "".join(text for _, text in report.sections)
    names = "|".join(sorted(ABSENT))
    missing = re.search(
        rf"No module named '({names})\b|needs \S+; install it with: pip install 'codesign\[", said
    )
    if ABSENT and report.failed and missing:
        report.outcome = "skipped"
        report.longrepr = (str(path), 0, f"Skipped: {missing[0]}")
    return report


def pytest_runtest_setup(item):
    if item.get_closest_marker("cuda") and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    return _without_extras((yield), collector.path)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    return _without_extras((yield), item.path)


@pytest.fixture(scope="session")
def shared():
    """Function from a relative name ("refs/lens/rays.json") to its path in the shared folder beside
    the checkout. Where that has none, reference values come from the subset in tests/data, and a
    test that needs a recording, a lens file or a mesh is skipped."""

    def find(name):
        for folder in (SHARED, SUBSET):
            if folder is not None and (folder / name).exists():
                return folder / name
        pytest.skip(
            f"{name} is absent: recordings, lens files and meshes live beside the checkout, in ../shared"
        )

    return find


@pytest.fixture
def generator():
    """A torch generator with a fixed seed of its own; the global one is never seeded."""
    return torch.Generator().manual_seed(0)


@pytest.fixture(autouse=True)
def _processor(request):
    """With CODESIGN_TEST_ROUNDING=place, tests of equal bits run on a processor that rounds by
    place."""
    rounds = os.environ.get(
        "CODESIGN_TEST_ROUNDING"
    ) == "place" and request.node.get_closest_marker("bits")
    with RoundsByPlace() if rounds else nullcontext():
        yield
