"""What certificates refuse: the calls and sentences of refusals.txt."""

import torch

from codesign.grad import certify
from tests import refusals

X = {"x": torch.tensor([1.0, 2.0], dtype=torch.float64)}
GENERATOR = torch.Generator().manual_seed(0)


def total(p):
    return p["x"].sum()


def noisy(p):
    return (p["x"] * torch.rand(2, generator=GENERATOR)).sum()


@refusals.table(__file__)
def test_what_cannot_be_judged_is_refused_in_one_sentence(row):
    row.holds(globals() | {"certify": certify})
