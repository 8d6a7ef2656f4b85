"""Where points land in the picture of a recorded camera, from the chief rays of its pixels (camera.h5 of a
data set).

Pixels are fitted as a polynomial of the rays' slopes, and the rays' origins as one of the pixels, so that
points between pixels, and a little beside the picture, can be projected without the lens. The worst error of
the fit is known, and what is worse than asked is refused.
"""

import numpy as np
import torch
from numpy.polynomial import chebyshev

from codesign.errors import FileFormatError

DEGREE = 11
LARGEST_ERROR_PX = 1e-2
STEPS = 3
BEYOND = 1.2  # of the half field, up to where the fit is used
MOST_SIDE = 48  # pixels a side that are fitted


class CameraFit:
    """Args: direction, origin_m: [H, W, 3] of the chief rays in camera axes (x right, y down, z forward).
    name: for messages.

    error_px: largest distance between a pixel and where its own ray is projected to.
    Raises: FileFormatError when rays point backwards or the fit is worse than 0.01 px.
    """

    def __init__(self, direction: np.ndarray, origin_m: np.ndarray, name: str = "the camera") -> None:
        direction = np.asarray(direction, np.float64)
        origin = np.asarray(origin_m, np.float64)
        if (
            direction.ndim != 3
            or direction.shape[2] != 3
            or origin.shape != direction.shape
            or min(direction.shape[:2]) < 2
            or not np.isfinite(direction).all()
            or not (direction[..., 2] > 0).all()
        ):
            raise FileFormatError(
                f"{name} has rays of shapes {list(direction.shape)} and {list(origin.shape)}; [H, W, 3], "
                "finite and forward, are needed."
            )
        height, width = direction.shape[:2]
        x, y = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        slope = (direction[..., :2] / direction[..., 2:]).reshape(-1, 2)
        self.degree = min(DEGREE, height - 1, width - 1)
        self.middle = (slope.max(0) + slope.min(0)) / 2
        self.half = (slope.max(0) - slope.min(0)) / 2
        self.size = np.array([width - 1, height - 1], np.float64)
        pixels = np.stack([x, y], -1).reshape(-1, 2)
        rows, columns = (
            np.unique(np.linspace(0, n - 1, min(n, MOST_SIDE)).round().astype(int)) for n in (height, width)
        )
        some = (
            rows[:, None] * width + columns
        ).ravel()  # enough for the coefficients; the error below is that of all pixels
        self.to_pixel = _fitted((slope[some] - self.middle) / self.half, pixels[some], self.degree)
        self.to_origin = _fitted(
            2 * pixels[some] / self.size - 1, origin.reshape(-1, 3)[some], min(self.degree, 5)
        )
        far = origin.reshape(-1, 3) + 1e3 * direction.reshape(-1, 3)
        self.error_px = float(np.linalg.norm(self.project(far) - pixels, axis=1).max())
        if self.error_px > LARGEST_ERROR_PX:
            raise FileFormatError(
                f"the rays of {name} are fitted to {self.error_px:.3g} px only; at most {LARGEST_ERROR_PX} "
                "px is used for flow."
            )

    def project(self, points_m: np.ndarray) -> np.ndarray:
        """Pixels [N, 2] of points [N, 3] in camera axes; NaN for points behind the camera."""
        points = np.asarray(points_m, np.float64)
        origin = np.zeros_like(points)
        with np.errstate(invalid="ignore", divide="ignore"):
            for _ in range(
                STEPS
            ):  # the pupil moves little over the field, so each step gains orders of magnitude
                ray = points - origin
                slope = np.where(ray[:, 2:] > 0, ray[:, :2] / ray[:, 2:], np.nan)
                pixel = _value((slope - self.middle) / self.half, self.to_pixel)
                origin = _value(np.clip(2 * pixel / self.size - 1, -BEYOND, BEYOND), self.to_origin)
                origin = np.where(np.isfinite(origin), origin, 0.0)
        return pixel


def _fitted(unit, values, degree):
    """Coefficients [n, n, K] of Chebyshev products of total degree up to n - 1, for values [N, K] at places
    [N, 2] in [-1, 1]."""
    one, two = (chebyshev.chebvander(unit[:, k], degree) for k in (0, 1))
    kept = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    found = np.linalg.lstsq(np.stack([one[:, i] * two[:, j] for i, j in kept], -1), values, rcond=None)[0]
    coefficients = np.zeros((degree + 1, degree + 1, values.shape[1]))
    coefficients[tuple(np.array(kept).T)] = found
    return coefficients


def _value(unit, coefficients):
    """Values [N, K]; NaN beyond BEYOND, where polynomials run away."""
    degree = coefficients.shape[0] - 1
    count = coefficients.shape[2]
    unit = np.where(np.abs(unit) <= BEYOND, unit, np.nan)
    one, two = (
        np.ascontiguousarray(chebyshev.chebvander(unit[:, k], degree).T) for k in (0, 1)
    )  # [n, N]: rows are long, which is fast
    half = torch.from_numpy(coefficients.reshape(degree + 1, -1).T.copy()) @ torch.from_numpy(
        one
    )  # torch's threads are the caller's choice, NumPy's are not
    half = half.numpy().reshape(degree + 1, count, -1)
    return np.stack([(half[:, k] * two).sum(0) for k in range(count)], -1)
