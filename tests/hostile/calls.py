"""Wrong calls into every public function: what tests gave it, with one argument exchanged for what
does not belong.

A plugin of pytest: while tests run, the first calls of every public function and method are kept;
after each test they are made anew, once for each argument and wrong value. Right is a sentence of
ours or a result with a meaning; NaN that comes out where NaN went in is counted, and no finding.
"""

import contextlib
import copy
import enum
import functools
import importlib
import inspect
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
import types
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from codesign import doors
from codesign.errors import CodesignError
from tests.processes import ROOT, python

OWN = "pose state types events flow grad lens mount optimise render system train"
SCENES = "bodies robots textures trajectories tum windows worlds"
ROOMS = [
    *(f"codesign.{room}" for room in OWN.split()),
    *(f"scenes.{room}" for room in SCENES.split()),
]
KEPT = 2  # calls of a function
SECONDS = 10  # of a wrong call
RIGHT_S = 2.0  # of a right one that is worth repeating
DOOR_S = 20.0  # for all wrong calls made of a right one
PASSED = "NaN of what is not finite"  # is no finding, and counted


class Hang(BaseException):
    """A wrong call took too long."""


@dataclass
class Door:
    """A public function or method, and calls of it: positions and names."""

    call: Callable[..., Any]
    calls: list[tuple[list[Any], dict[str, Any]]] = field(default_factory=list)
    attacked: int = 0


class Calls:
    """Keeps calls while tests run, makes them anew after each, and writes a line for each into a
    journal."""

    def __init__(self, journal: Path, known: list[str]) -> None:
        self.doors: dict[str, Door] = {}
        self.known = known
        self.inside = False
        self.journal = journal.open("a", buffering=1)
        for room in ROOMS:
            module = importlib.import_module(room)
            for name in doors.public_names(vars(module)):
                self._watch(module, name, getattr(module, name))

    def _watch(self, module, name, public):
        if not getattr(public, "__module__", "").startswith(doors.PACKAGES):
            return
        full = f"{module.__name__.removeprefix('codesign.')}.{name}"
        if inspect.isclass(public):
            protocol = getattr(public, "_is_protocol", False)
            if protocol or issubclass(public, BaseException | enum.Enum):
                return
            for method, made in list(vars(public).items()):
                named = method == "__init__" or method[0] != "_"
                if named and isinstance(made, types.FunctionType):
                    setattr(public, method, self._kept(f"{full}.{method}", made))
        elif isinstance(public, types.FunctionType):
            setattr(module, name, self._kept(full, public))

    def _kept(self, name, made):
        if name in self.known:
            return made
        door = self.doors[name] = Door(made)

        @functools.wraps(made)
        def call(*args, **kwargs):
            if not self.inside and len(door.calls) < KEPT:
                self.inside = True
                door.calls.append(copied(([*args], kwargs)))
                self.inside = False
            return made(*args, **kwargs)

        return call

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_teardown(self, item):
        self.inside = True
        state = torch.get_rng_state()
        with (
            tempfile.TemporaryDirectory() as folder,
            contextlib.chdir(folder),
            warnings.catch_warnings(action="ignore"),
        ):
            for name, door in self.doors.items():
                for args, kwargs in door.calls[door.attacked :]:
                    self._attack(name, door.call, args, kwargs)
                door.attacked = len(door.calls)
        torch.set_rng_state(state)
        self.inside = False
        return (yield)

    def _attack(self, name, call, args, kwargs):
        signature = inspect.signature(call)
        with contextlib.suppress(TypeError):
            given = signature.bind(*args, **kwargs)
            began = time.monotonic()
            if attempt(call, *copied((args, kwargs))) or time.monotonic() - began > RIGHT_S:
                return  # no call that can be repeated
            until = time.monotonic() + DOOR_S
            for argument, value in given.arguments.items():
                asked = signature.parameters[argument]
                if argument == "self" or asked.kind in (asked.VAR_POSITIONAL, asked.VAR_KEYWORD):
                    continue
                for label, wrong in wrong_values(value):
                    if time.monotonic() > until or (
                        wrong is None and "None" in f"{asked.annotation}{asked.default}"
                    ):
                        continue
                    again = inspect.BoundArguments(
                        signature, {**copied(dict(given.arguments)), argument: wrong}
                    )
                    self.journal.write(f'{{"call": "{name} | {argument} | {label}"')
                    what = attempt(call, again.args, again.kwargs)
                    self.journal.write(f', "found": {json.dumps(what)}}}\n')


def wrong_values(value: Any) -> list[tuple[str, Any]]:
    """(name, value) of what does not belong where ``value`` stood."""
    wrong = [("list", [1.0, "a"]), ("object", object()), ("none", None)]
    if isinstance(value, str | os.PathLike):
        return [*wrong, ("text", "nonsense"), ("empty", ""), ("nul", "a\0b"), ("number", 1.5)]
    wrong.append(("text", "nonsense"))
    if isinstance(value, bool | enum.Enum):
        return wrong
    if isinstance(value, int | float):
        numbers = (math.nan, math.inf, -math.inf, -1, 0, 1.5, 1e300, 1e-300, 1j)
        wrong += [(str(number), number) for number in numbers]
        return [*wrong, ("nan tensor", torch.tensor(math.nan))]
    if not isinstance(value, torch.Tensor):
        return [*wrong, ("number", 3.0), ("nan", math.nan)]
    value = value.detach()
    empty = value[:0] if value.ndim else value.new_zeros(0)
    wrong += [("number", 3.0), ("empty", empty), ("flat", value.reshape(-1))]
    wrong += [("one axis more", value[None]), ("numpy text", np.array(["a"]))]
    wrong.append(("meta", value.to("meta")))
    if value.ndim and value.shape[-1] > 1:
        wrong.append(("shorter", value[..., :-1]))
    if value.is_floating_point() and value.numel():
        for label in ("nan", "inf"):
            spoilt = value.clone(memory_format=torch.contiguous_format)
            spoilt.view(-1)[-1] = float(label)
            wrong.append((label, spoilt))
        wrong += [("complex", value + 0j), ("whole", value.int())]
    return wrong


