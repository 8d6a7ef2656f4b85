"""Events as NumPy arrays: .npz of t_us, x, y, p and the sensor size height_px, width_px (written,
and read by other usual names too), or .npy of rows t x y p or x y t p."""

import zipfile

import numpy as np
import torch

from codesign.arrays import open_npz, read_npy
from codesign.errors import FileFormatError
from codesign.events.formats.arrival import (
    NAMES,
    Arrival,
    check_nothing_told,
    microseconds,
    settled_order,
    settled_unit,
)

OWN = ("t_us", "x", "y", "p", "height_px", "width_px")
SIZE = ("height_px", "width_px")


def write_npz(path, stream):
    """Write events and sensor size to ``path``, compressed."""
    arrays = {name: np.asarray(torch.as_tensor(getattr(stream, name)).cpu()) for name in OWN}
    for name in ("x", "y", "p"):  # a few bits each: narrow arrays pack faster
        arrays[name] = arrays[name].astype(
            np.min_scalar_type(-max(stream.height_px, stream.width_px) - 1)
        )
    # what np.savez_compressed writes, at a level four times faster
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, values, allow_pickle=False)


def read_arrays(path, asked):
    """EventColumns of ``path``; the sensor size is the file's, or that of ``frames`` [T, H, W]
    beside the events.

    Raises: FileFormatError when the file is truncated, corrupt, of another kind, lacks an array,
      and what tables and arrival refuse.
    """
    size, size_from, name = None, "the file", ""
    if path.suffix.lower() == ".npy":
        table = read_npy(path)
        if table.ndim != 2 or table.shape[1] != 4 or table.dtype.kind not in "iuf":
            raise FileFormatError(
                f"{path} holds {table.dtype} {list(table.shape)}; rows t x y p are needed."
            )
        order = settled_order(path, table, asked.columns)
        found = [table[:, order.index(letter)] for letter in "txyp"]
    else:
        check_nothing_told(path, asked, "for files of rows", "columns")
        with open_npz(path, f"an NPZ file of events has the arrays {', '.join(OWN)}") as file:
            names = [
                next((name for name in NAMES[key] if name in file), NAMES[key][0]) for key in "txyp"
            ]
            found = [file.read(name) for name in names]
            name = names[0]
            size = [_side(path, file.read(side), side) for side in SIZE if side in file]
            if "frames" in file and len(shape := file.header("frames").shape) == 3 and not size:
                size, size_from = shape[1:], "its frames"
        kinds = [f"{values.dtype} {list(values.shape)}" for values in found]
        if any(
            values.dtype.kind not in "iufb" or values.shape != (found[0].size,) for values in found
        ):
            raise FileFormatError(
                f"{path}: {', '.join(names)} are {kinds}; four lists of equal length are needed."
            )
    t, x, y, p = found
    arrival = Arrival(path, asked, size if size and len(size) == 2 else None, size_from)
    arrival.add(microseconds(t, settled_unit(t, asked.time_unit, name)), x, y, p)
    return arrival.columns()


def _side(path, value, name):
    if value.dtype.kind not in "iu" or value.ndim or not 1 <= int(value) < 2**31:
        raise FileFormatError(
            f"{path}: {name} is {value.dtype} {list(value.shape)}; a size in pixels is needed."
        )
    return int(value)
