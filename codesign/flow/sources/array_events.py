"""Events as NumPy arrays by their usual names: .npz of t, x, y, p, or .npy of rows t x y p."""

import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from codesign import events
from codesign.errors import FileFormatError
from codesign.flow.checks import check_path
from codesign.flow.sources.columns import (
    BACKWARDS,
    LIMIT_PX,
    OFF_SENSOR,
    EventColumns,
    from_stream,
    on_sensor,
    settled_size,
)
from codesign.flow.sources.text_events import UNITS_US

NAMES = {
    "t": ("t", "ts", "timestamps", "timestamp"),
    "x": ("x", "xs"),
    "y": ("y", "ys"),
    "p": ("p", "ps", "pol", "polarity"),
}


def read_array_events(
    path: str | Path, size: tuple[int, int] | None = None, time_unit: str = "auto", skip: Collection[str] = ()
) -> EventColumns:
    """Read events from .npz or .npy.

    Args: size: (height, width) of the sensor, or None. time_unit: as for text; "auto": seconds where a time
      has a fraction, else microseconds. skip: faults whose events are left out and counted, as for text.
    Returns: EventColumns. The package's own .npz (t_us, x, y, p, height_px, width_px) is read by events.read.
    Raises: FileFormatError for other contents, with the first wrong event.
    """
    path = check_path(path)
    try:
        with path.open("rb") as file:
            loaded: Any = np.load(file, allow_pickle=False)
            table: dict[str, np.ndarray] = {}
            if isinstance(loaded, np.lib.npyio.NpzFile):
                names = set(loaded.files)
                if "t_us" not in names:
                    keys = {
                        key: next((name for name in options if name in names), None)
                        for key, options in NAMES.items()
                    }
                    table |= {key: loaded[name] for key, name in keys.items() if name is not None}
                    frames = loaded["frames"].shape if "frames" in names else ()
            else:
                names = set()
                frames = ()
                rows = loaded if loaded.ndim == 2 and loaded.shape[1] == 4 else np.empty((0, 4))
                table |= {key: rows[:, k] for k, key in enumerate("txyp") if len(rows)}
    except (
        OSError,
        ValueError,
        KeyError,
        EOFError,
        MemoryError,
        zipfile.BadZipFile,
        NotImplementedError,
    ) as error:
        raise FileFormatError(f"{path} is not a readable file of arrays ({error}).") from error
    if "t_us" in names:
        return from_stream(
            events.read(path, **({} if size is None else {"height_px": size[0], "width_px": size[1]}))
        )
    if (
        len(table) != 4
        or any(
            values.ndim != 1 or values.dtype.kind not in "iufb" or len(values) != len(table["t"])
            for values in table.values()
        )
        or not len(table["t"])
    ):
        raise FileFormatError(
            f"{path} holds no events: four lists t, x, y, p of equal length (.npz), or rows of four numbers "
            "t x y p (.npy), are needed."
        )
    told = tuple(frames[1:]) if len(frames) == 3 else None
    return _columns(path, table, size, told, time_unit, skip)


def _columns(path, table, size, told, time_unit, skip):
    t, x, y, p = (table[key].astype(np.float64) for key in "txyp")
    unit = time_unit if time_unit != "auto" else "s" if bool((t % 1 != 0).any()) else "us"
    t_us = (
        table["t"].astype(np.int64)
        if unit == "us" and table["t"].dtype.kind in "iu"
        else np.rint(t * UNITS_US[unit])
    )
    left_out = dict.fromkeys(skip, 0)
    kept = np.ones(len(t_us), bool)
    for fault, bad, reason in (
        ("", ~np.isfinite(t), "its time is not finite"),
        (BACKWARDS, t_us < np.maximum.accumulate(t_us), "it lies before one ahead of it"),
        (
            OFF_SENSOR,
            ~((x % 1 == 0) & (y % 1 == 0) & (x >= 0) & (y >= 0) & (x < LIMIT_PX) & (y < LIMIT_PX)),
            "its pixel is no pair of whole numbers from 0 on",
        ),
        ("", ~((p == 0) | (p == 1) | (p == -1)), "its polarity is not 1 or 0 (or +1 and -1)"),
    ):
        bad = bad & kept
        if fault in left_out:
            left_out[fault] += int(bad.sum())
            kept &= ~bad
        elif bool(bad.any()):
            raise FileFormatError(f"{path}: event {int(np.argmax(bad))}: {reason}.")
    t_us, x, y, p = (values[kept] for values in (t_us, x, y, p))
    narrow = np.asarray(t_us, np.int64), x.astype(np.int16), y.astype(np.int16), p > 0
    settled = settled_size(path, *narrow[1:3], size, told, "its frames")
    return on_sensor(path, narrow, settled, skip, left_out)
