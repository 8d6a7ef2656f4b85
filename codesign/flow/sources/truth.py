"""Ground-truth flow of a recording by path: flow files of several kinds, tables of text, and
folders of them with their times."""

import io
import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from codesign.arrays import read_npy, read_npz
from codesign.checks import check_path
from codesign.errors import FileFormatError
from codesign.flow.checks import check_size
from codesign.flow.files import read_flow
from codesign.flow.sources import folders
from codesign.flow.sources.matlab import read_mat
from codesign.reading import open_regular, read_text, reading

ARRAYS = ("flow", "flow_px", "gt_flow", "flow_gt", "gt", "truth", "arr_0")
PAIRS = (
    ("x_flow_dist", "y_flow_dist"),
    ("x_flow", "y_flow"),
    ("flow_x", "flow_y"),
    ("vx", "vy"),
    ("u", "v"),
    ("vxGT", "vyGT"),
)
MASKS = ("valid", "mask", "valid_mask")
TIMES = ("timestamps", "t", "ts")
COLUMNS = {
    "vx": "u",
    "vy": "v",
    "flow_x": "u",
    "flow_y": "v",
    "u": "u",
    "v": "v",
    "x": "x",
    "y": "y",
    "valid": "valid",
    "t": "t",
    "p": "p",
}
TABLES = {
    2: ("u", "v"),
    4: ("x", "y", "u", "v"),
    5: ("x", "y", "u", "v", "valid"),
    6: ("t", "x", "y", "p", "u", "v"),
}
MOST_VALUES = 2_000_000_000
MOST_BYTES = 2_000_000_000  # of a table
MOST_COLUMNS = 1_000_000  # characters of its first line


@dataclass(frozen=True)
class TrueFlow:
    """One flow as its file has it.

    flow: [2, H, W], right and down, in the file's unit. valid: [H, W] bool. span_s: (from, to)
      seconds on the recording's clock; None where the file has no times, or one time only. name:
      the file, and which of its flows.
    """

    flow: np.ndarray
    valid: np.ndarray
    span_s: tuple[float, float] | None
    name: str


def read_truth(path: str | Path, size_px: tuple[int, int]) -> list[TrueFlow]:
    """Read the flow fields of a file or folder, in order.

    Args:
      path: .flo, .png (16 bits as in DSEC), .npy, .npz or .mat (up to version 7) ([2, H, W] or
        [H, W, 2], or several along a first axis; .npz also as a pair of components and with valid
        and timestamps, the layout of MVSEC among them), .txt or .csv (see docs/flow_recordings.md);
        or a folder of such files, with their times in timestamps.txt or forward_timestamps.txt.
      size_px: (height, width) of the recording, which tables of text need; every flow must have it.
    Returns: [TrueFlow]. Flows that are not finite are not valid; in MVSEC's layout neither are
      those of exactly (0, 0).
    Raises: FileFormatError for anything else.
    """
    path = check_path(path, "the path of the true flow")
    size_px = check_size(size_px, "the size of the recording")
    if path.is_dir():
        files = folders.flow_files(path)
        flows = [flow for file in files for flow in _of_file(file, size_px)]
        spans = _spans_beside(path, files[0].parent, len(flows))
        flows = (
            [replace(flow, span_s=span) for flow, span in zip(flows, spans, strict=True)]
            if spans
            else flows
        )
    elif path.is_file():
        flows = _of_file(path, size_px)
    else:
        raise FileFormatError(f"no ground truth lies at {path}; check the path.")
    for flow in flows:
        if flow.flow.shape[1:] != tuple(size_px):
            raise FileFormatError(
                f"{flow.name} has {flow.flow.shape[2]} x {flow.flow.shape[1]} pixels, the recording "
                f"{size_px[1]} x {size_px[0]}; give the sensor size if it was guessed."
            )
    return flows


def size_of(path: str | Path) -> tuple[int, int] | None:
    """(height, width) of the flow at a path, or None where it cannot tell by itself
    (tables of text)."""
    path = Path(path)
    file = folders.flow_files(path)[0] if path.is_dir() else path
    if not file.is_file() or file.suffix.lower() in (".txt", ".csv"):
        return None
    return _of_file(file, None)[0].flow.shape[1:]


