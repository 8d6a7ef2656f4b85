"""Values, gradients and refusals of every public function, recorded once and asked again while the house is made smaller.

    python -m tests.pins record FOLDER [tests ...]   at the commit that is to be kept
    python -m tests.pins replay FOLDER [prefix]      at any later one, all or of names that start so

While tests run, the first calls of every public function and method are kept, as tests.hostile does, and made anew: with
the given arguments, with gradients for all floating tensors among them, and with one argument exchanged for what does
not belong. What was given and what came of it is pickled, which only who recorded it should read. Leaves with issue N.
"""

import contextlib
import dataclasses
import importlib
import inspect
import io
import itertools
import json
import pickle
import re
import subprocess
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.hostile import calls

LARGEST = 300_000  # bytes of a call that is kept
# old name -> new, of rooms, modules, functions and classes; the longest one that fits counts
RENAMED: dict[str, str] = {
    "place": "mount",
    "task": "mount",
    "codesign.place": "codesign.mount",
    "codesign.place.mount": "codesign.mount.pose",
    "codesign.place.ranges": "codesign.mount.pose",
    "codesign.place.criterion": "codesign.mount.sight",
    "codesign.place.solids": "codesign.mount.body",
    "codesign.task": "codesign.mount",
    "codesign.task.evidence": "codesign.mount.head",
    "codesign.task.expected": "codesign.mount.errors",
    "codesign.task.own_body": "codesign.mount.requirements",
    "codesign.task.score": "codesign.mount.errors",
    **{
        f"codesign.events.spiking.{name}": "codesign.events.spiking.spike_esim_parts"
        for name in ("front", "residual", "noise")
    },
    "codesign.events.formats.aedat4": "codesign.events.formats.aedat",
    "codesign.events.spiking.srm_state.SrmState": "codesign.events.spiking.srm.SrmState",
    "codesign.events.spiking.two_branches": "codesign.events.spiking.thesis_network",
    "codesign.events.layers.layer.ComparatorLayer": "codesign.events.layers.comparators.ComparatorLayer",
    "codesign.events.layers.layer.LayerState": "codesign.events.layers.comparators.LayerState",
    "codesign.events.layers.layer.PhysicalLayer": "codesign.events.layers.physical.PhysicalLayer",
    "codesign.events.layers.last_draw.LastDraw": "codesign.events.layers.comparators.LastDraw",
    "codesign.events.layers.positive.PositiveValues": "codesign.events.layers.layer.PositiveValues",
    "codesign.events.layers.settled.Settled": "codesign.events.layers.layer.Settled",
    "codesign.events.layers.hard.HardSensor": "codesign.events.layers.layer.HardSensor",
    "codesign.lens.plates.plate": "codesign.lens.diffraction.plates",
    "codesign.lens.wave.field": "codesign.lens.diffraction.field",
    "codesign.lens.analysis.pupil": "codesign.lens.diffraction.pupil",
    "codesign.lens.design.tolerance_errors": "codesign.lens.design.tolerance",
    "codesign.lens.design.tolerance_spot": "codesign.lens.design.tolerance",
}
CLOSE = {torch.float64: 1e-12, torch.float32: 2e-6}
WRONG_EACH = 4  # of an argument


def plain(value, depth=0):
    """Tensors, numbers and texts in a result, by their place in it."""
    if isinstance(value, torch.Tensor):
        return value.detach().clone() if not value.is_sparse and not value.is_meta else str(value.shape)
    if isinstance(value, np.ndarray):
        return torch.as_tensor(value) if value.dtype.kind in "fiub" else value.tolist()
    if value is None or isinstance(value, bool | int | float | str | Path):
        return str(value) if isinstance(value, Path) else value
    if depth > 4:
        return type(value).__name__
    if isinstance(value, dict):
        return {str(name): plain(each, depth + 1) for name, each in value.items()}
    if isinstance(value, tuple | list):
        return [plain(each, depth + 1) for each in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name), depth + 1) for f in dataclasses.fields(value)}
    if isinstance(value, torch.nn.Module):
        return {name: plain(each) for name, each in value.state_dict().items()}
    return type(value).__name__


