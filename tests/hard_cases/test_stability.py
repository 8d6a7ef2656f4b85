"""Random instances of the hard cases of `studies.stability`: each ends as theory says."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from codesign.errors import DomainError
from studies.stability.case import Case, Span, judge, trials
from studies.stability.cases import CASES
from studies.stability.coincidences import FORMS, UNITS, traced

RIGHT = [label for label, case in CASES.items() if not case.known]
KNOWN = [label for label, case in CASES.items() if case.known]
EXAMPLES = 10
FEW = 2  # of slow cases


def numbers_of(case):
    """Numbers within the spans: few by their shares of the way, many by a seed."""

    def shares(size):
        if size <= 8:
            return st.lists(st.floats(0, 1), min_size=size, max_size=size)
        seeds = st.integers(0, 2**31)
        return seeds.map(lambda n: torch.rand(size, generator=torch.Generator().manual_seed(n)))

    return st.fixed_dictionaries(
        {
            name: shares(span.size).map(lambda s, at=span.at: at(torch.as_tensor(s).double()))
            for name, span in case.spans.items()
        }
    )


@pytest.mark.parametrize("label", RIGHT)
def test_a_random_instance_ends_as_theory_says(label):
    case = CASES[label]
    varies = any(span.low != span.high for span in case.spans.values())
    count = 1 if not varies else FEW if case.slow else EXAMPLES

    @settings(max_examples=count, derandomize=True, deadline=None, database=None)
    @given(numbers_of(case))
    def check(numbers):
        rows = judge(case, numbers)
        assert all(row["passed"] for row in rows), rows

    check()


@pytest.mark.parametrize("label", KNOWN)
def test_a_known_miss_still_stands(label):
    """One that is cured loses its explanation."""
    rows = [row for numbers in trials(CASES[label], 0, 0) for row in judge(CASES[label], numbers)]
    assert not all(row["passed"] for row in rows)


def judged(seen, expected, **options):
    """Errors at 2 by kind, None where a cell stopped."""
    case = Case("a case", "a stage", {"x": Span(2.0, 2.0)}, seen, expected, **options)
    rows = judge(case, trials(case, 0, 0)[0])
    return {row["kind"]: (row["off"], row["passed"]) for row in rows}


def test_cells_have_errors_over_what_is_expected_or_its_unit():
    """x^2 and x^2 / 2 + x at 2: equal values, slopes 4 and 3."""
    found = judged(lambda x: x * x / 2 + x, lambda x: x * x)
    assert found["value"] == (0.0, True)
    assert found["gradient"] == (pytest.approx(1 / 4), False)
    assert found["float32"] == (0.0, True)
    assert judged(lambda x: x * x / 2 + x, lambda x: x * x, unit=10.0)["gradient"][0] == 0.1
    third = judged(lambda x: x / 3, lambda x: x / 3, unit=0.0, allowed=(0.0, 0.0, 1e-9))
    assert third["float32"][1] is False
    assert 1e-8 < third["float32"][0] < 1e-7


def test_no_gradient_no_number_and_another_error_are_misses():
    assert judged(lambda x: x.detach(), lambda x: x)["gradient"] == (None, False)
    assert judged(lambda x: x * torch.nan, lambda x: x)["value"] == (None, False)

    def refuses(x):
        raise DomainError("the lens is upside down")

    assert judged(refuses, lambda x: x)["value"] == (None, False)
    assert judged(refuses, "back to front") == {"value": (None, False), "float32": (None, False)}
    assert judged(refuses, "upside down") == {"value": (0.0, True), "float32": (0.0, True)}
    assert judged(lambda x: x, "upside down")["value"] == (None, False)


@pytest.mark.parametrize("kind", UNITS)
def test_a_lens_that_leaves_out_a_derivative_is_a_miss(kind):
    """As once that to the index between equal neighbours was."""
    case = CASES["equal neighbours, lens"]

    def lacking(**numbers):
        return traced(FORMS[case.name], **{**numbers, kind: numbers[kind].detach()})

    # seeds of lenses some of which diffract
    rows = [
        row
        for seed in range(5)
        for row in judge(
            replace(case, seen=lacking),
            trials(case, 0, 0)[0] | {"seed": torch.tensor(float(seed), dtype=torch.float64)},
        )
    ]
    assert {row["kind"] for row in rows if not row["passed"]} == {"gradient"}
