"""Pixels of a sensor, windows on it, and the one low-discrepancy pattern over film and pupil that
all pixels, all frames and both sides of a difference share."""

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from codesign.backend import memory_bytes
from codesign.checks import check_number, check_whole
from codesign.errors import DomainError

# origin, direction and weight of a ray in float64, and its film and pupil position; tracing takes
# more
BYTES_PER_RAY = 88
# beyond them a pitch is in metres or micrometres by mistake
LEAST_PITCH_MM, MOST_PITCH_MM = 1e-4, 1e2
R2 = (0.7548776662466927, 0.5698402909980532)  # 1 / g, 1 / g^2 with g^3 = g + 1


@dataclass(frozen=True)
class Film:
    """Pixels of a sensor, or of rectangular windows on it.

    windows_px: tuple of (left, top); each window has height_px rows and width_px columns. A pixel's
    coordinate is that of its centre: column 0 of the full sensor is x = 0, and the lens axis is at
    the sensor's middle. device: where its coordinates are; of ``Camera.film`` that of the lens.
    """

    sensor_width_px: int
    sensor_height_px: int
    width_px: int
    height_px: int
    pixel_pitch_mm: float
    windows_px: tuple[tuple[int, int], ...] | None = None
    device: Any = field(default="cpu", compare=False, repr=False)

    def check(self) -> "Film":
        """Raise DomainError unless there are pixels and every window lies on the sensor; returns
        the film."""
        for label in ("sensor_width_px", "sensor_height_px", "width_px", "height_px"):
            check_whole(getattr(self, label), f"camera: {label}")
        check_number(self.pixel_pitch_mm, "camera: pixel_pitch_mm", LEAST_PITCH_MM, MOST_PITCH_MM)
        if self.windows_px is not None and len(self.windows_px) == 0:
            raise DomainError(
                "camera: there is no window on the film; give at least one, or None for the whole sensor."
            )
        for window in self.windows_px or ((0, 0),):
            if not (isinstance(window, tuple | list) and len(window) == 2):
                raise DomainError(
                    f"camera: the window {window!r} is no pair (left, top) of pixels; give one."
                )
            left, top = window
            for edge in window:
                check_number(edge, "camera: the edge of a window")
            if not (
                0 <= left <= self.sensor_width_px - self.width_px
                and 0 <= top <= self.sensor_height_px - self.height_px
            ):
                raise DomainError(
                    f"camera: the window ({left}, {top}) of {self.width_px} x {self.height_px} pixels does "
                    f"not lie on the sensor of {self.sensor_width_px} x {self.sensor_height_px}; move or "
                    "shrink it."
                )
        return self

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one image: (H, W) for the whole sensor, (windows, H, W) for windows
        (one window too)."""
        return (
            (self.height_px, self.width_px)
            if self.windows_px is None
            else (len(self.windows_px), self.height_px, self.width_px)
        )

    @property
    def sensor_px(self) -> Tensor:
        """Width and height of the sensor, [2] float64."""
        return self._tensor((self.sensor_width_px, self.sensor_height_px))

    def _tensor(self, numbers):
        return torch.tensor(numbers, dtype=torch.float64, device=self.device)

    @property
    def middle_px(self) -> Tensor:
        """Where the lens axis meets the sensor, [2] float64."""
        return (self.sensor_px - 1) / 2

    def pixels(self) -> Tensor:
        """Coordinates (x, y) of all pixel centres on the full sensor, [P, 2] float64, in image
        order."""
        rows, columns = (
            torch.arange(n, dtype=torch.float64) for n in (self.height_px, self.width_px)
        )
        return self.in_windows(rows, columns)

    @property
    def corners_px(self) -> Tensor:
        """First pixel (x, y) of every window, [W, 2] float64; that of the sensor without
        windows."""
        return self._tensor(self.windows_px or ((0, 0),))

    def in_windows(self, rows: Tensor, columns: Tensor) -> Tensor:
        """Coordinates (x, y) of these rows and columns of every window, [W x rows x columns, 2], in
        image order."""
        inside = torch.cartesian_prod(rows, columns).flip(1).to(self.device)
        return (self.corners_px[:, None] + inside).reshape(-1, 2)


def border_px(first_px: Tensor, size_px: Tensor, count: int) -> Tensor:
    """Coordinates [4 count, 2] along the border of a window of ``size_px`` [2] behind its
    ``first_px`` [2], half a pixel outside the outermost centres."""
    share = torch.linspace(0, 1, count, dtype=torch.float64, device=size_px.device)
    ends = [torch.full_like(share, end) for end in (0.0, 1.0)]
    sides = [torch.stack(pair, 1) for end in ends for pair in ((share, end), (end, share))]
    return first_px - 0.5 + torch.cat(sides) * size_px


def check_memory(film: Film, samples_per_pixel: int) -> None:
    """Raise DomainError when the rays of one frame cannot be in this machine's memory,
    BYTES_PER_RAY each."""
    count = math.prod(film.shape) * samples_per_pixel
    needed = count * BYTES_PER_RAY
    if needed > memory_bytes():
        raise DomainError(
            f"camera: {math.prod(film.shape):.3g} pixels of {samples_per_pixel} samples are {count:.3g} rays "
            f"per frame, at least {needed / 2**30:.3g} GiB; this machine has {memory_bytes() / 2**30:.3g} "
            "GiB: make the film smaller, look at windows of it (render.Film), or take fewer samples."
        )


def coarse_pixels(film: Film, every_px: int) -> Tensor:
    """Pixel coordinates [N, 2] on a grid over every window of the film, its last rows and columns
    included."""
    rows, columns = (
        torch.linspace(
            0, n - 1, max(1, math.ceil((n - 1) / every_px)) + (n > 1), dtype=torch.float64
        )
        for n in (film.height_px, film.width_px)
    )
    return film.in_windows(rows, columns)


def some_pixels(film: Film, most: int) -> Tensor:
    """Numbers [P] of at most so many pixels of a film, spread over it in both directions; all where
    there are no more. By the R2 sequence (Roberts, 2018): equal steps along the film's order may be
    whole rows, and then look along one line."""
    rows, columns = math.prod(film.shape[:-1]), film.shape[-1]
    if rows * columns <= most:
        return torch.arange(rows * columns)
    turns = torch.arange(1, most + 1, dtype=torch.float64)[:, None]
    share = (0.5 + turns * torch.tensor(R2, dtype=torch.float64)) % 1
    row, column = (share * torch.tensor([rows, columns])).long().T
    return (row * columns + column).unique()


def film_pupil_pattern(samples, seed, device="cpu"):
    """Scrambled Sobol points over pixel x pupil, the same on every device.

    Args: samples per pixel, seed.
    Returns: offset [samples, 2] in pixels, within [-1/2, 1/2); pupil [samples, 2] on the unit disc;
      float64. The same pattern in every pixel makes the sampled point spread the same everywhere: a
      static scene gives equal frames and a moving one no sampling flicker. A single sample is the
      pixel centre through the pupil centre.
    """
    if samples == 1:
        middle = torch.zeros(1, 2, dtype=torch.float64, device=device)
        return middle, middle.clone()
    points = torch.quasirandom.SobolEngine(4, scramble=True, seed=seed)
    points = points.draw(samples, dtype=torch.float64).to(device)
    return points[:, :2] - 0.5, concentric_disc(points[:, 2:])


def concentric_disc(unit):
    """Unit square to unit disc, area-preserving (Shirley and Chiu, 1997)."""
    a, b = (2 * unit - 1).unbind(1)
    wide = a.abs() > b.abs()
    radius = torch.where(wide, a, b)
    safe = torch.where(radius == 0, torch.ones_like(radius), radius)
    angle = torch.where(wide, math.pi / 4 * b / safe, math.pi / 2 - math.pi / 4 * a / safe)
    return torch.stack([radius * angle.cos(), radius * angle.sin()], 1)
