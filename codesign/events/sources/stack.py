"""Frames of a NumPy file, read one by one: .npy is mapped, .npz is unpacked as it goes."""

import numpy as np
import torch

from codesign.arrays import open_npz, read_npy
from codesign.errors import FileFormatError
from codesign.events.sources.frames import FrameSource, same_size

TIMES = {"t_s": 1.0, "t_us": 1e6}  # name -> in a second


def open_stack(path):
    """Open a stack [T, H, W] or [T, H, W, 3] of uint8, uint16, float32 or float64 in a .npy or .npz
    file.

    Raises: FileFormatError when the file is damaged, or holds no such array, several without one
      called ``frames``, or times of another length.
    """
    if path.suffix.lower() == ".npy":
        stack = read_npy(path, mapped=True)
        name, shape, kind, t_s, clock = "", stack.shape, stack.dtype, None, ""
    else:
        stack, (name, shape, kind, t_s, clock) = None, _look(path)
    pictures = len(shape) == 3 or (len(shape) == 4 and shape[3] == 3)
    if (
        not pictures
        or shape[0] < 2
        or 0 in shape
        or kind.newbyteorder("=") not in (np.uint8, np.uint16, np.float32, np.float64)
    ):
        raise FileFormatError(
            f"{path} holds {kind} {list(shape)}; at least two frames, [T, H, W] or [T, H, W, 3] of uint8, "
            "uint16, float32 or float64, are needed."
        )
    if t_s is not None and t_s.shape != (shape[0],):
        raise FileFormatError(
            f"{path} holds {shape[0]} frames but times of shape {list(t_s.shape)}; one time per frame is "
            "needed."
        )

    def read(start):
        frames = (
            (np.array(frame) for frame in stack[start:])
            if stack is not None
            else _unpack(path, name, start)
        )
        yield from same_size(enumerate(frames, start), path, tuple(shape[1:]), shape[0])

    white = 65535.0 if kind.itemsize == 2 else 255.0
    return FrameSource(
        path,
        shape[0],
        shape[1],
        shape[2],
        white,
        None if t_s is None else torch.from_numpy(t_s),
        clock,
        read,
    )


def _look(path):
    """Name, shape and type of the frames in an archive, and times when it has them; only headers
    and times are read."""
    with open_npz(path) as archive:
        heads = {name: archive.header(name) for name in archive.names}
        stacks = [name for name, head in heads.items() if len(head.shape) in (3, 4)]
        chosen = "frames" if "frames" in stacks else stacks[0] if len(stacks) == 1 else None
        if chosen is None:
            raise FileFormatError(
                f"{path} holds the arrays {', '.join(heads) or 'none'}; one stack of frames, or one called "
                "frames, is needed."
            )
        if heads[chosen].by_columns:
            raise FileFormatError(
                f"{path}: array {chosen} is stored column by column and cannot be read frame by frame; save "
                "np.ascontiguousarray of it."
            )
        t_s = None
        clock = ""
        key = next((key for key in TIMES if key in archive), None)
        if key is not None:
            if heads[key].dtype.kind not in "fiu":
                raise FileFormatError(
                    f"{path}: the times {key} are {heads[key].dtype}; numbers are needed."
                )
            t_s = archive.read(key).astype(np.float64) / TIMES[key]
            if not np.isfinite(t_s).all():
                raise FileFormatError(
                    f"{path}: the times {key} are NaN or infinite; give one for every frame."
                )
            clock = f"array {key} of the file"
        return chosen, heads[chosen].shape, heads[chosen].dtype, t_s, clock


def _unpack(path, name, start):
    """Frames of a member of an archive, one after the other."""
    with open_npz(path) as archive:
        for index, frame in enumerate(archive.rows(name)):
            if index >= start:
                yield frame
