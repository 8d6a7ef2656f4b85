"""Damaged event files: refused, or read as a valid stream; where a format keeps checksums, as the stream that
was written."""

import random
import warnings
import zipfile
import zlib

import h5py
import hdf5plugin
import numpy as np
import pytest
import torch

from codesign.errors import FileFormatError
from codesign.events import read, write
from codesign.events.stream import ordered

FIELDS = ("t_us", "x", "y", "p")
TRIALS = 200
COUNTS = (
    b"\xff" * 4,
    b"\xff\xff\xff\x7f",
    b"\x00\x00\x00\x80",
    b"\xff" * 7 + b"\x7f",
    bytes(8),
    b"\x00\x00\x00\x00\x01\x00\x00\x00",
)  # hostile lengths


def small_stream():
    generator = torch.Generator().manual_seed(1)
    t_us = torch.randint(0, 20_000, (200,), generator=generator)
    x, y, p = (torch.randint(0, high, (200,), generator=generator) for high in (346, 260, 2))
    return ordered(t_us, x, y, 2 * p - 1, 260, 346)


def damaged(whole, dice):
    """A copy with one to three faults of one kind; every second fault lies in the first 300 bytes, where
    headers are."""
    data = bytearray(whole)
    kind = dice.randrange(6)
    for _ in range(dice.randint(1, 3)):
        at = dice.randrange(min(len(data), 300) if dice.random() < 0.5 else len(data))
        if kind == 0:
            data[at] ^= 1 << dice.randrange(8)
        elif kind == 1:
            data = data[: max(at, 1)]
        elif kind == 2:
            data[at:at] = dice.randbytes(dice.choice((1, 2, 4, 8)))
        elif kind == 3:
            length = dice.choice((2, 4, 16, 64))
            data[at : at + length] = bytes(length)
        elif kind == 4:
            data[at] = dice.randrange(256)
        else:
            hostile = dice.choice(COUNTS)
            data[at : at + len(hostile)] = hostile
    return bytes(data)


def check_trials(path, stream, keeps_checksums):
    """Read TRIALS damaged copies of a good file."""
    whole = path.read_bytes()
    dice = random.Random(7)
    refused = 0
    for _ in range(TRIALS):
        path.write_bytes(damaged(whole, dice))
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message=".*are left out")
                back = read(path)
        except FileFormatError:
            refused += 1
            continue
        keys = list(zip(*(getattr(back, name).tolist() for name in ("t_us", "y", "x", "p")), strict=True))
        assert keys == sorted(keys)
        assert set(back.p.tolist()) <= {1, -1}
        assert all(0 <= x < back.width_px and 0 <= y < back.height_px for _, y, x, _ in keys)
        if keeps_checksums:
            assert all(torch.equal(getattr(stream, name), getattr(back, name)) for name in FIELDS)
    assert refused > TRIALS // 3  # the faults do hit what is checked


@pytest.mark.parametrize(
    ("name", "evt"),
    [
        ("e.npz", None),
        ("e.h5", None),
        ("e.aedat4", None),
        ("e.raw", 3),
        ("e.raw", 2),
        ("e.dat", None),
        ("e.csv", None),
    ],
)
def test_damage_is_refused_or_harmless(tmp_path, name, evt):
    path = tmp_path / name
    stream = small_stream()
    write(path, stream, evt=evt)
    check_trials(path, stream, keeps_checksums=path.suffix in (".npz", ".h5", ".aedat4"))


@pytest.mark.parametrize(
    "packing", [hdf5plugin.Blosc(cname="zstd", clevel=1), {"compression": "gzip", "shuffle": True}, {}]
)
def test_damage_in_other_programs_hdf5_is_refused_or_a_valid_stream(tmp_path, packing):
    path = tmp_path / "e.h5"
    stream = small_stream()
    with h5py.File(path, "w") as file:  # no checksums, as published files have none
        for name, values in (("t", stream.t_us), ("x", stream.x), ("y", stream.y), ("p", stream.p > 0)):
            file.create_dataset(
                f"events/{name}", data=values.numpy().astype(np.uint32), chunks=(64,), **packing
            )
        file["t_offset"] = 0
    check_trials(path, stream, keeps_checksums=False)


def test_blocks_that_unpack_to_too_little_are_refused(tmp_path):
    # both end the process when HDF5 unpacks them: the missing bytes lie beyond its buffer
    for packing, shorten in (
        ({"compression": "gzip"}, lambda _: zlib.compress(b"short")),
        (dict(hdf5plugin.Blosc()), lambda data: data[:4] + (64).to_bytes(4, "little") + data[8:]),
    ):
        path = tmp_path / "e.h5"
        with h5py.File(path, "w") as file:
            for name in ("t", "x", "y", "p"):
                dataset = file.create_dataset(
                    f"events/{name}", data=np.zeros(2**18, np.uint32), chunks=(2**18,), **packing
                )
                dataset.id.write_direct_chunk((0,), shorten(dataset.id.read_direct_chunk((0,))[1]))
            file["t_offset"] = 0
        with pytest.raises(FileFormatError, match="does not unpack"):
            read(path)


def test_claims_out_of_proportion_take_no_memory(tmp_path):
    path = tmp_path / "e.h5"
    with h5py.File(path, "w") as file:  # 4 TB that were never written
        for name in ("t", "x", "y", "p"):
            file.create_dataset(
                f"events/{name}", shape=(2**40,), chunks=(2**20,), dtype="u1", compression="gzip"
            )
        file["t_offset"] = 0
    with pytest.raises(FileFormatError, match="out of proportion"):
        read(path)
    path = tmp_path / "e.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(
            "t_us.npy",
            b"\x93NUMPY\x01\x00\x76\x00"
            + b"{'descr': '<i8', 'fortran_order': False, 'shape': (1099511627776,), }".ljust(117)
            + b"\n",
        )
    with pytest.raises(FileFormatError, match="t_us claims"):
        read(path)
