"""The camera of a recording: a pinhole with radial and tangential distortion, as in calib.txt (fx fy cx cy k1
k2 p1 p2 k3)."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from codesign.errors import DomainError, FileFormatError
from codesign.flow.checks import check_kind, check_path
from codesign.reading import read_text, reading

MOST_BYTES = 100_000
STEPS = 50
RESIDUAL_PX = 1e-6


@dataclass(frozen=True)
class Calibration:
    """focal_px: (fx, fy). centre_px: (cx, cy). distortion: (k1, k2, p1, p2, k3), dimensionless. Source:
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
        """Pixels [..., 2] of directions [..., 3] in camera axes (x right, y down, z forward); NaN behind the
        camera."""
        z = np.where(directions[..., 2:] > 0, directions[..., 2:], np.nan)
        return self.distorted(directions[..., :2] / z) * self.focal_px + self.centre_px

    def directions(self, height_px: int, width_px: int) -> np.ndarray:
        """Direction with z = 1 of every pixel, [H, W, 3]; NaN where the distortion has no inverse."""
        x, y = np.meshgrid(np.arange(width_px, dtype=np.float64), np.arange(height_px, dtype=np.float64))
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

        Args: R_later_earlier: [3, 3], takes directions in the camera's axes at the start to those at the end.
        Returns: flow_px [2, H, W] float64, 0 where not valid; valid [H, W].
        """
        rays = self.directions(height_px, width_px)
        x, y = np.meshgrid(np.arange(width_px), np.arange(height_px))
        flow = (self.project(rays @ np.asarray(R_later_earlier).T) - np.stack([x, y], -1)).transpose(2, 0, 1)
        valid = np.asarray(np.isfinite(flow).all(0))
        return np.where(valid, flow, 0.0), valid

    def raw_flow(self, flow_px: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Flow of undistorted pixels carried to the sensor's own.

        Args: flow_px: [2, H, W] on the pixels of a pinhole with these focal lengths and this centre. valid: [H, W].
        Returns: flow_px [2, H, W] on the pixels as the lens makes them, 0 where not valid; valid [H, W], where the
          four undistorted pixels around are.
        """
        height, width = valid.shape
        slopes = self.directions(height, width)[..., :2]
        place = slopes * self.focal_px + self.centre_px
        at = np.where(np.isfinite(place), place, -1.0)[..., ::-1].transpose(2, 0, 1)  # -1: beside the picture
        known = map_coordinates(valid.astype(float), at, order=1, cval=0.0) > 1 - 1e-9
        read = np.stack([map_coordinates(part, at, order=1) for part in np.where(valid, flow_px, 0.0)], -1)
        landed = (
            self.distorted((place + read - self.centre_px) / self.focal_px) * self.focal_px + self.centre_px
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
    if len(values) not in (4, 8, 9) or not all(map(math.isfinite, values)) or not min(values[:2]) > 0:
        raise FileFormatError(
            f"{path} holds {len(values)} numbers; fx fy cx cy k1 k2 p1 p2 k3 are needed (distortion or k3 "
            "may be left out), fx and fy above 0."
        )
    return Calibration((values[0], values[1]), (values[2], values[3]), tuple((values[4:] + [0.0] * 5)[:5]))


def signed_axes(text: str) -> np.ndarray:
    """[3, 3] matrix of axes such as "xyz" or "-y+xz": row k says which of the sensor's axes is the camera's
    k-th.

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
        [[value * (name == axis) for axis in "xyz"] for name, value in zip(names, signs, strict=True)]
    )
