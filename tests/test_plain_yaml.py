"""What is written is the YAML that others read, and comes back to the bit; what is no data is
refused."""

import math
import struct

import pytest
import torch
import yaml

from codesign import plain_yaml
from tests import refusals


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


@refusals.table(__file__, "yaml")
def test_other_yaml_is_refused_and_what_cannot_be_written(row):
    row.holds(vars(plain_yaml) | {"math": math})
