"""What every test may ask for: reference data beside the checkout, a seeded generator, a screenless
matplotlib."""

import os
from pathlib import Path

import pytest

import codesign  # noqa: F401  (first: it sets OpenMP's wait policy before torch is imported)

import torch  # isort: skip

os.environ.setdefault("MPLBACKEND", "Agg")
torch.set_num_threads(1)  # small tensors: a second thread costs more than it gives
ROOT = Path(__file__).resolve().parents[1]
SHARED = next((folder for folder in (ROOT / "shared", ROOT.parent / "shared") if folder.is_dir()), None)


@pytest.fixture(scope="session")
def shared():
    """Function from a relative name ("refs/lens/rays.json") to its path in the shared folder; skips the test
    when it is not there."""

    def find(name):
        if SHARED is None:
            pytest.skip("shared folder absent: the reference data live beside the checkout, in ../shared")
        path = SHARED / name
        if not path.exists():
            pytest.skip(f"shared folder has no {name}")
        return path

    return find


@pytest.fixture
def generator():
    """A torch generator with a fixed seed of its own; the global one is never seeded."""
    return torch.Generator().manual_seed(0)
