"""Event streams as NPZ: arrays t_us, x, y, p and the sensor size height_px, width_px."""

import zipfile

import numpy as np
import torch

from codesign.arrays import open_npz
from codesign.errors import CodesignError, FileFormatError
from codesign.events.stream import ordered

NAMES = ("t_us", "x", "y", "p", "height_px", "width_px")


def write_npz(path, stream):
    """Write events and sensor size to ``path``, compressed."""
    arrays = {name: np.asarray(torch.as_tensor(getattr(stream, name)).cpu()) for name in NAMES}
    for name in ("x", "y", "p"):  # a few bits each: narrow arrays pack faster
        arrays[name] = arrays[name].astype(np.min_scalar_type(-max(stream.height_px, stream.width_px) - 1))
    # what np.savez_compressed writes, at a level four times faster
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, values, allow_pickle=False)


def read_npz(path, height_px=None, width_px=None):
    """Read events from ``path``; a size given must be the one in the file.

    Raises: FileFormatError when the file is truncated, corrupt, not NPZ, lacks an array, or holds values that
      are no events.
    """
    with open_npz(path, f"an NPZ file of events has the arrays {', '.join(NAMES)}") as file:
        arrays = {name: file.read(name) for name in NAMES}
    for name, values in arrays.items():
        if values.dtype.kind not in "iu" or values.ndim != (0 if name.endswith("px") else 1):
            raise FileFormatError(
                f"{path}: array {name} is {values.dtype} {list(values.shape)}; whole numbers are needed, "
                "one size and lists of events."
            )
        if values.size and int(values.max()) >= 2**63:
            raise FileFormatError(
                f"{path}: array {name} reaches {int(values.max())}, beyond 64-bit signed integers."
            )
    size = int(arrays["height_px"]), int(arrays["width_px"])
    for given, found, name in ((height_px, size[0], "height_px"), (width_px, size[1], "width_px")):
        if given is not None and given != found:
            raise FileFormatError(
                f"{path} comes from a sensor with {name} {found}, but {given} was asked for."
            )
    t_us, x, y, p = (torch.from_numpy(arrays[name].astype(np.int64)) for name in NAMES[:4])
    if bool((t_us.diff() < 0).any()):
        at = int((t_us.diff() < 0).nonzero()[0]) + 1
        raise FileFormatError(f"{path}: event {at} lies before the one ahead of it; times must not go back.")
    try:
        return ordered(t_us, x, y, p, *size)
    except CodesignError as error:
        raise FileFormatError(f"{path}: {error}") from error
