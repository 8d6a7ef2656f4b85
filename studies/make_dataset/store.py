"""The files of a sequence: parts that are written one after the other, and what they are joined to
at the end.

A part holds what a chunk of frames gave, and the sensor's state behind it, and appears whole or not
at all; a run that was killed goes on behind the last one. Joined files depend on the parts alone,
so they are the same to the last bit however often the run was killed.
"""

import hashlib
import io
import itertools
import json
import shutil
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from codesign.atomic import replacing, write_atomic
from codesign.events import SensorState
from codesign.events.formats.hdf5_rows import h5py, new_hdf5
from codesign.reading import check_regular, reading
from codesign.types import EventStream

PARTS = "parts"
DONE = "sequence.json"
PACKED = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
EVENT_TYPES = {"x": np.uint16, "y": np.uint16, "p": np.uint8, "t": np.uint32}
FRAME_TYPES = {
    "frames": np.float32,
    "depth": np.float32,
    "object_id": np.int16,
    "segment_id": np.int16,
    "flow": np.float32,
    "valid": np.bool_,
    "occluded": np.bool_,
}
MOST_EVENTS_AT_ONCE = 4_000_000


def h5(file, mode="r") -> Any:
    """An open HDF5 file; its types are known at run time only."""
    return h5py.File(file, mode)


def part_path(folder: Path, index: int):
    return folder / PARTS / f"{index:06d}.h5"


def write_part(
    path: Path,
    arrays: dict[str, torch.Tensor],
    events: EventStream,
    state: SensorState,
):
    """Store arrays per frame (named as in FRAME_TYPES), events, and the sensor's state after
    them."""
    content = io.BytesIO()
    generator = state.generator or torch.Generator()
    with h5(content, "w") as file:
        for name, kind in FRAME_TYPES.items():
            file[name] = arrays[name].cpu().numpy().astype(kind)
        for name, values in (
            ("x", events.x),
            ("y", events.y),
            ("p", events.p > 0),
            ("t", events.t_us),
        ):
            file[name] = values.cpu().numpy().astype(EVENT_TYPES[name])
        for name, tensor in state.tensors().items():
            file[f"state/{name}"] = tensor.contiguous().cpu().numpy()
        file["state/generator"] = generator.get_state().cpu().numpy()
        file["state/start_s"], file["state/time_s"] = state.start_s, state.time_s
    write_atomic(path, content.getvalue())


def read_state(path: Path, device: torch.device | str = "cpu"):
    """The sensor's state that a part ends with, on a device. Raises: FileFormatError when the part is
    damaged."""
    with (
        reading(f"'{path}'", "remove it and go on again with --resume"),
        h5(check_regular(path)) as file,
    ):
        stored = {name: values[()] for name, values in file["state"].items()}
        start_s, time_s = (float(stored.pop(name)) for name in ("start_s", "time_s"))
        generator = torch.Generator()
        generator.set_state(torch.from_numpy(stored.pop("generator")))
        return SensorState(
            **{name: torch.from_numpy(values).to(device) for name, values in stored.items()},
            start_s=start_s,
            time_s=time_s,
            generator=generator,
        )


def parts_done(folder: Path):
    """Number of parts there are without a gap."""
    return next(k for k in itertools.count() if not part_path(folder, k).exists())


def join(folder: Path, count: int, t_s, extra: dict[str, np.ndarray]):
    """Write events.h5 and frames.h5 of a sequence from its parts, chunk by chunk.

    Args:
      count: number of parts.
      t_s: [T] frame times.
      extra: further arrays for frames.h5 (poses, ...).
    """
    times_us = np.rint(np.asarray(t_s) * 1e6).astype(np.int64)
    with _whole(folder / "frames.h5") as file:
        for name, values in {"timestamps": times_us, "t_s": np.asarray(t_s), **extra}.items():
            file[name] = values
        _collect(file, folder, count, FRAME_TYPES, lambda shape: (1, *shape[1:]))
    with _whole(folder / "events.h5") as file:
        group = file.create_group("events")
        _collect(group, folder, count, EVENT_TYPES, lambda shape: (65536,))
        file["t_offset"] = np.int64(0)
        file["ms_to_idx"] = _starts(group["t"], int(times_us[-1]) // 1000 + 2)


def finish(folder: Path, facts: dict):
    """Write the file that says a sequence is complete, and remove its parts."""
    write_atomic(folder / DONE, json.dumps(facts, indent=2, allow_nan=False).encode())
    shutil.rmtree(folder / PARTS, ignore_errors=True)


def is_done(folder: Path):
    """Whether a sequence is complete; parts that a killed run left beside are removed."""
    if not (folder / DONE).exists():
        return False
    shutil.rmtree(folder / PARTS, ignore_errors=True)
    return True


def manifest(root: Path, sequences):
    """Text of the manifest: SHA-256 and size of every file of the sequences, in order of their
    names."""
    files = sorted(
        path for name in sequences for path in (root / name).rglob("*") if path.is_file()
    )
    entries = {
        path.relative_to(root).as_posix(): {"sha256": _sha256(path), "bytes": path.stat().st_size}
        for path in files
    }
    return json.dumps(
        {"format": "codesign-dataset/1", "sequences": list(sequences), "files": entries}, indent=1
    )


@contextmanager
def _whole(path):
    """An HDF5 file that takes its name when it is complete."""
    with replacing(path) as temporary, new_hdf5(temporary) as file:
        yield file


def _collect(target, folder, count, kinds, chunk_of):
    for index in range(count):
        with h5(part_path(folder, index)) as part:
            for name, kind in kinds.items():
                values = part[name][()]
                if name not in target:
                    target.create_dataset(
                        name,
                        (0, *values.shape[1:]),
                        kind,
                        maxshape=(None, *values.shape[1:]),
                        chunks=chunk_of(values.shape),
                        **PACKED,
                    )
                held = target[name].shape[0]
                target[name].resize(held + len(values), 0)
                target[name][held:] = values


def _starts(t_us, count):
    """ms_to_idx [count]: index of the first event at or after each millisecond."""
    found = np.zeros(count, np.uint64)
    edges = np.arange(count) * 1000
    for start in range(0, len(t_us), MOST_EVENTS_AT_ONCE):
        found += np.searchsorted(t_us[start : start + MOST_EVENTS_AT_ONCE], edges, "left").astype(
            np.uint64
        )
    return found


def _sha256(path):
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
