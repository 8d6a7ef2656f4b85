"""What certificates refuse: the calls and sentences of refusals.txt."""

from pathlib import Path

import pytest
import torch

from codesign import errors
from codesign.grad import certify

X = {"x": torch.tensor([1.0, 2.0], dtype=torch.float64)}
GENERATOR = torch.Generator().manual_seed(0)


def total(p):
    return p["x"].sum()


def noisy(p):
    return (p["x"] * torch.rand(2, generator=GENERATOR)).sum()


NAMES = globals() | {"certify": certify}
TEXT = Path(__file__).with_name("refusals.txt").read_text()
ROWS = [row.split(" | ", 2) for row in TEXT.splitlines() if "Error |" in row]


@pytest.mark.parametrize(("call", "error", "sentence"), ROWS)
def test_what_cannot_be_judged_is_refused_in_one_sentence(call, error, sentence):
    with pytest.raises(getattr(errors, error), match=sentence) as caught:
        eval(call, NAMES)
    assert "\n" not in str(caught.value)
