"""A folder of training data, whichever of the layouts it has."""

from pathlib import Path

from codesign.errors import FileFormatError
from codesign.flow.checks import check_path
from codesign.flow.sources.dsec import DsecWindows
from codesign.flow.sources.mvsec import DATA, MvsecWindows
from codesign.flow.sources.rendered import DatasetWindows


def open_windows(
    folder: str | Path,
    bins: int = 8,
    window_frames: int = 1,
    crop_px: tuple[int, int] | None = None,
    seed: int = 0,
) -> DatasetWindows | DsecWindows | MvsecWindows:
    """The source of windows that a folder is: one of our data sets, DSEC, or MVSEC.

    Args: bins: of the volumes. window_frames: frame intervals per window (our data sets), or grey frames
      (MVSEC); DSEC has its own windows.
      crop_px: (height, width) of a piece at a random place, or None. seed: of that place.
    Returns: DatasetWindows, DsecWindows or MvsecWindows: ``len(source)`` and ``source.batch(indices)``.
    Raises: FileFormatError when the folder is none of these, or something in it is missing or damaged.
    """
    folder = check_path(folder, "the folder")
    if not folder.is_dir():
        raise FileFormatError(f"no folder lies at {folder}; give the folder of a data set.")
    if (folder / "manifest.json").is_file() or (folder / "frames.h5").is_file():
        return DatasetWindows(folder, bins, window_frames, crop_px=crop_px, seed=seed)
    if next(folder.rglob(f"*{DATA}"), None) is not None:
        return MvsecWindows(folder, window_frames, bins, crop_px, seed)
    if next(folder.rglob("forward_timestamps.txt"), None) is not None:
        return DsecWindows(folder, bins, crop_px, seed)
    raise FileFormatError(
        f"{folder} is no data set that is known: manifest.json (ours), *{DATA} (MVSEC) and "
        "flow/forward_timestamps.txt (DSEC) are all absent."
    )
