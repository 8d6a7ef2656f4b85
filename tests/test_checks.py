"""One fault, one sentence: what every check says, and what it lets through."""

import math
import re
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
from codesign.errors import DomainError, FileFormatError, ShapeError

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


SHAPES = [
    (FLOW, "B 2 H", "x must be [B, 2, H], got [3, 2, 4, 5]."),
    (FLOW, "B 3 H W", "x must be [B, 3, H, W], got [3, 2, 4, 5]."),
    (FLOW, "B 2 H>=5 W", "x must be [B, 2, H>=5, W], got [3, 2, 4, 5]."),
    (FLOW, "B 2 side side", "x must be [B, 2, side, side], got [3, 2, 4, 5]."),
    (FLOW[:0], "B 2 H W", "x must be [B, 2, H, W], got [0, 2, 4, 5] (no axis may be empty)."),
    (FLOW[:0], "... W", "x must be [..., W], got [0, 2, 4, 5] (no axis may be empty)."),
    (FLOW[0, 0, 0], "T ... H W", "x must be [T, ..., H, W], got [5]."),
    (torch.tensor(1.0), "T ...", "x must be [T, ...], got []."),
    (FLOW, (3, 2, 4), "x must be [3, 2, 4], got [3, 2, 4, 5]."),
    (FLOW, (3, 2, 5, 4), "x must be [3, 2, 5, 4], got [3, 2, 4, 5]."),
]


@pytest.mark.parametrize(("value", "axes", "sentence"), SHAPES)
def test_shapes(value, axes, sentence):
    with pytest.raises(ShapeError) as caught:
        check(value, axes, "x")
    assert str(caught.value) == sentence


TENSORS = [
    ([1.0], {}, "x must be a torch tensor, got [1.0]."),
    (None, {}, "x must be a torch tensor, got None."),
    (
        torch.ones(2, dtype=torch.int64),
        {},
        "x must be floating-point numbers, got torch.int64; convert with .to().",
    ),
    (
        FLOW.half(),
        {"dtypes": FLOATS},
        "x must be float32 or float64, got torch.float16; convert with .to().",
    ),
    (FLOW, {"dtypes": BOOL}, "x must be bool, got torch.float32; convert with .to()."),
    (
        torch.ones(2, 2).to_sparse(),
        {},
        "x must be a dense tensor, got one stored as torch.sparse_coo; sparse ones become dense by .to_dense().",
    ),
    (
        torch.ones(2, device="meta"),
        {},
        "x must be a dense tensor, got a meta tensor without values; sparse ones become dense by .to_dense().",
    ),
    (
        HOLED,
        {"finite": True},
        "x must be finite, got NaN or infinity in 2 of 4 values (first at index [0, 1]); remove or repair them.",
    ),
    (
        EITHER_INFINITY,
        {"finite": True, "least": -math.inf, "remedy": "mark them"},
        "x must be finite, got NaN or infinity in 2 of 3 values (first at index [0]); mark them.",
    ),
    (
        HOLED,
        {"least": 0.0},
        "x must be finite, got NaN or infinity in 2 of 4 values (first at index [0, 1]); remove or repair them.",
    ),
    (
        torch.tensor([1.0, -2.5]),
        {"least": 0.0, "remedy": "subtract the black level"},
        "x must be >= 0, got -2.5 (first below at index [1]); subtract the black level.",
    ),
]


@pytest.mark.parametrize(("value", "options", "sentence"), TENSORS)
def test_kinds_and_values_of_tensors(value, options, sentence):
    with pytest.raises(DomainError) as caught:
        check(value, "...>=0", "x", **options)
    assert str(caught.value) == sentence


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


NUMBER = "x must be a finite number, got "
WHOLE = "x must be a whole number >= 1, got "
REFUSED = [
    *(
        (lambda value=value: check_number(value, "x"), NUMBER + shown)
        for value, shown in (
            ("1", "'1'"),
            (b"1", "b'1'"),
            (None, "None"),
            (True, "True"),
            ([1.0], "[1.0]"),
            (1j, "1j"),
            (math.nan, "nan"),
            (-math.inf, "-inf"),
            (10**400, "1" + "0" * 79),
            (torch.ones(2), "Tensor [2] float32"),
        )
    ),
    (lambda: check_number(-1, "x", 0.0), "x must be a finite number >= 0, got -1."),
    (lambda: check_number(2, "x", most=1.0), "x must be a finite number <= 1, got 2."),
    (lambda: check_number(3.5, "x", below=3.5), "x must be a finite number < 3.5, got 3.5."),
    (lambda: check_number(2, "x", 0.0, 1.0), "x must be a finite number from 0 to 1, got 2."),
    (
        lambda: check_number(0, "x", above=0.0, below=3.5),
        "x must be a finite number > 0 and < 3.5, got 0.",
    ),
    (
        lambda: check_number(0.0, "x", above=0.0, most=1.0, remedy="0.15 is typical"),
        "x must be a finite number > 0 and <= 1, got 0.0; 0.15 is typical.",
    ),
    (lambda: check_positive(0, "x"), "x must be a finite number > 0, got 0."),
    (
        lambda: check_positive(1e31, "x"),
        "x must be a finite number from 1e-30 to 1e+30, got 1e+31.",
    ),
    (
        lambda: check_positive(1e-10, "x", 1e-9),
        "x must be a finite number from 1e-09 to 1e+30, got 1e-10.",
    ),
    *(
        (lambda value=value: check_whole(value, "x"), "x must be a whole number")
        for value in (
            *(1.5, 0, -1, "2", True, None, math.inf, 2**62 + 1),
            *(np.array("3"), np.True_, torch.tensor(True)),
        )
    ),
    (lambda: check_whole(0.5, "x", None), "x must be a whole number, got 0.5."),
    (
        lambda: check_whole(9, "x", 1, 8, "split it"),
        "x must be a whole number from 1 to 8, got 9; split it.",
    ),
    (lambda: check_seed(2**63, "x"), "x must be a whole number"),
    (lambda: check_seed(-(2**31), "x", bits=31), "x must be a whole number from -2.14748e+09 to"),
    (lambda: check_flag(1, "x"), "x must be True or False, got 1."),
    (lambda: check_choice("c", "x", ("a", "b")), "x must be one of 'a', 'b', got 'c'."),
    (lambda: check_choice(["a"], "x", ("a", "b")), "x must be one of 'a', 'b', got ['a']."),
    (lambda: check_kind("3", int, "x"), "x must be an int, got a str."),
    (lambda: check_kind("3", int, "x", "count it"), "x must be an int, got a str; count it."),
]


@pytest.mark.parametrize(("checked", "sentence"), REFUSED)
def test_what_is_not_allowed_is_one_sentence(checked, sentence):
    with pytest.raises(DomainError, match="^" + re.escape(sentence)) as caught:
        checked()
    assert str(caught.value).endswith(".")


@pytest.mark.parametrize("path", [3, None, "", "a\0b", b"a"])
def test_what_is_no_path(path):
    with pytest.raises(FileFormatError, match=r"^the file must be text or a pathlib\.Path, got "):
        check_path(path, "the file")
