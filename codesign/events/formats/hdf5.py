"""Event streams in HDF5: DSEC's layout (read and written) and v2e's (read)."""

import zlib

from codesign.errors import FileFormatError
from codesign.events.formats.dsec import from_dsec, to_dsec
from codesign.events.formats.hdf5_chunks import h5py, values
from codesign.events.formats.v2e_hdf5 import from_v2e
from codesign.reading import reading

# all that h5py raises on damaged files
LIBRARY_ERRORS = (
    OSError,
    RuntimeError,
    KeyError,
    ValueError,
    TypeError,
    AttributeError,
    NotImplementedError,
    MemoryError,
    OverflowError,
    zlib.error,
)
EVENTS_PER_CHUNK = 2**17


def read_hdf5(path, height_px=None, width_px=None):
    """Read events from ``path``, in DSEC's layout (a group ``events`` of t, x, y, p) or v2e's (a dataset
    ``events`` of rows).

    Raises: FileFormatError for another layout, damage, data kept in other files, and what dsec and v2e_hdf5
      refuse.
    """
    with reading(path, "it is no whole HDF5 file of events"), h5py.File(path, "r", locking=False) as file:
        from_layout, arrays, attributes = _contents(path, file)
    return from_layout(path, arrays, attributes, height_px, width_px)


def write_hdf5(path, stream):
    """Write events to ``path`` in DSEC's layout, with checksums; see dsec for what it holds."""
    arrays, attributes = to_dsec(stream)
    with h5py.File(
        path, "w", libver=("v110", "v110")
    ) as file:  # from 1.10 on, HDF5 keeps checksums of its own structure too
        for name, array in arrays.items():
            packing = {}
            if array.size > 1:
                packing = {
                    "chunks": (min(len(array), EVENTS_PER_CHUNK),),
                    "compression": "gzip",
                    "compression_opts": 1,
                    "shuffle": True,
                    "fletcher32": True,
                }
            file.create_dataset(name, data=array, **packing)
        file["events"].attrs.update(attributes)


def _contents(path, file):
    """(function that makes the stream, arrays by name, attributes) of an open file."""
    events = _own(path, file, "events")
    if isinstance(events, h5py.Group):
        names = [
            "events/t",
            "events/x",
            "events/y",
            "events/p",
            "t_offset",
            *(name for name in ("ms_to_idx",) if name in file),
        ]
        attributes = {name: events.attrs[name] for name in ("height_px", "width_px") if name in events.attrs}
        return (
            from_dsec,
            {name.removeprefix("events/"): values(path, _own(path, file, name), name) for name in names},
            attributes,
        )
    frames = _own(path, file, "frame") if "frame" in file else None
    size = ()
    if frames is not None and isinstance(frames, h5py.Dataset) and frames.ndim == 3:
        size = frames.shape[1:]
    return (
        from_v2e,
        {"events": values(path, events, "events")},
        dict(zip(("height_px", "width_px"), size, strict=False)),
    )


def _own(path, file, name):
    """The object of a name, which must lie in this file."""
    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise FileFormatError(
            f"{path}: {name} is absent or a link to another file; files must hold their own data (t, x, y, "
            "p under events, and t_offset)."
        )
    return file[name]
