"""HDF5 files on a disk that is full at any moment."""

import subprocess
import sys

import h5py
import numpy as np

from codesign.events.formats.hdf5_rows import new_hdf5

PROGRAM = """
import resource, signal, sys
import numpy as np
from codesign.events.formats.hdf5_rows import new_hdf5
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
dice = np.random.default_rng(0)
told = 0
for most in range(0, 60_000, 3000):
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))
    try:
        with new_hdf5(sys.argv[1]) as file:
            grown = file.create_dataset("a", (0,), "i8", maxshape=(None,), chunks=(512,), compression="gzip")
            for part in range(20):
                grown.resize((part + 1) * 500, 0)
                grown[part * 500 :] = dice.integers(0, 2**40, 500)
                if part % 4 == 0:
                    file.flush()
    except OSError as error:
        told += error.errno == 27
print(told)
"""


def test_a_full_disk_is_an_error_and_never_the_end_of_the_process(tmp_path):
    ended = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path / "a.h5")], capture_output=True, text=True, timeout=100
    )
    assert (ended.returncode, ended.stdout) == (0, "20\n"), ended.stderr[-500:]


def test_what_is_written_is_what_the_library_alone_writes(tmp_path):
    values = np.random.default_rng(1).integers(0, 1000, 5000)
    for name, opened in (("ours", new_hdf5), ("theirs", lambda path: h5py.File(path, "w"))):
        with opened(tmp_path / name) as file:
            file.create_dataset("a", data=values, chunks=(512,), compression="gzip", track_times=False)
    assert (tmp_path / "ours").read_bytes() == (tmp_path / "theirs").read_bytes()