def leaves(value):
    """All tensors in what ``plain`` gave."""
    if isinstance(value, torch.Tensor):
        return [value]
    if isinstance(value, dict):
        value = list(value.values())
    return [leaf for each in value for leaf in leaves(each)] if isinstance(value, list) else []


def outcome(call, args, kwargs):
    """What a call gives, in plain values: its value, or its error and sentence."""
    torch.manual_seed(0)
    try:
        result = call(*calls.copied(args), **calls.copied(kwargs))
        return {"value": plain(list(itertools.islice(result, 3)) if inspect.isgenerator(result) else result)}
    except Exception as error:  # noqa: BLE001 - any is an outcome
        return {"error": type(error).__name__, "sentence": re.sub(r"0x[0-9a-f]+", "", str(error)[:400])}


def slopes(call, args, kwargs):
    """Gradients of a fixed sum of all floating results to all floating tensors that were given; None without any."""

    def started(value):
        if isinstance(value, torch.Tensor) and value.is_floating_point():
            value = value.detach().clone().requires_grad_()
            starts.append(value)
            return value
        if type(value) in (tuple, list):
            return type(value)(started(each) for each in value)
        return value

    def ends(value, depth=0):
        if isinstance(value, torch.Tensor):
            return [value] if value.requires_grad and value.is_floating_point() else []
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            value = [getattr(value, f.name) for f in dataclasses.fields(value)]
        if isinstance(value, dict):
            value = list(value.values())
        return (
            [e for each in value for e in ends(each, depth + 1)]
            if isinstance(value, tuple | list) and depth < 4
            else []
        )

    starts = []
    torch.manual_seed(0)
    try:
        given = (
            started(calls.copied(args)),
            {name: started(each) for name, each in calls.copied(kwargs).items()},
        )
        results = ends(call(*given[0], **given[1]))
        total = sum((torch.linspace(1, 2, r.numel(), dtype=r.dtype) * r.reshape(-1)).sum() for r in results)
        if not results or not starts:
            return None
        return [
            None if g is None else g.detach() for g in torch.autograd.grad(total, starts, allow_unused=True)
        ]
    except Exception:  # noqa: BLE001 - the call itself is pinned elsewhere
        return None


class Recorder(calls.Calls):
    """Writes calls and their outcomes, a pickle each."""

    def __init__(self, folder, known):
        self.folder = Path(folder)
        super().__init__(self.folder / "journal", known)

    def _attack(self, name, call, args, kwargs):
        try:
            kept = pickle.dumps((args, kwargs))
            first = outcome(call, args, kwargs)
            if len(kept) > LARGEST:
                return
            told = {
                "name": name,
                "given": kept,
                "ended": first,
                "slopes": slopes(call, args, kwargs),
                "wrong": [],
            }
            given = inspect.signature(call).bind(*args, **kwargs)
            for argument, value in given.arguments.items():
                if argument != "self":
                    for label, wrong in calls.wrong_values(value)[:WRONG_EACH]:
                        again = inspect.BoundArguments(
                            given.signature, {**dict(given.arguments), argument: wrong}
                        )
                        told["wrong"].append((argument, label, outcome(call, again.args, again.kwargs)))
            if not same(outcome(call, args, kwargs), first):
                return  # it does not repeat itself
            number = len(list(self.folder.glob(f"{name}-*.pkl")))
            (self.folder / f"{name}-{number}.pkl").write_bytes(pickle.dumps(told))
            self.journal.write(json.dumps({"call": name}) + "\n")
        except Exception as error:  # noqa: BLE001 - what cannot be pickled cannot be pinned
            self.journal.write(json.dumps({"left": name, "why": str(error)[:100]}) + "\n")


def same(a, b):
    """Whether two outcomes agree: tensors to CLOSE, the rest exactly."""
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        if a.shape != b.shape or a.dtype != b.dtype:
            return False
        if not a.is_floating_point():
            return torch.equal(a, b)
        size = float(a[a.isfinite()].abs().max()) if a.isfinite().any() else 1.0
        return torch.allclose(a, b, rtol=0, atol=CLOSE.get(a.dtype, 1e-2) * max(size, 1e-300), equal_nan=True)
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return a == b or abs(a - b) <= 1e-12 * abs(a) or (a != a and b != b)
    return a == b


