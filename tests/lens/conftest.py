"""The lens that most tests of lenses ask."""

import pytest

from codesign import lens


@pytest.fixture(scope="module")
def triplet():
    return lens.load("cooke-triplet").freeze()
