"""Frames of a folder of pictures, in natural order of their names."""

import contextlib
import io
import re

import numpy as np
import PIL.Image

from codesign.errors import FileFormatError
from codesign.events.sources.frames import PICTURES, FrameSource, same_size
from codesign.optional import optional
from codesign.reading import check_room, read_bytes, reading

iio = optional("imageio.v3", "video", "reading pictures")

tifffile = optional("tifffile", "video", "reading TIFF")

PACKINGS = (1, 5, 8, 32773, 32946)  # none, LZW, zlib, PackBits
WHITE_IS_ZERO, BLACK_IS_ZERO, RGB, PALETTE = range(4)  # as the tag counts kinds of pixels
MOST_BYTES = 2**30
MOST_RATIO = 1040  # at most 1032 to 1


def open_folder(folder):
    """Open a folder: every PNG, JPEG, TIFF or BMP in it is a frame; other files and folders are
    left alone.

    Raises: FileFormatError for fewer than two pictures, and for a first one that cannot be read.
    """
    paths = sorted(
        (
            path
            for path in folder.iterdir()
            if path.suffix.lower() in PICTURES and not path.name.startswith(".")
        ),
        key=natural,
    )
    if len(paths) < 2:
        raise FileFormatError(
            f"the folder {folder} holds {len(paths)} picture(s) ({', '.join(PICTURES)}); events need at "
            "least two."
        )
    kinds = sorted({path.suffix.lower() for path in paths})
    if len(kinds) > 1:
        raise FileFormatError(
            f"the folder {folder} holds pictures of several kinds ({', '.join(kinds)}), whose order is not "
            "clear; leave one kind in it."
        )
    first = read_picture(paths[0])
    height, width = first.shape[:2]

    def read(start):
        yield from same_size(
            ((index, _alike(path, first)) for index, path in enumerate(paths[start:], start)),
            folder,
            first.shape,
            len(paths),
        )

    return FrameSource(
        folder,
        len(paths),
        height,
        width,
        255.0 if first.dtype == np.uint8 else 65535.0,
        None,
        "",
        read,
    )


def natural(path):
    """Sort key of a file name that puts frame 2 before frame 10."""
    return [
        (int(part), "") if part.isdecimal() else (-1, part.lower())
        for part in re.split(r"([0-9]+)", path.stem)
    ], path.name


def read_picture(path):
    """One picture as stored: [H, W] or [H, W, 3], uint8 or uint16, black at 0. Palettes become
    colours (of 16 bits in a TIFF), black and white becomes 0 and 255.

    Raises: FileFormatError when it cannot be read, holds several pages, is partly transparent, or
      is of another depth.
    """
    content = read_bytes(path, MOST_BYTES)
    with reading(path, "is it a picture, and whole?"):
        # in memory, where a part that claims more than the file has takes no room
        file = io.BytesIO(content)
        if path.suffix.lower().startswith(".tif"):
            picture = _tiff(path, file)
        else:
            head = file.read(26)
            if (
                head[:4] == b"\x89PNG"
                and head[24:25] == b"\x10"
                and head[25:] in (b"\x02", b"\x04", b"\x06")
            ):
                raise FileFormatError(
                    f"{path} is a PNG in colour or with alpha at 16 bits, which the reader would cut to 8; convert "
                    "it to TIFF, or to gray."
                )
            file.seek(0)
            with PIL.Image.open(file) as opened:
                check_room(
                    path, (opened.height, opened.width, 4), 1, 4 * MOST_RATIO * path.stat().st_size
                )
            file.seek(0)
            picture = np.asarray(iio.imread(file, plugin="pillow", extension=path.suffix.lower()))
    if picture.dtype == bool:
        picture = picture.astype(np.uint8) * 255
    if picture.ndim == 3 and picture.shape[-1] in (2, 4):
        full = np.iinfo(picture.dtype).max if picture.dtype.kind == "u" else 1
        if bool((picture[..., -1] != full).any()):
            raise FileFormatError(f"{path} is partly transparent; put it on a background first.")
        picture = picture[..., 0] if picture.shape[-1] == 2 else picture[..., :3]
    if (
        picture.dtype not in (np.uint8, np.uint16)
        or picture.ndim not in (2, 3)
        or (picture.ndim == 3 and picture.shape[-1] != 3)
    ):
        raise FileFormatError(
            f"{path} holds {picture.dtype} {list(picture.shape)}; one page of 8 or 16 bits, gray or red, "
            "green, blue, is needed."
        )
    return picture


def _alike(path, first):
    picture = read_picture(path)
    if picture.dtype != first.dtype:
        raise FileFormatError(
            f"{path} has {8 * picture.dtype.itemsize} bits, the first picture {8 * first.dtype.itemsize}; "
            "all must have the same depth."
        )
    return picture


def _tiff(path, file):
    """The one page of a TIFF, of the size that the file can hold."""
    with tifffile.TiffFile(file) as pages:
        page = pages.pages.first
        check_room(path, page.shape, page.dtype.itemsize, MOST_RATIO * path.stat().st_size)
        if len(page.shape) not in (2, 3) or page.compression not in PACKINGS or page.is_tiled:
            raise FileFormatError(
                f"{path} is packed as {page.compression.name}, in tiles or in depth; save it plain, or "
                "packed by zlib."
            )
        with contextlib.suppress(IndexError):
            pages.pages.get(1)
            raise FileFormatError(f"{path} holds several pages; one is needed.")
        kind, bits = page.photometric, page.bitspersample
        turned = page.tags.valueof("Orientation", 1) != 1
        if kind not in (WHITE_IS_ZERO, BLACK_IS_ZERO, RGB, PALETTE) or turned:
            raise FileFormatError(
                f"{path} holds {getattr(kind, 'name', kind)}{', turned' if turned else ''}; save it upright as gray, "
                "palette or RGB."
            )
        if kind != PALETTE and bits not in (1, 8, 16):
            raise FileFormatError(f"{path} has {bits} bits per colour; save it with 8 or 16.")
        picture = page.asarray()
        if kind == PALETTE:
            return page.colormap[:, picture].transpose(1, 2, 0)
        return ~picture if kind == WHITE_IS_ZERO else picture