def _of_file(path, size_px):
    suffix = path.suffix.lower()
    if suffix in (".flo", ".png"):
        flow, valid = read_flow(path)
        return [TrueFlow(flow.numpy(), valid.numpy(), None, str(path))]
    if suffix in (".npy", ".npz", ".mat"):
        return _of_arrays(path)
    if suffix in (".txt", ".csv"):
        return [_of_table(path, size_px)]
    raise FileFormatError(
        f"{path} ends in {path.suffix or 'nothing'!r}; ground truth is read from "
        f"{', '.join(sorted(folders.FLOW_SUFFIXES))}, imu.txt and groundtruth.txt."
    )


def _arrays(path) -> dict[str, np.ndarray]:
    """The arrays of a file by name; the only one of an .npy file as "arr_0"."""
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return {"arr_0": read_npy(path)}
    if suffix == ".mat":
        return read_mat(path)
    return read_npz(path)


def _of_arrays(path):
    arrays = _arrays(path)
    pair = next((pair for pair in PAIRS if set(pair) <= set(arrays)), None)
    name = next((name for name in ARRAYS if name in arrays), None)
    if pair:
        parts = [arrays[part] for part in pair]
        if parts[0].shape != parts[1].shape or parts[0].ndim not in (2, 3):
            raise FileFormatError(
                f"{path}: {pair[0]} and {pair[1]} have shapes {parts[0].shape} and {parts[1].shape}; two "
                "alike, [H, W] or [N, H, W], are needed."
            )
        flow = np.stack(parts, -3)
    elif name:
        flow = arrays[name]
    else:
        raise FileFormatError(
            f"{path} holds {', '.join(sorted(arrays)) or 'nothing'}; an array named {', '.join(ARRAYS)} or "
            f"a pair such as {', '.join(PAIRS[0])} is needed."
        )
    if flow.dtype.kind not in "fiu" or flow.ndim not in (3, 4) or flow.size > MOST_VALUES:
        raise FileFormatError(
            f"{path} holds a flow of {flow.dtype} {list(flow.shape)}; numbers [2, H, W] or [H, W, 2] are "
            "needed, or several of them."
        )
    flow = flow[None] if flow.ndim == 3 else flow
    if flow.shape[1] != 2:
        if flow.shape[3] not in (2, 3):
            raise FileFormatError(
                f"{path} holds a flow of shape {list(flow.shape)}; [2, H, W] or [H, W, 2] is needed, or "
                "several along a first axis."
            )
        flow = np.moveaxis(flow, 3, 1)  # a third channel says what is valid
    flow, third = flow[:, :2].astype(np.float64), flow[:, 2:]
    valid = np.asarray(np.isfinite(flow).all(1))
    if third.shape[1]:
        valid = valid & (third[:, 0] > 0)
    if pair == PAIRS[0]:
        valid &= (flow != 0).any(1)  # MVSEC writes (0, 0) where nothing was measured
    mask = next((arrays[mask] for mask in MASKS if mask in arrays), None)
    if mask is not None:
        if mask.shape not in (valid.shape, valid.shape[1:]):
            raise FileFormatError(
                f"{path}: the mask has shape {list(mask.shape)}, the flow's is {list(valid.shape)}."
            )
        valid &= mask.astype(bool)
    spans = _spans_of(path, arrays, len(flow))
    flow = np.where(valid[:, None], flow, 0.0)
    return [
        TrueFlow(flow[k], valid[k], spans[k], str(path) if len(flow) == 1 else f"{path} [{k}]")
        for k in range(len(flow))
    ]


def _spans_of(path, arrays, count):
    """[(from, to) or None] by the arrays t0 and t1, or by timestamps, at each of which a flow
    begins that ends at the next (MVSEC)."""
    if "t0" in arrays and "t1" in arrays:
        ends = np.stack([arrays["t0"].reshape(-1), arrays["t1"].reshape(-1)], -1).astype(np.float64)
        return _checked_spans(path, ends, count)
    times = next(
        (arrays[name].reshape(-1).astype(np.float64) for name in TIMES if name in arrays), None
    )
    if times is None:
        return [None] * count
    if len(times) == count + 1 or (len(times) == count and count > 1):
        ends = np.stack([times[:-1], times[1:]], -1)
        spans = _checked_spans(path, ends, len(ends))
        return spans if len(spans) == count else [*spans, None]
    if len(times) == 2 * count:
        return _checked_spans(path, times.reshape(count, 2), count)
    return [None] * count


