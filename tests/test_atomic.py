"""Files that appear whole or not at all, and are on the disk when they do."""

import ast
import os
import stat
from pathlib import Path

import pytest

from codesign.atomic import replacing, write_atomic
from codesign.errors import FileFormatError


def test_content_is_synced_before_the_name_and_the_folder_after(tmp_path, monkeypatch):
    done = []

    def sync(handle):
        kind = "folder" if stat.S_ISDIR(os.fstat(handle).st_mode) else "file"
        done.append((kind, os.fstat(handle).st_size if kind == "file" else None))

    move = os.replace

    def replace(source, target):
        done.append(("move", None))
        move(source, target)

    monkeypatch.setattr(os, "fsync", sync)
    monkeypatch.setattr(os, "replace", replace)
    write_atomic(tmp_path / "a.bin", b"12345")
    assert done == [("file", 5), ("move", None), ("folder", None)]
    assert (tmp_path / "a.bin").read_bytes() == b"12345"


def test_a_block_that_fails_leaves_the_earlier_file_and_nothing_else(tmp_path):
    write_atomic(tmp_path / "a.txt", b"old")

    def stop_half_way():
        with replacing(tmp_path / "a.txt") as temporary:
            temporary.write_bytes(b"ne")
            raise ValueError("half way")

    with pytest.raises(ValueError, match="half way"):
        stop_half_way()
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a.txt": b"old"}


def test_a_full_disk_is_one_sentence(tmp_path, monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(
        FileFormatError, match=r"cannot write .*a\.txt: No space left on device; is the disk"
    ):
        write_atomic(tmp_path / "a.txt", b"new")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_synced_keeps_the_file(tmp_path, monkeypatch):
    def sync(handle):
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(22, "Invalid argument")

    monkeypatch.setattr(os, "fsync", sync)
    write_atomic(tmp_path / "a.txt", b"new")
    assert (tmp_path / "a.txt").read_bytes() == b"new"


def test_a_file_is_as_readable_as_the_process_makes_files(tmp_path):
    mask = os.umask(0o027)
    try:
        write_atomic(tmp_path / "a.txt", b"")
    finally:
        os.umask(mask)
    assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == 0o640


WRITES = {
    *("write_text", "write_bytes", "save", "savez", "savez_compressed", "savetxt"),
    *("savefig", "imwrite", "tofile"),
}
# a name that ``replacing`` yields, or a file in memory
HARMLESS = {"temporary", "buffer", "png", "content"}
OTHERWISE = {
    "codesign/atomic.py": "it is the mechanism",
    "codesign/events/formats": "write what codesign/events/files.py replaces",
    "studies/video_to_events/state.py": "a journal, whose length the state knows",
    "studies/frame/bench.py": "a switch of the kernel",
    "studies/frame/sweep.py": "a journal, whose last line may be cut off",
}


def written(call):
    """Source of what a call writes to, or None."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    owner = ast.unparse(call.func.value) if isinstance(call.func, ast.Attribute) else ""
    if name in ("open", "File", "h5"):
        modes = [
            a.value
            for a in [*call.args, *(k.value for k in call.keywords)]
            if isinstance(a, ast.Constant)
        ]
        if any(isinstance(m, str) and len(m) < 4 and set(m) & set("wax+") for m in modes):
            return (
                owner
                if name == "open" and owner not in ("", "os", "archive")
                else ast.unparse(call.args[0])
            )
    if name in ("write_text", "write_bytes"):
        return owner
    if name in WRITES and owner in ("np", "numpy", "torch", "iio", "figure", "torch.export"):
        return ast.unparse(call.args[1 if owner.startswith("torch") else 0])
    return None


def test_everything_is_written_through_replacing():
    root = Path(__file__).resolve().parents[1]
    found = [
        f"{path.relative_to(root)}:{node.lineno} writes to {target}"
        for room in ("codesign", "scenes", "studies")
        for path in (root / room).rglob("*.py")
        if not any(str(path.relative_to(root)).startswith(each) for each in OTHERWISE)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and (target := written(node)) and target not in HARMLESS
    ]
    assert not found, "\n".join(found)
