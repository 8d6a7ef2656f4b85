"""Training data, whichever of the layouts it has."""

from pathlib import Path

from codesign.flow.checks import check_path
from codesign.flow.sources.dsec import DsecWindows
from codesign.flow.sources.mvsec import DATA, MvsecWindows
from codesign.flow.sources.packet import PacketOptions
from codesign.flow.sources.recorded import WINDOW_S, RecordingWindows
from codesign.flow.sources.rendered import DatasetWindows


def open_windows(
    folder: str | Path,
    bins: int = 8,
    window_frames: int = 1,
    crop_px: tuple[int, int] | None = None,
    seed: int = 0,
    window_s: float = WINDOW_S,
) -> DatasetWindows | DsecWindows | MvsecWindows | RecordingWindows:
    """The source of windows that a folder or file is: one of our data sets, DSEC, MVSEC, or a recording.

    Args: bins: of the volumes. window_frames: frame intervals per window (our data sets), or grey frames
      (MVSEC); DSEC has its own windows.
      crop_px: (height, width) of a piece at a random place, or None. seed: of that place.
      window_s: length of the windows of a recording, seconds.
    Returns: DatasetWindows, DsecWindows, MvsecWindows or RecordingWindows: ``len(source)`` and
      ``source.batch(indices)``.
    Raises: FileFormatError when nothing of these is there, or something in it is missing or damaged.
    """
    folder = check_path(folder, "the data set or recording")
    if (folder / "manifest.json").is_file() or (folder / "frames.h5").is_file():
        return DatasetWindows(folder, bins, window_frames, crop_px=crop_px, seed=seed)
    if next(folder.rglob(f"*{DATA}"), None) is not None:
        return MvsecWindows(folder, window_frames, bins, crop_px, seed)
    if next(folder.rglob("forward_timestamps.txt"), None) is not None:
        return DsecWindows(folder, bins, crop_px, seed)
    return RecordingWindows(folder, bins, crop_px, seed, PacketOptions(window_s=window_s))
