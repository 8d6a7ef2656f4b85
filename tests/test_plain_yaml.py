"""What is written is the YAML that others read, and comes back to the bit; what is no data is
refused."""

import math
import struct

import pytest
import torch
import yaml

from codesign import plain_yaml
from codesign.errors import DomainError, FileFormatError


def test_floats_come_back_to_the_bit_here_and_elsewhere(generator):
    bits = torch.randint(-(2**63), 2**63 - 1, (3000,), generator=generator, dtype=torch.int64)
    values = [v for v in bits.view(torch.float64).tolist() if math.isfinite(v)]
    values += [0.0, -0.0, 1.0, 1e16, 1e-7, 5e-324, 1.7976931348623157e308, 0.1, -123456789.0]
    text = plain_yaml.dump({"values": values})
    for found in (plain_yaml.load(text), yaml.safe_load(text)):
        assert struct.pack(f"{len(values)}d", *found["values"]) == struct.pack(
            f"{len(values)}d", *values
        )


def test_pages_come_back():
    page = {
        "a": {
            "b": {"c": 1, "d": [1, 2.5, [True, None], "x: #y"]},
            "text": 'quotes " and \n lines, #, é, \x85',
        },
        "last": -3,
        "yes": "yes",
        "number": "1e-3",
    }
    text = plain_yaml.dump(page, "first line\n\nsecond")
    assert text.startswith("# first line\n#\n# second\na:\n  b:\n    c: 1\n")
    assert plain_yaml.load(text) == page == yaml.safe_load(text)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("yes", "yes"),
        ("1e-3", 1e-3),
        ("1:30", "1:30"),
        ("010", "010"),
        ("../a b.urdf", "../a b.urdf"),
        ("{b: 1}", {"b": 1}),
    ],
)
def test_words_are_words_and_numbers_those_of_json(text, value):
    assert plain_yaml.load(f"a: {text}  # here\n") == {"a": value}


@pytest.mark.parametrize(
    "text",
    [
        "a: !!python/object/apply:os.system ['true']",
        "a: &anchor 1",
        "a: *anchor",
        "a: 1e999",
        "a: " + 100_000 * "[",
        "a: [1, 2",
        "- 1",
        "a 1",
        "\ta: 1",
        "a: 1\n  b: 2",
        "a: 1\na: 2",
        "a:\n  b: 1\n  b: 2",
        "1: 2",
        "a:\n  0.5: 2",
        "a: {true: 1}",
        "a: [{1: 2}]",
        "a: 1\n---\na: 1",
        "a: 2026-11-24\n" * 2,
        "",
        "a: 1\n" * 20_000,
    ],
)
def test_other_yaml_is_refused(text):
    with pytest.raises(FileFormatError, match="yaml"):
        plain_yaml.load(text)


@pytest.mark.parametrize("page", [{"a": math.nan}, {"a": object()}, {"a": [math.inf]}])
def test_what_cannot_be_written_gets_a_sentence(page):
    with pytest.raises(DomainError, match="yaml: "):
        plain_yaml.dump(page)
