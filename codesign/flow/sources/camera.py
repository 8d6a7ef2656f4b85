"""The camera of a recording: a pinhole with radial and tangential distortion, as in calib.txt (fx
fy cx cy k1 k2 p1 p2 k3), and how it turned: from its gyroscope (imu.txt) or from recorded poses
(groundtruth.txt)."""

import math
import warnings
from dataclasses import dataclass
from itertools import accumulate
from operator import mul
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from codesign.checks import check_kind, check_path
from codesign.errors import DomainError, FileFormatError
from codesign.reading import open_regular, read_text, reading

# of a calibration, and of a table of motion
MOST_BYTES = 100_000
MOST_TABLE_BYTES = 2_000_000_000
# of the inverse of the distortion
STEPS = 50
RESIDUAL_PX = 1e-6
LARGEST_GAP_S = 0.1  # between samples that are interpolated
UNIT_TOLERANCE = 1e-2  # of a quaternion's length
LARGEST = 1e15  # of a time, rate or place: products of two stay finite


@dataclass(frozen=True)
class Calibration:
    """focal_px: (fx, fy). centre_px: (cx, cy). distortion: (k1, k2, p1, p2, k3), dimensionless.
    Source:
    Brown, Photogrammetric Engineering 1966."""

    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    distortion: tuple[float, ...] = (0.0,) * 5

    def distorted(self, slopes: np.ndarray) -> np.ndarray:
        """Image slopes [..., 2] (x/z, y/z) to those the lens makes of them."""
        k1, k2, p1, p2, k3 = self.distortion
        x = slopes[..., 0]
        y = slopes[..., 1]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            -1,
        )

    def project(self, directions: np.ndarray) -> np.ndarray:
        """Pixels [..., 2] of directions [..., 3] in camera axes (x right, y down, z forward); NaN
        behind the camera."""
        z = np.where(directions[..., 2:] > 0, directions[..., 2:], np.nan)
        return self.distorted(directions[..., :2] / z) * self.focal_px + self.centre_px

    def directions(self, height_px: int, width_px: int) -> np.ndarray:
        """Direction with z = 1 of every pixel, [H, W, 3]; NaN where the distortion has no
        inverse."""
        x, y = np.meshgrid(
            np.arange(width_px, dtype=np.float64), np.arange(height_px, dtype=np.float64)
        )
        wanted = (np.stack([x, y], -1) - self.centre_px) / self.focal_px
        slopes = wanted.copy()
        with np.errstate(over="ignore", invalid="ignore"):  # what runs away is marked below
            for _ in range(STEPS):
                slopes = slopes + (wanted - self.distorted(slopes))
            error_px = np.abs((self.distorted(slopes) - wanted) * self.focal_px).max(-1)
        slopes[~(error_px < RESIDUAL_PX)] = np.nan
        return np.concatenate([slopes, np.ones_like(slopes[..., :1])], -1)

    def rotation_flow(
        self, R_later_earlier: np.ndarray, height_px: int, width_px: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Flow of a camera that turns before a scene so far that its translation does not matter.

        Args:
          R_later_earlier: [3, 3], takes directions in the camera's axes at the start to those at
            the end.
        Returns: flow_px [2, H, W] float64, 0 where not valid; valid [H, W].
        """
        rays = self.directions(height_px, width_px)
        x, y = np.meshgrid(np.arange(width_px), np.arange(height_px))
        flow = (
            self.project(rays @ np.asarray(R_later_earlier).T) - np.stack([x, y], -1)
        ).transpose(2, 0, 1)
        valid = np.asarray(np.isfinite(flow).all(0))
        return np.where(valid, flow, 0.0), valid

    def raw_flow(self, flow_px: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Flow of undistorted pixels carried to the sensor's own.

        Args:
          flow_px: [2, H, W] on the pixels of a pinhole with these focal lengths and this centre.
          valid: [H, W].
        Returns: flow_px [2, H, W] on the pixels as the lens makes them, 0 where not valid; valid
          [H, W], where the four undistorted pixels around are.
        """
        height, width = valid.shape
        slopes = self.directions(height, width)[..., :2]
        place = slopes * self.focal_px + self.centre_px
        # -1: beside the picture
        at = np.where(np.isfinite(place), place, -1.0)[..., ::-1].transpose(2, 0, 1)
        known = scipy.ndimage.map_coordinates(valid.astype(float), at, order=1, cval=0.0) > 1 - 1e-9
        shown = np.where(valid, flow_px, 0.0)
        read = np.stack([scipy.ndimage.map_coordinates(part, at, order=1) for part in shown], -1)
        landed = (
            self.distorted((place + read - self.centre_px) / self.focal_px) * self.focal_px
            + self.centre_px
        )
        y, x = np.mgrid[:height, :width]
        raw = (landed - np.stack([x, y], -1)).transpose(2, 0, 1)
        known = known & np.isfinite(raw).all(0)
        return np.where(known, raw, 0.0), known


def read_calibration(path: str | Path) -> Calibration:
    """Calibration of a text file: fx fy cx cy, and where given k1 k2 p1 p2 and k3.

    Raises: FileFormatError for anything else.
    """
    path = check_path(path)
    with reading(path, "'fx fy cx cy k1 k2 p1 p2 k3' in pixels is needed"):
        words = read_text(path, MOST_BYTES).replace(",", " ").split()
        values = [float(word) for word in words if not word.endswith(":")]
    if (
        len(values) not in (4, 8, 9)
        or not all(map(math.isfinite, values))
        or not min(values[:2]) > 0
    ):
        raise FileFormatError(
            f"{path} holds {len(values)} numbers; fx fy cx cy k1 k2 p1 p2 k3 are needed (distortion or k3 "
            "may be left out), fx and fy above 0."
        )
    return Calibration(
        (values[0], values[1]), (values[2], values[3]), tuple((values[4:] + [0.0] * 5)[:5])
    )


def signed_axes(text: str) -> np.ndarray:
    """[3, 3] matrix of axes such as "xyz" or "-y+xz": row k says which of the sensor's axes is the
    camera's k-th.

    Raises: DomainError unless each of x, y, z appears once.
    """
    signs = []
    names = []
    sign = 1.0
    for letter in check_kind(text, str, "the gyroscope's axes").replace(" ", ""):
        if letter in "+-":
            sign = 1.0 if letter == "+" else -1.0
        else:
            signs = [*signs, sign]
            names = [*names, letter]
            sign = 1.0
    if sorted(names) != ["x", "y", "z"]:
        raise DomainError(
            f"gyro axes {text!r}: name each of x, y, z once, with a sign where needed, for example 'xyz' or "
            "'x-y-z'."
        )
    return np.array(
        [
            [value * (name == axis) for axis in "xyz"]
            for name, value in zip(names, signs, strict=True)
        ]
    )


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

        Raises: FileFormatError when the window is not covered by samples, or lies across a gap of
          more than 0.1 s.
        """
        reason = self.missing(t0_s, t1_s)
        if reason:
            raise FileFormatError(f"{reason}; choose windows inside.")
        first, last = self._around(t0_s, t1_s)
        between = slice(first, last + 1)
        turns = scipy.spatial.transform.Slerp(self.t_s[between], self.turns[between])
        turns = turns(np.array([t0_s, t1_s]))
        return (turns[1].inv() * turns[0]).as_matrix()

    def missing(self, t0_s: float, t1_s: float) -> str:
        """Why a window cannot be told of, in words: it is not covered by samples, or lies across a
        gap of more than 0.1 s; empty where it can."""
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
        """Distance between the camera's places at both times, metres; None where nobody recorded
        it. Linear between samples."""
        if self.position_m is None:
            return None
        places = np.array(
            [np.interp([t0_s, t1_s], self.t_s, column) for column in self.position_m.T]
        )
        return float(np.linalg.norm(places[:, 1] - places[:, 0]))


def read_gyroscope(path: str | Path, axes: str = "xyz") -> Attitude:
    """Attitude of ``t ax ay az gx gy gz`` (seconds, m/s^2, rad/s): rates integrated from sample to
    sample, each interval at the mean of its ends. The gyroscope's offset is not removed.

    axes: the camera's from the gyroscope's, as ``signed_axes`` takes them.
    """
    turned = signed_axes(axes)
    table = _table(path, 7, "t ax ay az gx gy gz")
    t_s = table[:, 0]
    rate = table[:, 4:] @ turned.T
    rotation = scipy.spatial.transform.Rotation
    steps = rotation.from_rotvec((rate[1:] + rate[:-1]) / 2 * np.diff(t_s)[:, None])
    turns = accumulate(steps, mul, initial=rotation.identity())
    return Attitude(t_s, rotation.concatenate(list(turns)), None, str(path))


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
    turns = scipy.spatial.transform.Rotation.from_quat(table[:, 4:])
    return Attitude(table[:, 0], turns, table[:, 1:4], str(path))


def _table(path, columns, names):
    """[N >= 2, columns] finite numbers with rising times in the first column; repeated times are
    left out after the first."""
    path = check_path(path)
    with (
        open_regular(path, MOST_TABLE_BYTES) as file,
        reading(path, f"lines of '{names}' are needed"),
    ):
        delimiter = "," if b"," in file.read(400) else None
        file.seek(0)
        with warnings.catch_warnings():
            # of a file without a number, which is refused below
            warnings.simplefilter("ignore", UserWarning)
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
