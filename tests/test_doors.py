"""What public functions say of arguments that do not fit, and what they leave alone."""

import pickle
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import pytest
import torch
from torch import Tensor

from codesign import doors, events, flow, lens, pose, render
from codesign.errors import DomainError, ShapeError
from scenes import robots, textures, worlds
from tests import refusals
from tests.hostile import calls


@refusals.table(__file__, "doors")
def test_arguments_that_do_not_fit_are_named(row):
    row.holds(
        globals() | {"render": render, "robots": robots, "textures": textures, "worlds": worlds}
    )


def test_arguments_are_named_also_where_the_package_is_installed_among_libraries(monkeypatch):
    monkeypatch.setattr(doors, "LIBRARIES", (*doors.LIBRARIES, doors.HOME))
    with pytest.raises(DomainError, match=r"lens.load: source = 3\.4"):
        lens.load(3.4)


def test_shapes_that_do_not_fit_are_a_shape_error():
    told = doors.door(lambda a, b: a @ b, "product")
    with pytest.raises(
        ShapeError,
        match=r"product cannot work with a = Tensor \[2, 3\] float32, b = Tensor \[2, 3\]",
    ):
        _ours(told)(torch.ones(2, 3), torch.ones(2, 3))


def _ours(told):
    """As if the function stood in the package."""
    code = told.__wrapped__.__code__.replace(co_filename=f"{doors.HOME}made_up.py")
    told.__wrapped__.__code__ = code
    return told


def test_errors_of_the_callers_own_functions_and_of_none_stay_as_they_are():
    told = _ours(doors.door(lambda fn: fn(), "called"))
    with pytest.raises(ValueError, match="my own size"):
        told(lambda: (_ for _ in ()).throw(ValueError("my own size")))
    with pytest.raises(TypeError, match="unexpected keyword"):
        told(other=3)
    with pytest.raises(KeyError):
        _ours(doors.door(lambda a: {}["b"], "looked up"))("a")


@pytest.mark.parametrize(
    ("hint", "right", "wrong", "needed"),
    [
        (float, [1, 1.5, torch.tensor(2.0)], ["1", None, [1.0]], "a number"),
        (int | None, [1, None], [1.5, "1"], "a whole number or None"),
        (Literal["a", "b"], ["a"], ["c", 1], "'a' or 'b'"),
        (Sequence[float], [[1, 2.0], ()], ["12", 3, [1, "a"]], "a Sequence"),
        (tuple[int, str], [(1, "a")], [[1, "a"], 3], "a tuple"),
        (Mapping[str, Tensor], [{"a": torch.ones(1)}], [{"a": 1}, [1]], "a Mapping"),
        (Callable[[int], int], [abs], [3], "a function"),
        (Iterator[int], [iter([1])], [[1]], "a Iterator"),
        (Tensor | str, [torch.ones(1), "a"], [1.0], "a torch.Tensor or a str"),
    ],
)
def test_values_are_held_against_annotations(hint, right, wrong, needed):
    assert [doors.mismatch(value, hint) for value in right] == [""] * len(right)
    assert all(doors.mismatch(value, hint).startswith(needed) for value in wrong)


def test_functions_with_doors_can_be_pickled_and_asked_for_their_signature():
    for function in (lens.load, events.simulate, flow.estimate):
        assert pickle.loads(pickle.dumps(function)) is function
    assert "generator" not in str(doors.inspect.signature(pose.se3_exp))
    with pytest.raises(DomainError, match=r"GeoLens\.scaled: factor"):
        lens.load("la1509").scaled(None)


def test_wrong_calls_end_in_sentences():
    """The quickest of ``python -m tests.hostile calls``."""
    figures, findings = calls.measure(
        paths=("tests/test_pose.py", "tests/scenes/test_tum.py"), say=lambda line: None
    )
    assert figures["made"] > 600
    assert findings == []


def test_a_process_that_ends_is_a_finding(tmp_path, monkeypatch):
    def ended(command, **_):
        Path(command[3]).write_text('{"call": "lens.load | source | nul"')
        return subprocess.CompletedProcess(command, -11)

    monkeypatch.setattr(subprocess, "run", ended)
    _, findings = calls.measure(paths=("tests/test_pose.py",), say=lambda line: None)
    assert findings == ["lens.load | source | nul: the process ended or hung"]
