"""Flow fields to and from files: 16-bit PNG as in DSEC, and Middlebury .flo. The extension says
which.

DSEC: three channels of 16 bits. The first two are round(128 v) + 2^15 for the flow v to the right
  and down (px), the third is 1 where it is valid, else 0. Flows from -256 to 255.99 px fit, to
  1/256 px; larger valid ones are refused, never clipped. Invalid pixels are written as 0, 0, 0 and
  read as flow 0.
Middlebury: the float32 202021.25, width and height as int32, then (right, down) float32 pixel by
  pixel, all little-endian. Invalid pixels hold 1e10, and components above 1e9 in size read as
  invalid. Sources: the DSEC data format page; Baker et al., A database and evaluation methodology
  for optical flow, IJCV 2011.
"""

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from codesign.atomic import replacing
from codesign.checks import check, check_path
from codesign.errors import DomainError, FileFormatError
from codesign.reading import read_bytes, reading

SCALE = 128.0
OFFSET = 2**15
FLO_TAG = struct.pack("<f", 202021.25)
FLO_UNKNOWN = 1e10
FLO_LIMIT = 1e9
PNG_START = b"\x89PNG\r\n\x1a\n"
MOST_PIXELS = 32_000_000  # what a file may announce
MOST_BYTES = 1_000_000_000


def _chunk(name, data):
    """Of a PNG."""
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


PNG_END = _chunk(b"IEND", b"")


def write_flow(path: str | Path, flow_px: torch.Tensor, valid: torch.Tensor | None = None) -> None:
    """Write one flow field; the file appears whole or not at all.

    Args:
      path: ending in .png (DSEC) or .flo.
      flow_px: [2, H, W] px, +x right, +y down.
      valid: [H, W] bool, everything when None.
    Raises: ShapeError; DomainError when a valid flow is not finite or does not fit the format;
      FileFormatError for another extension or a folder not writable.

    >>> write_flow("flow.png", torch.full((2, 4, 6), 1.5))
    >>> flow_px, valid = read_flow("flow.png")
    >>> flow_px.shape, float(flow_px.max()), bool(valid.all())
    (torch.Size([2, 4, 6]), 1.5, True)
    """
    path = check_path(path, "the path of a flow file")
    encode = _choose({".png": _to_png, ".flo": _to_flo}, path, "written")
    if isinstance(flow_px, np.ndarray) and np.asarray(flow_px).dtype.kind in "fiu":
        flow_px = torch.from_numpy(np.array(flow_px, np.float64))
    flow = check(flow_px, "2 H W", "the flow to write").detach().cpu().double().numpy()
    if isinstance(valid, np.ndarray) and valid.dtype == np.bool_:
        valid = torch.from_numpy(valid.copy())
    everything = torch.ones(flow.shape[1:], dtype=torch.bool)
    given = everything if valid is None else valid
    seen = check(given, flow.shape[1:], "the valid mask", (torch.bool,)).cpu().numpy()
    if not np.isfinite(flow[:, seen]).all():
        raise DomainError("a flow marked as valid is NaN or infinite; mark it as not valid.")
    content = encode(flow, seen)
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read_flow(path: str | Path) -> tuple[torch.Tensor, torch.Tensor]:
    """Read one flow field.

    Returns: flow_px [2, H, W] float32, 0 where not valid; valid [H, W] bool.
    Raises: FileFormatError with one sentence when the file is missing, damaged or of another kind.

    >>> write_flow("flow.flo", torch.zeros(2, 4, 6), valid=torch.eye(4, 6, dtype=torch.bool))
    >>> flow_px, valid = read_flow("flow.flo")
    >>> int(valid.sum())
    4
    """
    path = check_path(path, "the path of a flow file")
    decode = _choose({".png": _from_png, ".flo": _from_flo}, path, "read")
    content = read_bytes(path, MOST_BYTES)
    flow, valid = decode(path, content)
    flow[:, ~valid] = 0
    return torch.from_numpy(flow), torch.from_numpy(valid)


def _choose(table, path, verb):
    choice = table.get(path.suffix.lower())
    if choice is None:
        raise FileFormatError(
            f"{path} ends in {path.suffix or 'nothing'!r}; flow files that can be {verb} end in .flo or .png."
        )
    return choice


