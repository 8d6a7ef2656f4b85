"""Frames of a Photron high-speed camera: raw values in .mraw, their description beside it in .cihx
or .cih.

Source: the published reader pyMRAW (github.com/ladisk/pyMRAW) for the names of the fields and the
  packing of 12 bits: two values in three bytes, the first in byte 0 and the upper half of byte 1.
"""

import re

import numpy as np

from codesign.errors import FileFormatError
from codesign.events.sources.frames import FrameSource, same_size, times_from_fps
from codesign.reading import read_bytes

MOST_BYTES = 10_000_000  # of a description
NUMBER = re.compile(r"[0-9]{1,9}")
XML = {
    "rate": "recordRate",
    "frames": "totalFrame",
    "width": "width",
    "height": "height",
    "bits": "bit",
    "depth": "depth",
    "side": "side",
}
TEXT = {
    "rate": "Record Rate(fps)",
    "frames": "Total Frame",
    "width": "Image Width",
    "height": "Image Height",
    "bits": "Color Bit",
    "depth": "EffectiveBit Depth",
    "side": "EffectiveBit Side",
}


def open_mraw(path):
    """Open a monochrome recording of 8, 12 (packed) or 16 bits; its times follow from the record
    rate.

    Full scale is that of the effective bits where they are the lower ones of what is stored, else
    that of the bits stored.
    Raises: FileFormatError when the description is missing or incomplete, or the file is not as
      long as it says.
    """
    facts = _facts(path)
    count, height, width, bits = (
        _number(facts, name, path) for name in ("frames", "height", "width", "bits")
    )
    rate = facts.get("rate", "").split("/")[0]
    if not NUMBER.fullmatch(rate) or int(rate) == 0:
        raise FileFormatError(
            f"the description of {path.name} gives the record rate {str(facts.get('rate'))[:40]!r}; a "
            "whole number of frames per second is needed."
        )
    if bits not in (8, 12, 16) or width * height * bits % 8:
        raise FileFormatError(
            f"{path} holds {width} x {height} pixels of {bits} bits; whole bytes of 8, 12 or 16 bits are "
            "read."
        )
    size = width * height * bits // 8
    if path.stat().st_size != count * size or count < 2 or not width * height:
        raise FileFormatError(
            f"{path} has {path.stat().st_size} bytes; {count} frames (two or more) of {width} x {height} "
            f"pixels and {bits} bits, monochrome, are {count * size}."
        )
    lower = facts.get("side", "").lower() == "lower" and NUMBER.fullmatch(facts.get("depth", ""))
    white = 2.0 ** (min(bits, int(facts["depth"])) if lower else bits) - 1

    def read(start):
        frames = (
            (
                index,
                _values(np.fromfile(path, np.uint8, size, offset=index * size), bits).reshape(
                    height, width
                ),
            )
            for index in range(start, count)
        )
        yield from same_size(frames, path, (height, width), count)

    return FrameSource(
        path,
        count,
        height,
        width,
        white,
        times_from_fps(count, int(rate)),
        f"record rate of the camera, {rate} frames per second",
        read,
    )


def _values(data, bits):
    if bits == 8:
        return data
    if bits == 16:
        return data.view("<u2").astype(np.uint16)
    first, middle, last = data.reshape(-1, 3).astype(np.uint16).T
    return np.stack(((first << 4) | (middle >> 4), ((middle & 15) << 8) | last), axis=1)


def _facts(path):
    for suffix, pattern, names in (
        (".cihx", r"<{}>\s*([^<]*?)\s*</", XML),
        (".cih", r"(?m)^{} : (.*?)\s*$", TEXT),
    ):
        beside = path.with_suffix(suffix)
        if beside.is_file():
            # patterns and no parser: the XML stands behind other bytes, and nothing in it is ever
            # expanded
            text = read_bytes(beside, MOST_BYTES).decode("latin-1")
            found = {
                name: re.search(pattern.format(re.escape(key)), text) for name, key in names.items()
            }
            return {name: match[1] for name, match in found.items() if match}
    raise FileFormatError(
        f"{path} has no description beside it ({path.stem}.cihx or {path.stem}.cih), which says its size "
        "and frame rate; copy it there."
    )


def _number(facts, name, path):
    if not NUMBER.fullmatch(facts.get(name, "")):
        raise FileFormatError(
            f"the description of {path.name} gives {name} as {str(facts.get(name))[:40]!r}; a whole number "
            "is needed."
        )
    return int(facts[name])
