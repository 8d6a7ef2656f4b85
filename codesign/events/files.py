"""Event streams to and from files: a file -> packets of t, x, y, p, by the reader of its ending and
content -> checked and put in order (Arrival) -> EventColumns -> an EventStream (``read``), or
windows (codesign.flow.sources)."""

from pathlib import Path

from codesign.atomic import replacing
from codesign.checks import check_path, check_whole
from codesign.errors import FileFormatError
from codesign.events.columns import LIMIT_PX, EventColumns
from codesign.events.formats.aedat import read_aedat2, read_aedat4, write_aedat2, write_aedat4
from codesign.events.formats.arrays import read_arrays, write_npz
from codesign.events.formats.arrival import Asked, check_asked, check_nothing_told
from codesign.events.formats.hdf5 import read_hdf5, write_hdf5
from codesign.events.formats.prophesee import read_dat, read_raw, write_dat, write_raw
from codesign.events.formats.text import read_text, write_csv
from codesign.events.stream import check_stream
from codesign.reading import check_regular, reading
from codesign.types import EventStream

# whose rows may be in any order, or whose times in another unit
TABLES = {
    ".csv": read_text,
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".npy": read_arrays,
    ".npz": read_arrays,
    ".txt": read_text,
}
READERS = TABLES | {
    ".aedat": read_aedat2,
    ".aedat2": read_aedat2,
    ".aedat4": read_aedat4,
    ".dat": read_dat,
    ".raw": read_raw,
}
WRITERS = {
    ".aedat": write_aedat2,
    ".aedat2": write_aedat2,
    ".aedat4": write_aedat4,
    ".csv": write_csv,
    ".dat": write_dat,
    ".h5": write_hdf5,
    ".hdf5": write_hdf5,
    ".npz": write_npz,
    ".raw": write_raw,
}
OPTIONS = {"evt": (".raw",), "t0_us": (".dat", ".raw")}  # of the writers, and who knows them


def read(
    path: str | Path,
    *,
    height_px: int | None = None,
    width_px: int | None = None,
    columns: str = "auto",
    time_unit: str = "auto",
) -> EventStream:
    """Read an event stream.

    Args:
      path: file ending in .h5 or .hdf5 (DSEC's, v2e's or MVSEC's layout), .aedat4, .raw
        (EVT 2.0, EVT 3.0), .dat, .csv or .txt (lines t x y p, with or without a header), .npz or
        .npy.
      height_px, width_px: sensor size. Taken where the file has none (else the smallest that holds
        the events); checked against the file otherwise.
      columns: order of the columns of rows, such as "xytp"; "auto": what the file says, or its
        numbers tell beyond doubt (t x y p or x y t p).
      time_unit: "s", "ms", "us" or "ns"; "auto": what the file says, else seconds where a time has
        a fraction, else microseconds.
    Returns: EventStream sorted by (t, y, x, p), times as the file gives them, in microseconds.
    Raises: FileFormatError when the file is missing, malformed (with the line or event where there
      is one) or of another kind.

    Example:
    >>> import torch
    >>> from codesign import events
    >>> frames = torch.tensor([50.0, 100.0]).reshape(2, 1, 1)
    >>> events.write("brighter.npz", events.simulate(frames, [0.0, 0.01], events.SensorModel()))
    >>> events.read("brighter.npz").t_us.tolist()
    [2885, 5771, 8656]
    """
    sides = (("height_px", height_px), ("width_px", width_px))
    size_px = (
        None if side is None else check_whole(side, name, 1, LIMIT_PX) for name, side in sides
    )
    asked = Asked(*size_px, columns=columns, time_unit=time_unit)
    return read_columns(check_path(path), asked).stream()


def read_columns(path: Path, asked: Asked) -> EventColumns:
    """The events of a file with all that the caller says of it; see ``read``, which takes the same
    files."""
    reader = _choose(READERS, path, "read")
    check_asked(path, asked)
    if path.suffix.lower() not in TABLES:
        check_nothing_told(path, asked, f"they are for {', '.join(TABLES)}")
    with reading(check_regular(path)):
        columns = reader(path, asked)
    if not max(columns.height_px, columns.width_px) <= LIMIT_PX:
        raise FileFormatError(
            f"{path} gives a sensor of {columns.width_px} x {columns.height_px} pixels; at most {LIMIT_PX} "
            "a side are read."
        )
    return columns


def write(
    path: str | Path,
    stream: EventStream,
    *,
    evt: int | None = None,
    t0_us: int | None = None,
) -> None:
    """Write an event stream; the file appears whole or not at all, and an earlier one stays when
    writing fails.

    Args:
      path: file ending in .h5, .aedat4, .raw, .dat, .aedat or .aedat2 (both AEDAT 2.0), .csv or
        .npz, in an existing folder.
      stream: EventStream.
      evt: encoding of .raw files, 2 or 3 (the default); for no other.
      t0_us: start time, microseconds, that .raw and .dat files keep in their header (``% t0``)
        while their clocks of few bits count from there; 0 by default, for no other format.
        ``events.read`` and faery add it back, other readers give the times less t0_us.
    Raises: FileFormatError for an unknown extension, a stream that the format cannot hold, or a
      folder that is missing or not writable; DomainError, ShapeError for what is no stream (times
      that go back, pixels beyond the sensor, other polarities).

    Example:
    >>> import torch
    >>> from codesign import events
    >>> frames = torch.tensor([50.0, 100.0]).reshape(2, 1, 1)
    >>> stream = events.simulate(frames, [0.0, 0.01], events.SensorModel())
    >>> events.write("brighter.raw", stream, evt=2)
    """
    path = check_path(path)
    writer = _choose(WRITERS, path, "written")
    check_stream(stream)
    options = {name: value for name, value in (("evt", evt), ("t0_us", t0_us)) if value is not None}
    for name, value in options.items():
        if path.suffix.lower() not in OPTIONS[name]:
            raise FileFormatError(
                f"{name}={value!r} was given for {path}; it is for {' and '.join(OPTIONS[name])} files alone."
            )
    with replacing(path) as temporary:
        try:
            writer(temporary, stream, **options)
        # writers know what does not fit, not where the file will lie
        except FileFormatError as error:
            raise FileFormatError(f"cannot write {path}: {error}") from error


def _choose(table, path, verb):
    choice = table.get(path.suffix.lower())
    if choice is None:
        raise FileFormatError(
            f"{path} ends in {path.suffix or 'nothing'!r}; event files that can be {verb} end in "
            f"{', '.join(sorted(table))}."
        )
    return choice
