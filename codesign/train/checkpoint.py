"""The state of a training on disk: tensors in safetensors, numbers in JSON, kept so that a resumed
run gives the same numbers bit for bit."""

import contextlib
import json
from pathlib import Path
from typing import Any

import torch

from codesign.atomic import write_atomic
from codesign.errors import FileFormatError
from codesign.flow import checkpoint
from codesign.reading import read_json, reading
from codesign.train.learner import Learner
from codesign.train.loop import Progress

VERSION = 2
CURVES = ("loss", "norm", "rate")
NUMBERS = ("step", "data_s", "training_s", "validation_s", "clipped", "blind", "validation")


def save(folder: Path, learner: Learner, progress: Progress, facts: dict[str, Any]) -> None:
    """Write a checkpoint: tensors under a new name first, then checkpoint.json, which names them; a
    run cut short in between keeps the earlier one.

    Args:
      facts: plain values that say what the run is (network, seed, schedule, versions).
    Raises: CodesignError when the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileFormatError(
            f"cannot make the folder '{folder}' ({error.strerror}); choose another."
        ) from error
    curves = {
        f"curve/{name}": torch.tensor(getattr(progress, name), dtype=torch.float64)
        for name in CURVES
    }
    file = f"step_{progress.step:07d}.safetensors"
    checkpoint.write_tensors(
        folder / file,
        {**learner.state_dict(), **curves},
        {"kind": "training", "step": progress.step},
    )
    numbers = {name: getattr(progress, name) for name in NUMBERS}
    stored = {"version": VERSION, "tensors": file, "progress": numbers, **facts}
    write_atomic(folder / "checkpoint.json", json.dumps(stored, indent=2, allow_nan=False).encode())
    for old in folder.glob("step_*.safetensors"):
        if old.name != file:
            with contextlib.suppress(OSError):  # a file too many does no harm
                old.unlink()


def load(folder: Path, learner: Learner, facts: dict[str, Any]) -> Progress | None:
    """Fill ``learner`` from a checkpoint; returns its Progress, or None when the folder has none.

    Raises: FileFormatError when it is damaged, of another version, of another network, or of a run
      with other facts.
    """
    path = folder / "checkpoint.json"
    if not path.exists():
        return None
    stored = read_json(path)
    with reading(f"'{path}'", "start a new run"):
        version = stored["version"]
        file = str(stored["tensors"])
    if version != VERSION:
        raise FileFormatError(
            f"'{path}' has format version {version}, this codesign reads version {VERSION}; go on with the "
            "codesign that wrote it, or start a new run."
        )
    stored.setdefault("functions", facts.get("functions"))  # runs begun earlier lack it
    _check_facts(path, stored, json.loads(json.dumps(facts)))
    if Path(file).name != file or len(file) > 100:
        raise FileFormatError(
            f"'{path}' names a file outside its folder ('{file[:100]}'); start a new run."
        )
    tensors, content = checkpoint.read_tensors(folder / file)
    with reading(f"'{path}'", "start a new run"):
        numbers = {name: stored["progress"][name] for name in NUMBERS}
        wrong = [
            name
            for name, value in numbers.items()
            if name != "validation"
            and (isinstance(value, bool) or not isinstance(value, int | float))
        ]
        if wrong or not isinstance(numbers["validation"], list):
            raise FileFormatError(
                f"'{path}' is damaged ({', '.join(wrong or ['validation'])}); start a new run."
            )
        progress = Progress(**numbers)
        curves = {name: tensors.pop(f"curve/{name}").tolist() for name in CURVES}
    if content.get("step") != progress.step:
        raise FileFormatError(f"'{path}' and '{file}' are of different steps; start a new run.")
    learner.load_state_dict(tensors, folder / file)
    progress.loss = curves["loss"]
    progress.norm = curves["norm"]
    progress.rate = curves["rate"]
    return progress


def _check_facts(path, stored, facts):
    for name, value in facts.items():
        earlier = stored.get(name)
        if earlier == value:
            continue
        if isinstance(earlier, dict) and isinstance(value, dict):
            name = next(key for key in {**earlier, **value} if earlier.get(key) != value.get(key))
            earlier = earlier.get(name)
            value = value.get(name)
        raise FileFormatError(
            f"'{path}' was written with {name} {earlier}, this run has {value}; start a new run."
        )
