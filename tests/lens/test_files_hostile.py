"""Hostile lens files: every one ends in one sentence, after a bounded amount of reading, whatever its
extension."""

import random

import pytest

from codesign import lens
from codesign.errors import CodesignError, FileFormatError
from codesign.lens.files.text import LARGEST_BYTES, read_text

EXTENSIONS = (".json", ".zmx", ".seq", ".txt")
JUNK = random.Random(0).randbytes(20_000)
HOSTILE = {
    "empty": b"",
    "one line of 50 MB": b"9" * 50_000_000,
    "3 MB of lines": b"S 1 1\n" * 500_000,
    "2 MB of lines": b"S 1 1\n" * 333_000,
    "2 MB of long lines": b"S 1 1 ; S 1 1 ; S 1 1 ; S 1 1 ; S 1 1 ; \n" * 47_000,
    "2 MB of brackets": b"[" * 2_000_000,
    "2 MB of braces": b'{"a":' * 390_000,
    "2 MB of SURF": b"SURF 0\n" * 285_000,
    "2 MB of semicolons": b";" * 2_000_000,
    "2 MB of quotes": b"'" * 2_000_000,
    "2 MB of continuations": b"&\n" * 1_000_000,
    "2 MB joined": (b"S" + b"1" * 38 + b"&\n") * 49_000,
    "2 MB of bangs": b"!\n" * 1_000_000,
    "null bytes": b"MODE SEQ\x00\x00\x00",
    "binary": JUNK,
    "binary UTF-16": b"\xff\xfe" + JUNK,
    "half a UTF-16 character": b"\xff\xfeM",
    "lone surrogates": b"\xff\xfe" + b"\x00\xd8" * 50,
    "escape sequences": b"\x1b[2J\x1b[H",
    "a million digits": b'{"schema": ' + b"9" * 1_000_000 + b"}",
    "a number beyond all floats": b'{"schema": "codesign-lens/1", "entrance_pupil_diameter_mm": 1e999, "surfaces": [{"radius_mm": 1e999}]}',
    "code": b"__import__('os').system('touch hacked')\n" * 5,
    "negative surface": b"MODE SEQ\nSURF -1\n",
    "surface 1e9": b"MODE SEQ\nSURF 1000000000\n",
}


@pytest.mark.parametrize("extension", EXTENSIONS)
@pytest.mark.parametrize("kind", HOSTILE)
def test_every_hostile_file_ends_in_one_short_sentence(kind, extension, tmp_path):
    path = tmp_path / f"lens{extension}"
    path.write_bytes(HOSTILE[kind])
    with pytest.raises(CodesignError) as caught:
        lens.load(path)
    message = str(caught.value)
    assert message.startswith(f"lens file {path}: ")
    assert message.isprintable()
    assert len(message) < 500
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_no_more_than_the_limit_is_ever_read(tmp_path, monkeypatch):
    path = tmp_path / "lens.zmx"
    with open(path, "wb") as file:
        file.truncate(50_000_000_000)  # a sparse file, longer than memory
    with pytest.raises(FileFormatError, match=f"more than the {LARGEST_BYTES} of its kind"):
        lens.load(path)
    path.write_bytes(b" " * LARGEST_BYTES)
    assert len(read_text(path)) == LARGEST_BYTES
    path.write_bytes(b" " * (LARGEST_BYTES + 1))
    with pytest.raises(FileFormatError, match="more than"):
        read_text(path)


def test_a_link_to_a_lens_file_is_read(tmp_path):
    lens.save(lens.load("la1509"), tmp_path / "a.json")
    (tmp_path / "b.json").symlink_to("a.json")
    assert lens.load(tmp_path / "b.json").to_surfaces() == lens.load("la1509").to_surfaces()
