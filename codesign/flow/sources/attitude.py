"""How the camera of a recording turned: from its gyroscope (imu.txt) or from recorded poses
(groundtruth.txt)."""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from codesign.errors import DomainError, FileFormatError, shown
from codesign.flow.checks import check_path
from codesign.reading import open_regular, reading

LARGEST_GAP_S = 0.1  # between samples that are interpolated
UNIT_TOLERANCE = 1e-2  # of a quaternion's length
LARGEST = 1e15  # of a time, rate or place: products of two stay finite
MOST_BYTES = 2_000_000_000


@dataclass(frozen=True)
class Attitude:
    """t_s: [N] rising seconds. turns: N rotations R_world_camera, interpolated along great circles.
    position_m: [N, 3], or None. name: the file."""

    t_s: np.ndarray
    turns: Any
    position_m: np.ndarray | None
    name: str

    def turn(self, t0_s: float, t1_s: float) -> np.ndarray:
        """R_later_earlier [3, 3]: takes directions in the camera's axes at t0 to those at t1.

        Raises: FileFormatError when the window is not covered by samples, or lies across a gap of more than
          0.1 s.
        """
        reason = self.missing(t0_s, t1_s)
        if reason:
            raise FileFormatError(f"{reason}; choose windows inside.")
        first, last = self._around(t0_s, t1_s)
        turns = Slerp(self.t_s[first : last + 1], self.turns[first : last + 1])(np.array([t0_s, t1_s]))
        return (turns[1].inv() * turns[0]).as_matrix()

    def missing(self, t0_s: float, t1_s: float) -> str:
        """Why a window cannot be told of, in words: it is not covered by samples, or lies across a gap of more
        than 0.1 s; empty where it can."""
        window = f"the window {t0_s:.6f} to {t1_s:.6f} s"
        if not (self.t_s[0] <= t0_s and t1_s <= self.t_s[-1]):
            return f"{self.name} covers {self.t_s[0]:.6f} to {self.t_s[-1]:.6f} s, not {window}"
        first, last = self._around(t0_s, t1_s)
        gap_s = float(np.diff(self.t_s[first : last + 1]).max())
        if gap_s > LARGEST_GAP_S:
            return f"{self.name} has no sample for {gap_s:.3f} s in {window}; at most {LARGEST_GAP_S} s are interpolated"
        return ""

    def _around(self, t0_s, t1_s):
        """Numbers of the samples around a window."""
        return np.searchsorted(self.t_s, t0_s, "right") - 1, np.searchsorted(self.t_s, t1_s, "left")

    def moved_m(self, t0_s: float, t1_s: float) -> float | None:
        """Distance between the camera's places at both times, metres; None where nobody recorded it. Linear
        between samples."""
        if self.position_m is None:
            return None
        places = np.array([np.interp([t0_s, t1_s], self.t_s, column) for column in self.position_m.T])
        return float(np.linalg.norm(places[:, 1] - places[:, 0]))


def read_gyroscope(path: str | Path, axes: np.ndarray | None = None) -> Attitude:
    """Attitude of ``t ax ay az gx gy gz`` (seconds, m/s^2, rad/s): rates integrated from sample to sample,
    each interval at the mean of its ends.

    Args: axes: [3, 3], camera axes from the gyroscope's (identity when None). The gyroscope's offset is not
      removed.
    """
    turned = np.eye(3) if axes is None else np.asarray(axes)
    if turned.shape != (3, 3) or turned.dtype.kind not in "fiu" or not np.isfinite(turned).all():
        raise DomainError(
            f"the gyroscope's axes are {shown(axes)}; a matrix [3, 3] of finite numbers is needed."
        )
    table = _table(path, 7, "t ax ay az gx gy gz")
    t_s = table[:, 0]
    rate = table[:, 4:] @ turned.T
    steps = Rotation.from_rotvec((rate[1:] + rate[:-1]) / 2 * np.diff(t_s)[:, None])
    turns = [Rotation.identity()]
    for step in steps:
        turns.append(turns[-1] * step)
    return Attitude(t_s, Rotation.concatenate(turns), None, str(path))


def read_poses(path: str | Path) -> Attitude:
    """Attitude of ``t px py pz qx qy qz qw`` (seconds, metres, quaternion of R_world_camera)."""
    table = _table(path, 8, "t px py pz qx qy qz qw")
    length = np.linalg.norm(table[:, 4:], axis=1)
    if bool((np.abs(length - 1) > UNIT_TOLERANCE).any()):
        at = int(np.argmax(np.abs(length - 1) > UNIT_TOLERANCE))
        raise FileFormatError(
            f"{path}, row {at + 1} of numbers: the quaternion has length {length[at]:.4g}, not 1; the order "
            "is qx qy qz qw."
        )
    return Attitude(table[:, 0], Rotation.from_quat(table[:, 4:]), table[:, 1:4], str(path))


def _table(path, columns, names):
    """[N >= 2, columns] finite numbers with rising times in the first column; repeated times are left out
    after the first."""
    path = check_path(path)
    with open_regular(path, MOST_BYTES) as file, reading(path, f"lines of '{names}' are needed"):
        delimiter = "," if b"," in file.read(400) else None
        file.seek(0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a file without a number, which is refused below
            table = np.loadtxt(file, ndmin=2, comments="#", delimiter=delimiter, encoding="utf-8")
    if table.shape[1] != columns or len(table) < 2 or not (np.abs(table) < LARGEST).all():
        raise FileFormatError(
            f"{path} has {len(table)} rows of {table.shape[1]} numbers; at least two rows of {columns} "
            f"finite ones are needed: '{names}'."
        )
    rises = np.diff(table[:, 0])
    if bool((rises < 0).any()):
        raise FileFormatError(
            f"{path}: the time of row {int(np.argmax(rises < 0)) + 2} lies before that of the row above."
        )
    return table[np.concatenate([[True], rises > 0])]