def _to_flo(flow, valid):
    if bool((np.abs(flow[:, valid]) > FLO_LIMIT).any()):
        raise DomainError(
            f"a valid flow exceeds {FLO_LIMIT:g} px, which a .flo file reads as unknown; mark it as not "
            "valid."
        )
    pixels = np.where(valid, flow, FLO_UNKNOWN).transpose(1, 2, 0).astype("<f4")
    return FLO_TAG + struct.pack("<ii", flow.shape[2], flow.shape[1]) + pixels.tobytes()


def _from_flo(path, content):
    if content[:4] != FLO_TAG or len(content) < 12:
        raise FileFormatError(
            f"{path} is not a .flo file: it does not begin with the number 202021.25 and a size."
        )
    width, height = struct.unpack("<ii", content[4:12])
    if (
        not (width >= 1 and height >= 1 and width * height <= MOST_PIXELS)
        or len(content) != 12 + 8 * width * height
    ):
        raise FileFormatError(
            f"{path} announces {width} x {height} pixels, which its {len(content)} bytes do not hold; it is "
            "cut off or damaged."
        )
    pixels = np.frombuffer(content, "<f4", offset=12).reshape(height, width, 2)
    flow = pixels.transpose(2, 0, 1).astype(np.float32, "C")
    return flow, (np.abs(flow) <= FLO_LIMIT).all(0)  # NaN is unknown too


def _to_png(flow, valid):
    value = np.rint(flow * SCALE) + OFFSET
    outside = valid & ~((value >= 0) & (value < 2**16)).all(0)
    if outside.any():
        row, column = np.argwhere(outside)[0]
        x, y = flow[:, row, column]
        raise DomainError(
            f"the flow ({x:.4g}, {y:.4g}) px at column {column}, row {row} does not fit 16 bits (-256 to "
            "255.99 px); mark it as not valid, shorten the interval, or write .flo."
        )
    pixels = (
        np.concatenate([np.where(valid, value, 0), valid[None]]).transpose(1, 2, 0).astype(">u2")
    )
    rows = pixels.reshape(flow.shape[1], -1).view(np.uint8)
    above = np.vstack([np.zeros_like(rows[:1]), rows[:-1]])
    # every row as its difference from the one above (PNG filter 2), modulo 256
    filtered = np.hstack([np.full((len(rows), 1), 2, np.uint8), rows - above])
    header = struct.pack(">IIBBBBB", flow.shape[2], flow.shape[1], 16, 2, 0, 0, 0)
    return (
        PNG_START
        + _chunk(b"IHDR", header)
        + _chunk(b"IDAT", zlib.compress(filtered.tobytes(), 3))
        + PNG_END
    )


def _from_png(path, content):
    if content[:8] != PNG_START:
        raise FileFormatError(f"{path} is not a PNG file.")
    if PNG_END not in content:
        raise FileFormatError(f"{path} is cut off: its end mark is missing.")
    with reading(path, "it is damaged"):
        width, height, *kind = struct.unpack_from(">IIBBBBB", content, 16)
    if kind != [16, 2, 0, 0, 0]:
        raise FileFormatError(
            f"{path} is not a flow PNG (three channels of 16 bits, not interlaced): bit depth {kind[0]}, colour type "
            f"{kind[1]}, interlacing {kind[4]}."
        )
    if not 1 <= width * height <= MOST_PIXELS:
        raise FileFormatError(
            f"{path} announces {width} x {height} pixels; up to {MOST_PIXELS} are read."
        )
    with reading(path, "it is cut off or damaged"):
        with Image.open(io.BytesIO(content), formats=["PNG"]) as image:
            image.verify()
        # in place: a file of a few bytes may announce the most pixels
        pixels = _bytes(content, "B").astype(np.uint16)
        pixels <<= 8
        pixels |= _bytes(content, "L")
    if pixels[..., 2].max() > 1:
        raise FileFormatError(
            f"{path} is not a flow PNG: its third channel reaches {pixels[..., 2].max()}, but holds 1 for "
            "valid pixels and 0 for others."
        )
    flow = pixels[..., :2].transpose(2, 0, 1).astype(np.float32, "C")  # exact, as all that follows
    flow -= OFFSET
    flow /= SCALE
    return flow, pixels[..., 2] == 1


def _bytes(content, order):
    """The upper bytes [H, W, 3] of a PNG of 16 bits, or the lower ones where ``order`` says that
    they stand first: Pillow keeps one byte of each number."""
    with Image.open(io.BytesIO(content), formats=["PNG"]) as image:
        image.tile = [(*tile[:3], f"RGB;16{order}") for tile in image.tile]
        return np.asarray(image)
