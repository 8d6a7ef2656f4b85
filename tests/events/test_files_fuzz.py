"""HDF5 and NPZ files made to break their libraries: refused before memory is taken. Mutants:
tests/hostile."""

import zipfile
import zlib

import h5py
import hdf5plugin
import numpy as np
import pytest

from codesign.errors import FileFormatError
from codesign.events import read


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
