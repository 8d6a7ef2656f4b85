"""Mutants of a file: bytes, words, and what stands inside (members of a zip, chunks of a PNG,
headers of NumPy), put back with the checksums right, so that readers are reached behind the first
check."""

import io
import re
import struct
import zipfile
import zlib

import numpy as np

COUNTS = (
    b"\xff" * 4,
    b"\xff\xff\xff\x7f",
    b"\x00\x00\x00\x80",
    b"\xff" * 7 + b"\x7f",
    bytes(8),
    b"\0\0\0\0\1\0\0\0",
)
FLOATS = (np.nan, np.inf, -np.inf, 1e300, -1e300, 1e-320)
WORDS = (
    *("nan", "inf", "-inf", "1e999", "-1", "0", "1e-320", "99999999999999999999", "1e8", "-1e300"),
    *("9" * 5000, "0.5", "null", "true", '"x"', "[]", "{}", "[" * 20_000, '{"a":' * 5_000),
    *("../../elsewhere", "a\\u0000b", "\x00", "²", "x", "", " ", "\n", "&a;", "<!DOCTYPE a>"),
    *("x" * 5000, "$(id)", "__import__('os')"),
)
WORD = re.compile(rb"[A-Za-z0-9_.+-]+")
PNG = b"\x89PNG\r\n\x1a\n"


def mutant(content: bytes, dice: np.random.Generator) -> bytes:
    """One mutant of a file: structure first where it has one, in half of the cases."""
    if dice.random() < 0.5:
        inside = _inside(content, dice)
        if inside is not None:
            return inside
    return (_words if _is_text(content) and dice.random() < 0.7 else changed_bytes)(content, dice)


def _is_text(content):
    return b"\0" not in content[:2000] and content[:2000].isascii()


def changed_bytes(content, dice):
    """One to four faults; every second one lies in the first 300 bytes, where headers are."""
    data = bytearray(content)
    for _ in range(int(dice.integers(1, 5))):
        end = min(len(data), 300) if dice.random() < 0.5 else len(data)
        at = int(dice.integers(max(end, 1)))
        length = int(dice.choice((1, 2, 4, 8, 16, 64)))
        match int(dice.integers(8)):
            case 0:
                byte = (data[at : at + 1] or b"\0")[0]
                data[at : at + 1] = bytes([byte ^ 1 << int(dice.integers(8))])
            case 1:
                data = data[:at]
            case 2:
                data[at:at] = dice.bytes(length)
            case 3:
                data[at : at + length] = bytes(length)
            case 4:
                data[at : at + length] = dice.bytes(length)
            case 5:
                hostile = COUNTS[int(dice.integers(len(COUNTS)))]
                data[at : at + len(hostile)] = hostile
            case 6:
                data[at:at] = data[at : at + int(dice.integers(1, 2000))]
            case _:
                kind = dice.choice(("<f4", "<f8"))
                with np.errstate(over="ignore"):
                    value = np.array(dice.choice(FLOATS)).astype(kind).tobytes()
                at -= at % len(value)
                data[at : at + len(value)] = value
    return bytes(data)


def _words(content, dice):
    """One to three words replaced, or lines left out, doubled or exchanged."""
    for _ in range(int(dice.integers(1, 4))):
        if dice.random() < 0.7 and (found := list(WORD.finditer(content))):
            match = found[int(dice.integers(len(found)))]
            new = WORDS[int(dice.integers(len(WORDS)))].encode()
            if dice.random() < 0.3:
                new = found[int(dice.integers(len(found)))][0]
            content = content[: match.start()] + new + content[match.end() :]
        else:
            lines = content.split(b"\n")
            first, second = (int(dice.integers(len(lines))) for _ in range(2))
            match int(dice.integers(3)):
                case 0:
                    del lines[first]
                case 1:
                    lines.insert(first, lines[second])
                case _:
                    lines[first], lines[second] = lines[second], lines[first]
            content = b"\n".join(lines)
    return content


def _inside(content, dice):
    """A mutant of a part, put back whole; None where there is no structure to know."""
    if content.startswith(b"PK\3\4"):
        return _zip(content, dice)
    if content.startswith(b"\x93NUMPY"):
        return _npy(content, dice)
    if content.startswith(PNG):
        return _png(content, dice)
    if content[8:9] == b"{" and struct.unpack_from("<Q", content)[0] < len(content):
        size = struct.unpack_from("<Q", content)[0]
        header = _words(content[8 : 8 + size], dice)  # of safetensors
        return struct.pack("<Q", len(header)) + header + content[8 + size :]
    return None


def _zip(content, dice):
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = [(entry, archive.read(entry)) for entry in archive.infolist()]
    chosen = int(dice.integers(len(members)))
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for number, (entry, data) in enumerate(members):
            name = entry.filename
            if number == chosen:
                match int(dice.integers(6)):
                    case 0:
                        names = ("../out.npy", "a\\b", "x" * 300, "²")
                        name = dice.choice((*names, members[0][0].filename + ".npy"))
                    case 1:
                        continue
                    case _:
                        data = mutant(data, dice)
            archive.writestr(name, data, int(dice.choice((0, 8))))
    return made.getvalue()


def _npy(content, dice):
    size = struct.unpack_from("<H", content, 8)[0]
    header, body = content[10 : 10 + size], content[10 + size :]
    if dice.random() < 0.6:
        header = _words(header.rstrip(), dice)[:60_000] + b"\n"
    else:
        start = int(dice.integers(max(len(body), 1)))
        body = body[:start] + changed_bytes(body[start : start + 64], dice) + body[start + 64 :]
        body = body[: len(content) - 10 - size].ljust(len(content) - 10 - size, b"\0")
    return content[:8] + struct.pack("<H", len(header)) + header + body


def _png(content, dice):
    chunks, at = [], 8
    while at + 12 <= len(content):
        size = struct.unpack_from(">I", content, at)[0]
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + size]))
        at += 12 + size
    chosen = int(dice.integers(len(chunks)))
    made = [PNG]
    for number, (name, data) in enumerate(chunks):
        if number == chosen:
            if name == b"IDAT" and dice.random() < 0.5:
                data = zlib.compress(changed_bytes(zlib.decompress(data), dice))
            else:
                data = changed_bytes(data, dice)
        checksum = struct.pack(">I", zlib.crc32(name + data))
        made += [struct.pack(">I", len(data)), name, data, checksum]
    return b"".join(made)
