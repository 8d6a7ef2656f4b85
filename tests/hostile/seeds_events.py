"""Small whole files of every format of events and frames, and who reads each."""

import io
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import torch

from codesign import events
from codesign.events.stream import ordered

Seed = tuple[Callable[[], bytes], Callable[[Path], object]]
SIZE = (260, 346)
CIH = "#Camera\r\nRecord Rate(fps) : 1000\r\nTotal Frame : 3\r\nImage Width : 8\r\nImage Height : 6\r\nColor Bit : 8\r\n"


def stream(count=120):
    dice = torch.Generator().manual_seed(1)
    t_us = torch.randint(0, 20_000, (count,), generator=dice)
    x, y, p = (torch.randint(0, high, (count,), generator=dice) for high in (SIZE[1], SIZE[0], 2))
    return ordered(t_us, x, y, 2 * p - 1, *SIZE)


def made(name: str, write: Callable[[Path], object]) -> Callable[[], bytes]:
    """The file of a name that ``write`` leaves in a folder."""

    def content():
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder))
            return next(Path(folder).rglob(name)).read_bytes()

    return content


def buffered(write: Callable[[io.BytesIO], object]) -> Callable[[], bytes]:
    """What ``write`` puts into a file."""

    def content():
        buffer = io.BytesIO()
        write(buffer)
        return buffer.getvalue()

    return content


def written(suffix: str, **options) -> Callable[[], bytes]:
    """A file that ``events.write`` makes."""
    name = f"events{suffix}"
    return made(name, lambda folder: events.write(folder / name, stream(), **options))


def h5(fill: Callable[[Any], object]) -> Callable[[], bytes]:
    """An HDF5 file that ``fill`` is given open."""

    def write(buffer):
        import h5py

        with h5py.File(buffer, "w") as file:
            fill(file)

    return buffered(write)


def dsec(packing=None) -> Callable[[], bytes]:
    """HDF5 without checksums, as published files are."""

    def fill(file):
        import hdf5plugin

        blosc = dict(hdf5plugin.Blosc(cname="zstd", clevel=1))
        options = {"blosc": blosc, "gzip": {"compression": "gzip"}}.get(packing, {})
        for name, values in zip("txyp", rows("txyp", False).T, strict=True):
            data = values.astype(np.uint32)
            file.create_dataset(f"events/{name}", data=data, chunks=(64,), **options)
        file["t_offset"] = 0

    return h5(fill)


def rows(order: str, seconds: bool) -> np.ndarray:
    """[N, 4] events, the columns in this order; times in seconds, or all whole numbers."""
    given = stream()
    t = given.t_us * 1e-6 if seconds else given.t_us
    columns = {"t": t, "x": given.x, "y": given.y, "p": given.p > 0}
    return np.stack([columns[letter].numpy() for letter in order], 1)


def hdf5(name: str, order: str, seconds: bool) -> Callable[[], bytes]:
    """A file of v2e's or MVSEC's layout."""

    def fill(file):
        data = rows(order, seconds) if seconds else rows(order, seconds).astype(np.uint32)
        file.create_dataset(name, data=data, compression="gzip", chunks=(50, 4))
        file["davis/left/image_raw" if seconds else "frame"] = np.zeros((1, *SIZE), np.uint8)

    return h5(fill)


def text(order: str, form: str, head: str = "") -> Callable[[], bytes]:
    """Lines of four numbers, as other programs write them."""
    lines = (
        form.format(**dict(zip(order, row, strict=True))) for row in rows(order, True).tolist()
    )
    return (head + "".join(lines)).encode


def arrays(packed: bool, **values) -> Callable[[], bytes]:
    """An .npz of arrays, or an .npy of the one called ``only``."""
    save = np.savez_compressed if packed else np.savez
    if "only" in values:
        return buffered(lambda buffer: np.save(buffer, values["only"]))
    return buffered(lambda buffer: save(buffer, **values))


def picture(kind: str, dtype=np.uint8, colour=True, **options) -> Callable[[], bytes]:
    """A picture that Pillow or tifffile writes."""

    pixels = np.arange(9 * 12 * 3).reshape(9, 12, 3)[..., : 3 if colour else 1].squeeze()

    def write(buffer):
        if kind == "TIFF":
            import tifffile

            light = "rgb" if colour else "minisblack"
            tifffile.imwrite(buffer, (pixels * 150).astype(dtype), photometric=light, **options)
        else:
            PIL.Image.fromarray(pixels.astype(dtype)).save(buffer, kind, **options)

    return buffered(write)


def frames(path: Path):
    """All frames and times of a source, read to its end."""
    if path.suffix == ".mraw":
        path.with_suffix(".cih").write_text(CIH)
    elif path.suffix == ".cih":
        path.with_suffix(".mraw").write_bytes(bytes(range(144)))
        path = path.with_suffix(".mraw")
    source = events.open_frames(path)
    shapes = {frame.shape for frame in source.read(0)}
    return [source.t_s, source.white, source.count, len(shapes)]


def folder_frames(path: Path):
    """A picture as the second of a folder of two alike."""
    from codesign.events.sources.folder import read_picture

    return read_picture(path)


XYTP = "{x:.0f},{y:.0f},{t:.6f},{p:.0f}\n"
STACK = np.arange(4 * 6 * 8).reshape(4, 6, 8)
SEEDS: dict[str, Seed] = {
    "dsec.h5": (written(".h5"), events.read),
    "gzip.h5": (dsec("gzip"), events.read),
    "blosc.h5": (dsec("blosc"), events.read),
    "plain.h5": (dsec(), events.read),
    "v2e.h5": (hdf5("events", "txyp", False), events.read),
    "mvsec.hdf5": (hdf5("davis/left/events", "xytp", True), events.read),
    "ecd.txt": (text("txyp", "{t:.9f} {x:.0f} {y:.0f} {p:.0f}\n"), events.read),
    "headed.txt": (text("xytp", XYTP, "346 260\nx,y,t_s,p\n"), events.read),
    "xytp.csv": (text("xytp", XYTP), events.read),
    "rows.npy": (arrays(False, only=rows("txyp", True)), events.read),
    "names.npz": (
        arrays(True, **dict(zip("xytp", rows("xytp", True).T, strict=True))),
        events.read,
    ),
    "events.aedat4": (written(".aedat4"), events.read),
    "evt3.raw": (written(".raw", evt=3), events.read),
    "evt2.raw": (written(".raw", evt=2), events.read),
    "events.dat": (written(".dat"), events.read),
    "events.csv": (written(".csv"), events.read),
    "events.npz": (written(".npz"), events.read),
    "stack.npy": (arrays(False, only=STACK.astype(np.uint8)), frames),
    "stack.npz": (arrays(True, frames=STACK.astype(np.float32), t_s=np.arange(4.0)), frames),
    "camera.mraw": (lambda: bytes(range(144)), frames),
    "camera.cih": (CIH.encode, frames),
    "frame.png": (picture("PNG"), folder_frames),
    "frame.jpg": (picture("JPEG"), folder_frames),
    "frame.bmp": (picture("BMP"), folder_frames),
    "frame.tif": (picture("TIFF", np.uint16), folder_frames),
    "packed.tif": (picture("TIFF", np.uint16, compression="zlib", rowsperstrip=2), folder_frames),
    "gray.tif": (picture("TIFF", np.uint8, colour=False), folder_frames),
}
