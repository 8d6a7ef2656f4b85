"""The ASCII header of Prophesee files: lines ``% keyword value`` ahead of the binary part.

Source: Prophesee Metavision documentation, "RAW File Format" and "DAT File Format".
"""

from codesign.errors import FileFormatError

LIMIT_BYTES = 65536
# ours: multiples of the format's time loop before the first event; other readers pass over it
OFFSET_KEY = "codesign_t_offset_us"


def parsed(path, data):
    """(fields, start): the values by keyword, and where the binary part of ``data`` starts.

    Raises: FileFormatError for a header without an end, not ASCII, or with a keyword said twice in two ways.
    """
    fields = {}
    start = 0
    while data[start : start + 2] == b"% ":
        stop = data.find(b"\n", start, LIMIT_BYTES)
        if stop < 0:
            raise FileFormatError(
                f"{path}: the header line at byte {start} does not end within {LIMIT_BYTES} bytes; the file "
                "is damaged or not of this kind."
            )
        try:
            line = data[start + 2 : stop].decode("ascii").strip()
        except UnicodeDecodeError as error:
            raise FileFormatError(
                f"{path}: the header line at byte {start} is not ASCII text; the file is damaged."
            ) from error
        start = stop + 1
        key, _, value = line.partition(" ")
        if key == "end":
            break
        if fields.setdefault(key, value.strip()) != value.strip():
            raise FileFormatError(
                f"{path}: the header gives {key!r} twice, as {fields[key]!r} and {value.strip()!r}; keep "
                "the right one."
            )
    return fields, start


def whole_number(path, text, name, low, high):
    """The integer a header gives for ``name``."""
    digits = text[1:] if text.startswith("-") else text
    if not (digits.isascii() and digits.isdigit()) or len(digits) > 19 or not low <= int(text) <= high:
        raise FileFormatError(
            f"{path}: the header gives {name} as {text[:40]!r}; a whole number from {low} to {high} is "
            "needed."
        )
    return int(text)


def time_offset_us(path, fields, loop_us):
    """Time that a file of ours adds to what its words say: whole loops of the format's clock; 0 in other
    files."""
    offset_us = whole_number(path, fields.get(OFFSET_KEY, "0"), OFFSET_KEY, 0, 2**62)
    if offset_us % loop_us:
        raise FileFormatError(
            f"{path}: {OFFSET_KEY} is {offset_us}; it must be a multiple of {loop_us}, the loop of the "
            "format's clock."
        )
    return offset_us