def _spans_beside(folder, inside, count):
    """``read_spans`` of the text file of times of a folder; None without one."""
    names = ("forward_timestamps.txt", "timestamps.txt")
    files = (place / name for place in (inside, inside.parent, folder) for name in names)
    file = next(filter(Path.is_file, files), None)
    return None if file is None else read_spans(file, count)


def read_spans(path: Path, count: int) -> list[tuple[float, float]]:
    """[(from, to)] seconds of ``count`` flows by lines of two times, or of one and one more than
    there are flows; whole numbers are microseconds.

    Raises: FileFormatError for anything else.
    """
    with reading(path, "it is no list of times: lines of 'from, to' are needed"):
        lines = [line.strip() for line in read_text(path).splitlines()]
        rows = [re.split(r"[,\s]+", line) for line in lines if line and not line.startswith("#")]
        ends = np.array(rows, np.float64)
    if ends.shape == (count + 1, 1):
        ends = np.concatenate([ends[:-1], ends[1:]], 1)
    return _checked_spans(path, ends, count)


def _checked_spans(path, ends, count):
    """Spans in seconds; whole numbers are microseconds."""
    fits = ends.shape == (count, 2) and np.isfinite(ends).all()
    if not fits or bool((ends[:, 1] <= ends[:, 0]).any()):
        raise FileFormatError(
            f"{path}: times of shape {list(ends.shape)} for {count} flow(s); each flow needs a time from "
            "and a later time to."
        )
    ends = ends / 1e6 if bool((ends % 1 == 0).all()) and float(ends.max()) >= 1000 else ends
    return [(float(first), float(last)) for first, last in ends]


def _of_table(path, size_px):
    """A flow as lines of numbers."""
    with open_regular(path, MOST_BYTES) as opened, reading(path, "it is no table of numbers"):
        file = io.TextIOWrapper(opened, encoding="utf-8")
        first = file.readline(MOST_COLUMNS)
        words = first.lstrip("# ").replace(",", " ").lower().split()
        header = bool(words) and not re.fullmatch(
            r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf", words[0]
        )
        if not header:
            file.seek(0)
        with warnings.catch_warnings():
            # of a file without a number, which is refused below
            warnings.simplefilter("ignore", UserWarning)
            table = np.loadtxt(file, ndmin=2, delimiter="," if "," in first else None)
    height, width = size_px
    if not header and table.shape == (2 * height, width):
        return _whole(path, table.reshape(2, height, width))
    names = (
        tuple(COLUMNS.get(word, "?") for word in words)
        if header
        else TABLES.get(table.shape[1], ())
    )
    columns = dict(zip(names, table.T, strict=False))
    if (
        not len(columns) == len(names) == table.shape[1]
        or not {"u", "v"} <= columns.keys()
        or ("x" in columns) != ("y" in columns)
    ):
        raise FileFormatError(
            f"{path} has {table.shape[0]} lines of {table.shape[1]} numbers; 'u v' for all pixels row by "
            f"row, 'x y u v', 'x y u v valid', 't x y p u v' or 2 x {height} lines of {width} are read."
        )
    uv = np.stack([columns["u"], columns["v"]])
    if "x" not in columns:
        if len(table) not in (1, height * width):
            raise FileFormatError(
                f"{path} has {len(table)} lines of 'u v'; one for all pixels or {height * width} ({height} "
                f"rows of {width}) are needed."
            )
        return _whole(path, np.broadcast_to(uv, (2, height * width)).reshape(2, height, width))
    x, y = columns["x"], columns["y"]
    outside = ~((x % 1 == 0) & (y % 1 == 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height))
    if bool(outside.any()):
        raise FileFormatError(
            f"{path}, row {int(np.argmax(outside)) + 1} of numbers: pixel ({x[outside][0]:g}, "
            f"{y[outside][0]:g}) is none of a sensor of {width} x {height}."
        )
    use = np.isfinite(uv).all(0) & (columns.get("valid", np.ones(1)) > 0)
    cell = (y * width + x).astype(np.int64)[use]
    sums = np.stack([np.bincount(cell, part[use], height * width) for part in uv])
    # the mean of several flows of a pixel, NaN where there is none
    with np.errstate(invalid="ignore"):
        flow = sums / np.bincount(cell, minlength=height * width)
    return _whole(path, flow.reshape(2, height, width))


def _whole(path, flow):
    """The flow of a file where it is finite."""
    valid = np.isfinite(flow).all(0)
    return TrueFlow(np.where(valid, flow, 0.0), valid, None, str(path))
