"""A recording of a DAVIS camera: grey frames and the events between them, on one clock."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from codesign import events
from codesign.arrays import open_npz
from codesign.errors import FileFormatError, ShapeError
from codesign.events.formats.aedat import read_frames
from codesign.types import EventStream

PLACE = Path("shared") / "data" / "davis346_newton_cradle" / "demo-01.npz"
PUBLISHED = (
    "The one of docs/sensor_fit.md is published as data/demo/samples/demo-01.aedat4 of "
    "github.com/KugaMaxx/cuke-emlb."
)
ENTRIES = ("t", "x", "y", "p", "frames", "exposure")


@dataclass(frozen=True)
class Recording:
    """Frames and events of one camera.

    frames: [T, H, W] float32, 0 to 255. mid_s: [T] float64, middle of each frame's exposure.
      exposure_s: length of the first frame's exposure.
    stream: EventStream on the same clock.
    """

    frames: Tensor
    mid_s: Tensor
    exposure_s: float
    stream: EventStream

    def counts(self):
        """Recorded events between consecutive mid-exposures: [T-1, 2, H, W], ON first."""
        return events.to_counts(self.stream, self.mid_s)


def default_path():
    """The recording beside the repository (or in it), where there is one."""
    root = Path(__file__).resolve().parents[2]
    found = [place / PLACE for place in (root.parent, root)]
    return next((path for path in found if path.is_file()), found[0])


def load(path):
    """Read a recording.

    Args:
      path: .aedat4 with frames, or .npz with t (us), x, y, p (0 or 1), frames [T, H, W] uint8 and
        exposure [T, 2] (us, start and end).
    Returns: Recording.
    Raises: FileFormatError when the file is missing or of another kind; ShapeError for fewer than
      five frames or frames of another size than the events'.
    """
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(
            f"the recording is not there ('{path}'); give the path of an .aedat4 or .npz file with frames and "
            f"events by --recording. {PUBLISHED}"
        )
    frames, exposure_us, stream = (
        _read_aedat4(path) if path.suffix == ".aedat4" else _read_npz(path)
    )
    if len(frames) < 5:
        raise ShapeError(
            f"'{path}' has {len(frames)} frame(s); at least 5 are needed, so that either half has two "
            "intervals."
        )
    if tuple(frames.shape[1:]) != (stream.height_px, stream.width_px):
        raise ShapeError(
            f"'{path}' has frames of {list(frames.shape[1:])} pixels and events of a sensor with "
            f"{[stream.height_px, stream.width_px]}; one camera is needed."
        )
    exposure_s = exposure_us.double() * 1e-6
    return Recording(
        frames.float(), exposure_s.mean(1), float(exposure_s[0, 1] - exposure_s[0, 0]), stream
    )


def _read_npz(path):
    with open_npz(path, f"a recording holds {', '.join(ENTRIES)}") as data:
        frames, exposure_us = (torch.from_numpy(data.read(name)) for name in ("frames", "exposure"))
    if frames.dtype != torch.uint8:
        raise FileFormatError(
            f"'{path}' has frames of {frames.dtype}; uint8 is needed, digital values from 0 to 255."
        )
    if frames.ndim != 3 or exposure_us.shape != (len(frames), 2):
        raise FileFormatError(
            f"'{path}' has frames {list(frames.shape)} and exposure {list(exposure_us.shape)}; [T, H, W] "
            "and [T, 2] are needed."
        )
    return frames, exposure_us, events.read(path)


def _read_aedat4(path):
    recorded = read_frames(path)
    stream = events.read(path)
    # epoch times to times since the start
    start_us = min(int(stream.t_us.min()), int(recorded.exposure_start_us.min()))
    exposure_us = (
        torch.stack((recorded.exposure_start_us, recorded.exposure_end_us), dim=1) - start_us
    )
    return (
        recorded.frames,
        exposure_us,
        EventStream(
            stream.t_us - start_us, stream.x, stream.y, stream.p, stream.height_px, stream.width_px
        ),
    )
