"""Tests that compare two ways to the same numbers for equal bits are run as other processors
round."""

import ast
import re
from pathlib import Path

TESTS = Path(__file__).parent
PROMISE = re.compile("bit_for_bit|last_bit|chunks?_|chunking|_batch|resumed|repeats?_|the_whole")
# equal by construction on every processor: files and copies
BY_CONSTRUCTION = {"test_two_processes_interrupted_and_resumed_learn_what_one_does"}


def unmarked(source):
    """Names of tests that promise equality of parts, batches or repetitions, compare with
    torch.equal or array_equal, and lack the marker."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.FunctionDef) or not node.name.startswith("test_"):
            continue
        body = ast.get_source_segment(source, node) or ""
        marked = any(
            ast.unparse(decorator) == "pytest.mark.bits" for decorator in node.decorator_list
        )
        if (
            PROMISE.search(node.name)
            and re.search(r"torch\.equal|array_equal", body)
            and not marked
        ):
            yield node.name


def test_promises_of_equal_bits_are_marked():
    found = {name for path in TESTS.rglob("test_*.py") for name in unmarked(path.read_text())}
    assert found == BY_CONSTRUCTION


def test_an_unmarked_promise_is_found():
    body = "def test_chunks_equal_the_whole():\n    assert torch.equal(a, b)\n"
    assert list(unmarked(body)) == ["test_chunks_equal_the_whole"]
    assert not list(unmarked("@pytest.mark.bits\n" + body))