class _Unpickler(pickle.Unpickler):
    def find_class(self, module, name):
        module, name = renamed(f"{module}.{name}").rsplit(".", 1)
        return super().find_class(module, name)


def renamed(name):
    """What has that name now."""
    for old in sorted(RENAMED, key=len, reverse=True):
        if f"{name}.".startswith(f"{old}."):
            return RENAMED[old] + name[len(old) :]
    return name


def found(name):
    """The public function or method of that name, as it is called now."""
    room, *rest = renamed(name).split(".")
    value = importlib.import_module(f"codesign.{room}")
    for each in rest:
        value = getattr(value, each)
    return value


def replay(folder, prefix="", say=print):
    """Ask every recorded call again whose name starts so. Returns the number of those that differ."""
    counts = Counter()
    for path in sorted(Path(folder).glob(f"{prefix}*.pkl")):
        told = pickle.loads(path.read_bytes())
        try:
            call = found(told["name"])
            args, kwargs = _Unpickler(io.BytesIO(told["given"])).load()
        except Exception as error:  # noqa: BLE001 - a name that is gone is a difference
            say(f"{path.stem}: {error}")
            counts["gone"] += 1
            continue
        counts["values"] += 1
        now = outcome(call, args, kwargs)
        if not same(told["ended"], now):
            say(f"{path.stem}: another value {str(now)[:160]}")
            counts["other values"] += 1
        if told["slopes"] is not None:
            counts["gradients"] += 1
            if not same(told["slopes"], slopes(call, args, kwargs)):
                say(f"{path.stem}: another gradient")
                counts["other gradients"] += 1
        given = inspect.signature(call).bind(*args, **kwargs)
        for argument, label, before in told["wrong"]:
            wrong = dict(calls.wrong_values(given.arguments.get(argument)))[label]
            again = inspect.BoundArguments(given.signature, {**dict(given.arguments), argument: wrong})
            now = outcome(call, again.args, again.kwargs)
            counts["refusals"] += 1
            if isinstance(before, dict) and "sentence" in before:
                # it begins with the name of what was called
                before = {**before, "sentence": renamed(before["sentence"])}
            if not same(before, now):
                say(f"{path.stem}, {argument} {label}: {str(before)[:150]} -> {str(now)[:150]}")
                counts["other refusals"] += 1
    say(", ".join(f"{count} {what}" for what, count in sorted(counts.items())))
    return sum(count for what, count in counts.items() if what.startswith(("other", "gone")))


def record(folder, paths):
    """A process for every file of tests; each function is kept where it is met first."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    files = [
        str(f)
        for p in paths
        for f in ([Path(p)] if p.endswith(".py") else sorted(Path(p).rglob("test_*.py")))
    ]
    for file in files:
        if "/hostile/" in file or "/studies/" in file:
            continue
        known = {path.stem.rsplit("-", 1)[0] for path in Path(folder).glob("*.pkl")}
        command = [sys.executable, "-m", "tests.pins", "one", folder, file, *known]
        try:
            code = subprocess.run(command, capture_output=True, timeout=600, check=False).returncode
            if code not in (0, 5):
                print(f"{file}: its tests end with {code}")
        except subprocess.TimeoutExpired:
            print(f"{file}: 600 s are over")
        print(f"{file}: {len(list(Path(folder).glob('*.pkl')))} calls", flush=True)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    what, folder, *rest = sys.argv[1:]
    if what == "record":
        record(folder, rest or ["tests"])
    elif what == "replay":
        folder = Path(folder).resolve()
        with tempfile.TemporaryDirectory() as place, contextlib.chdir(place):
            sys.exit(min(replay(folder, *rest), 1))
    else:
        options = ["-q", "-p", "no:xdist", "-p", "no:cacheprovider", "-p", "no:unraisableexception"]
        sys.exit(pytest.main([rest[0], *options], plugins=[Recorder(folder, rest[1:])]))
