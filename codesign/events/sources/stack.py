"""Frames of a NumPy file, read one by one: .npy is mapped, .npz is unpacked as it goes."""

import zipfile
import zlib

import numpy as np
import torch
from numpy.lib import format as npy

from codesign.errors import FileFormatError
from codesign.events.sources.frames import FrameSource, same_size

BROKEN = (
    ValueError,
    OSError,
    EOFError,
    KeyError,
    NotImplementedError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
    TypeError,
    SyntaxError,
)


def open_stack(path):
    """Open a stack [T, H, W] or [T, H, W, 3] of uint8, uint16, float32 or float64 in a .npy or .npz file.

    Raises: FileFormatError when the file is damaged, or holds no such array, several without one called
      ``frames``, or times of another length.
    """
    try:
        if path.suffix.lower() == ".npy":
            stack = np.load(path, mmap_mode="r", allow_pickle=False)
            shape = stack.shape
            kind = stack.dtype
            name = ""
            t_s = None
            clock = ""
        else:
            stack, (name, shape, kind, t_s, clock) = None, _look(path)
    except FileFormatError:
        raise
    except BROKEN as error:
        raise FileFormatError(
            f"{path} is not a NumPy file of plain numbers ({error}); is it whole?"
        ) from error
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
            (np.array(frame) for frame in stack[start:]) if stack is not None else _unpack(path, name, start)
        )
        yield from same_size(enumerate(frames, start), path, tuple(shape[1:]), shape[0])

    white = 65535.0 if kind.itemsize == 2 else 255.0
    return FrameSource(
        path, shape[0], shape[1], shape[2], white, None if t_s is None else torch.from_numpy(t_s), clock, read
    )


def _look(path):
    """Name, shape and type of the frames in an archive, and times when it has them; only headers and times
    are read."""
    with open(path, "rb") as opened, zipfile.ZipFile(opened) as archive:
        members = {name.removesuffix(".npy"): name for name in archive.namelist()}
        heads = {key: _head(archive, name) for key, name in members.items()}
        stacks = [key for key, (shape, _, _) in heads.items() if len(shape) in (3, 4)]
        chosen = "frames" if "frames" in stacks else stacks[0] if len(stacks) == 1 else None
        if chosen is None:
            raise FileFormatError(
                f"{path} holds the arrays {', '.join(heads) or 'none'}; one stack of frames, or one called "
                "frames, is needed."
            )
        shape, kind, by_columns = heads[chosen]
        if by_columns:
            raise FileFormatError(
                f"{path}: array {chosen} is stored column by column and cannot be read frame by frame; save "
                "np.ascontiguousarray of it."
            )
        t_s = None
        clock = ""
        for key, factor in (("t_s", 1.0), ("t_us", 1e6)):
            if key in members and t_s is None:
                with archive.open(members[key]) as file:
                    t_s = npy.read_array(file, allow_pickle=False).astype(np.float64) / factor
                    clock = f"array {key} of the file"
        return members[chosen], shape, kind, t_s, clock


def _head(archive, name):
    with archive.open(name) as file:
        version = npy.read_magic(file)
        shape, by_columns, kind = (
            npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        )(file)
        return shape, kind, by_columns


def _unpack(path, name, start):
    """Frames of a member of an archive, one after the other."""
    try:
        with open(path, "rb") as opened, zipfile.ZipFile(opened) as archive, archive.open(name) as file:
            version = npy.read_magic(file)
            shape, _, kind = (npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(
                file
            )
            size = int(np.prod(shape[1:])) * kind.itemsize
            for index in range(shape[0]):
                data = file.read(size)
                if len(data) < size:
                    return
                if index >= start:
                    yield np.frombuffer(data, kind).reshape(shape[1:])
    except BROKEN as error:
        raise FileFormatError(f"{path} is damaged ({error}); use a whole copy.") from error
