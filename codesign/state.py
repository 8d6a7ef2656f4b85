"""The state of an unfinished run: exact tensors and numbers in one file that holds data only, never
code."""

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.arrays import read_npz
from codesign.atomic import write_atomic
from codesign.doors import explain
from codesign.errors import ShapeError
from codesign.reading import reading


@dataclass(frozen=True)
class State:
    """What ``write_state`` stored: tensors on the CPU, bit for bit, and a dictionary of plain JSON
    values."""

    tensors: dict[str, Tensor]
    numbers: dict[str, Any]


def write_state(path: Path, tensors: dict[str, Tensor], numbers: dict[str, Any]) -> None:
    """Store tensors (any real, complex, integer or bool dtype numpy knows; a generator's state is
    one of uint8) and plain numbers.

    Raises: ShapeError for a dtype the file cannot hold; FileFormatError when it cannot be written.
    """
    arrays = {}
    for index, (name, tensor) in enumerate(tensors.items()):
        try:
            arrays[f"tensor_{index}"] = tensor.detach().cpu().numpy()
        except TypeError as error:
            raise ShapeError(
                f"state tensor '{name}' has dtype {tensor.dtype}, which the state file cannot hold; convert "
                "it to float32 or float64."
            ) from error
    header = json.dumps({"names": list(tensors), "numbers": numbers}).encode()
    buffer = io.BytesIO()
    np.savez(buffer, header=np.frombuffer(header, dtype=np.uint8), **arrays)
    write_atomic(path, buffer.getvalue())


def read_state(path: Path) -> State | None:
    """Read what ``write_state`` stored; None when there is no such file.

    Raises: FileFormatError when the file is not a state file.
    """
    if not path.exists():
        return None
    remedy = "it is not a state file of a run; remove it to start from the beginning"
    stored = read_npz(path, remedy)
    with reading(path, remedy):
        header = json.loads(stored["header"].tobytes())
        names, numbers = list(header["names"]), dict(header["numbers"])
        return State(
            {
                str(name): torch.from_numpy(stored[f"tensor_{index}"])
                for index, name in enumerate(names)
            },
            numbers,
        )


explain(globals())
