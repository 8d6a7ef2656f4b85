"""One fault, one sentence: what every check says, and what it lets through."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from codesign.checks import (
    FLOATS,
    check,
    check_choice,
    check_finite,
    check_flag,
    check_kind,
    check_number,
    check_path,
    check_positive,
    check_seed,
    check_whole,
)
from codesign.errors import DomainError, ShapeError
from tests import refusals

FLOW = torch.ones(3, 2, 4, 5)
HOLED = torch.tensor([[1.0, math.nan], [math.inf, 2.0]])
EITHER_INFINITY = torch.tensor([math.inf, -math.inf, 1.0])
BOOL = (torch.bool,)


@pytest.mark.parametrize(
    ("value", "axes", "options"),
    [
        (FLOW, "B 2 H W", {}),
        (FLOW, "B 2 H>=4 W>=5", {}),
        (FLOW, (3, 2, 4, 5), {}),
        (FLOW, "... 2 H W", {}),
        (FLOW, "B ... W", {}),
        (FLOW, "B ... 2 H W", {}),
        (FLOW, "B 2 H W", {"sizes": {"B": 3, "W": 5}}),
        (FLOW[:, :, :, :4], "B 2 side side", {}),
        (FLOW[:0], "B>=0 2 H W", {}),
        (FLOW[:0], "...>=0", {}),
        (torch.tensor(1.0), "...", {}),
        (FLOW.half(), "B 2 H W", {}),
        (FLOW.double(), "B 2 H W", {"dtypes": FLOATS}),
        (FLOW > 0, "B 2 H W", {"dtypes": BOOL}),
        (HOLED, "a b", {}),
        (FLOW, "B 2 H W", {"least": 1.0, "finite": True}),
        (torch.full((2,), 3e38), "N", {"finite": True}),  # the sum overflows, no value does
        (torch.tensor([math.inf]), "N", {"least": 0.0}),
    ],
)
def test_tensors_that_fit_come_back_as_they_are(value, axes, options):
    assert check(value, axes, "x", **options) is value


def test_letters_carry_their_sizes_to_the_next_tensor():
    sizes = {}
    check(FLOW, "B 2 H W", "the flow", sizes=sizes)
    assert sizes == {"B": 3, "H": 4, "W": 5}
    with pytest.raises(ShapeError) as caught:
        check(FLOW[0, 0] > 0, "H W2 W", "valid", BOOL, sizes=sizes)
    assert str(caught.value) == "valid must be [H, W2, W] with H = 4, W = 5, got [4, 5]."


def test_infinities_of_both_signs_are_found_by_themselves():
    assert check_finite(FLOW, "x") is FLOW
    with pytest.raises(
        DomainError, match=r"2 of 3 values \(first at index \[0\]\); take smaller steps\.$"
    ):
        check_finite(EITHER_INFINITY, "x", "take smaller steps")


@pytest.mark.parametrize(
    ("checked", "kind", "result"),
    [
        (lambda: check_number(2, "x"), float, 2.0),
        (lambda: check_number(torch.tensor(2.5, requires_grad=True), "x"), float, 2.5),
        (lambda: check_number(np.float32(0.5), "x", 0.0, 1.0), float, 0.5),
        (lambda: check_number(1, "x", 1, 1), float, 1.0),
        (lambda: check_positive(1e-30, "x"), float, 1e-30),
        (lambda: check_positive(1e30, "x"), float, 1e30),
        (lambda: check_whole(3.0, "x"), int, 3),
        (lambda: check_whole(np.int64(7), "x"), int, 7),
        (lambda: check_whole(-(2**62), "x", None), int, -(2**62)),
        (lambda: check_whole(2**60 + 1, "x"), int, 2**60 + 1),
        (lambda: check_seed(1 - 2**63, "x"), int, 1 - 2**63),
        (lambda: check_seed(2**31 - 1, "x", bits=31), int, 2**31 - 1),
        (lambda: check_flag(False, "x"), bool, False),
        (lambda: check_choice("a", "x", {"a": 1, "b": 2}), str, "a"),
        (lambda: check_kind(3, int, "x"), int, 3),
        (lambda: check_path("a.npz"), type(Path()), Path("a.npz")),
    ],
)
def test_what_is_allowed_is_returned_in_one_kind(checked, kind, result):
    found = checked()
    assert type(found) is kind
    assert found == result


@refusals.table(__file__, "checks")
def test_what_is_not_allowed_is_one_sentence(row):
    whole = "$" if row.sentence.endswith(".") else ""
    told = replace(row, sentence=f"^{re.escape(row.sentence)}{whole}").holds(globals())
    assert told.endswith(".")