def attempt(call: Callable[..., Any], args: Any, kwargs: Any) -> str:
    """What is wrong with how a call ends; empty where nothing is."""

    def late(*_):
        raise Hang

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        result = call(*args, **kwargs)
        if inspect.isgenerator(result):
            result = next(result, None)
        if not has_nan(result):
            return ""
        return PASSED if has_nan([*args, *kwargs.values()], not_finite) else "NaN"
    except CodesignError as error:
        return "" if str(error).strip() else "an empty sentence"
    except Hang:
        return "hangs"
    except Exception as error:  # noqa: BLE001 - foreign ones are what is looked for
        if not doors.is_ours(error.__traceback__):
            return ""  # of a function that the test gave
        return f"{type(error).__name__}: {' '.join(str(error).split())[:120]} @ {place(error)}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def place(error: BaseException) -> str:
    """File and line of ours where an error came from."""
    trace, last = error.__traceback__, ""
    while trace:
        name = trace.tb_frame.f_code.co_filename
        if name.startswith(doors.OURS):
            last = f"{Path(name).relative_to(ROOT)}:{trace.tb_lineno}"
        trace = trace.tb_next
    return last


def copied(value: Any) -> Any:
    """Arguments that a call may change: tensors by value, what cannot be copied as it is."""
    if isinstance(value, torch.Tensor) and type(value) is torch.Tensor:
        made = value.detach().clone()
        return made.requires_grad_(value.requires_grad) if value.is_floating_point() else made
    if type(value) in (tuple, list):
        return type(value)(copied(each) for each in value)
    if type(value) is dict:
        return {name: copied(each) for name, each in value.items()}
    with contextlib.suppress(Exception):
        return copy.deepcopy(value)
    return value


def has_nan(
    value: Any, is_so: Callable[[torch.Tensor], torch.Tensor] = torch.isnan, depth: int = 0
) -> bool:
    """Whether there is NaN in a number, a tensor, or a few floors of lists and dictionaries."""
    if isinstance(value, torch.Tensor):
        if value.is_meta:  # it has no values, and torch adds memory that nobody wrote
            return is_so is not_finite
        dense = value.layout == torch.strided
        real = value.is_floating_point() or value.is_complex()
        return dense and real and bool(is_so(value.detach()).any())
    if isinstance(value, float):
        return bool(is_so(torch.tensor(value)))
    if isinstance(value, dict):
        value = list(value.values())
    return (
        isinstance(value, tuple | list)
        and depth < 3
        and any(has_nan(each, is_so, depth + 1) for each in value)
    )


def not_finite(value: torch.Tensor) -> torch.Tensor:
    """NaN and infinity."""
    return ~value.isfinite()


def measure(
    count: int = 10**9,
    seed: int = 0,
    say: Callable[[str], Any] = print,
    paths: tuple[str, ...] = ("tests",),
) -> tuple[dict[str, float], list[str]]:
    """Wrong calls through the tests in ``paths``, a process for each file, ``count`` files at most.

    Returns: figures (calls made, doors, findings by kind), and a sentence for each finding.
    """
    files = []
    for path in paths:
        inside = sorted(map(str, Path(path).rglob("test_*.py")))
        files += [path] if path.endswith(".py") else inside
    files = [file for file in files if "/hostile/" not in file and "/studies/" not in file][:count]
    made, passed, doors, findings = 0, 0, set(), {}
    for file in files:
        with tempfile.TemporaryDirectory() as folder:
            journal = Path(folder) / "journal"
            with contextlib.suppress(subprocess.TimeoutExpired):
                python("-m", "tests.hostile.calls", str(journal), file, *doors)
            lines = journal.read_text().splitlines() if journal.exists() else []
        for line in lines:
            if not line.endswith("}"):
                line += ', "found": "the process ended or hung"}'
            told = json.loads(line)
            made += 1
            doors.add(told["call"].split(" | ")[0])
            passed += told["found"] == PASSED
            if told["found"] not in ("", PASSED):
                say(f"  {told['call']}: {told['found']}")
                findings[told["call"]] = told["found"]
        say(
            f"{file}: {len(lines)} wrong calls; in all {made}, {len(doors)} functions, {len(findings)} findings"
        )
    figures = {"made": made, "functions": len(doors), "nan_passed_on": passed}
    return figures, [f"{call}: {found}" for call, found in findings.items()]


if __name__ == "__main__":
    options = ["-q", "-p", "no:xdist", "-p", "no:cacheprovider", "-p", "no:unraisableexception"]
    sys.exit(pytest.main([sys.argv[2], *options], plugins=[Calls(Path(sys.argv[1]), sys.argv[3:])]))
