"""What is written is the YAML that others read, and comes back to the bit; what is no data of ours is refused."""

import math
import re
import struct

import pytest
import torch

from codesign import plain_yaml
from codesign.errors import DomainError, FileFormatError

# how YAML 1.1 tells a float (yaml.org/type/float.html, less infinities and base 60), as PyYAML and ROS have it
FLOAT = re.compile(r"[-+]?([0-9][0-9_]*)\.[0-9.]*([eE][-+][0-9]+)?")


def test_floats_come_back_to_the_bit_and_are_floats_elsewhere(generator):
    bits = torch.randint(-(2**63), 2**63 - 1, (3000,), generator=generator, dtype=torch.int64)
    values = [v for v in bits.view(torch.float64).tolist() if math.isfinite(v)]
    values += [0.0, -0.0, 1.0, 1e16, 1e-7, 5e-324, 1.7976931348623157e308, 0.1, -123456789.0]
    text = plain_yaml.dump({"values": values, **{f"v{k}": v for k, v in enumerate(values)}})
    found = plain_yaml.load(text)
    assert struct.pack(f"{len(values)}d", *found["values"]) == struct.pack(f"{len(values)}d", *values)
    assert all(FLOAT.fullmatch(line.split(": ")[1]) for line in text.splitlines()[1:])


def test_pages_come_back():
    page = {
        "a": {"b": {"c": 1, "d": [1, 2.5, [True, None], "x: #y"]}, "text": 'quotes " and \n lines, #, é'},
        "last": -3,
        "yes": "yes",
    }
    text = plain_yaml.dump(page, "first line\n\nsecond")
    assert text.startswith("# first line\n#\n# second\na:\n  b:\n    c: 1\n")
    assert plain_yaml.load(text) == page


def test_words_need_no_quotes():
    page = plain_yaml.load("a: base_link  # here\nb: [1, 2]  # there\n\n# c: 3\nd:  # below\n  e: 1.5e-3\n")
    assert page == {"a": "base_link", "b": [1, 2], "d": {"e": 1.5e-3}}
    page = plain_yaml.load('a: [base_link, 2, "x y"]  # here\nb: ../robots/rover.urdf\nc: /tmp/rover.urdf\n')
    assert page == {"a": ["base_link", 2, "x y"], "b": "../robots/rover.urdf", "c": "/tmp/rover.urdf"}


@pytest.mark.parametrize(
    "text",
    [
        "a: !!python/object/apply:os.system ['true']",
        "a: &anchor 1",
        "a: *anchor",
        "<<: 1",
        "a: {b: 1}",
        'a: {"b": 1}',
        "a: |\n  text",
        "a: yes",
        "a: .nan",
        "a: NaN",
        "a: Infinity",
        "a: 1e999",
        "a: " + 100_000 * "[",
        "a: 1 2",
        "a: [1, 2",
        "a: [b, [c]]",
        "a: [b, yes]",
        "a: [b,]",
        "a: [b] c",
        "a: " + 100_000 * "[" + "b" + 100_000 * "]",
        "a: ..",
        "- 1",
        "a 1",
        "a:1",
        "\ta: 1",
        " a: 1",
        "a: 1\n  b: 2",
        "a:\nb: 1",
        "a:\n    b: 1",
        "a: 1\na: 2",
        "a:",
        "---\na: 1",
    ],
)
def test_other_yaml_is_refused_with_its_line(text):
    with pytest.raises(FileFormatError, match="yaml"):
        plain_yaml.load(text)


@pytest.mark.parametrize("page", [{"a b": 1}, {"a": math.nan}, {"a": object()}, {"a": {}}, {"a": [math.inf]}])
def test_what_cannot_be_written_gets_a_sentence(page):
    with pytest.raises(DomainError, match="yaml: "):
        plain_yaml.dump(page)
