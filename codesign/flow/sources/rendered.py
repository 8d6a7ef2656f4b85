"""Windows of the data sets that studies.make_dataset writes (docs/datasets.md): events, true flow
over one frame interval or several, and the frames."""

import shlex
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.polynomial import chebyshev
from torch import Tensor

from codesign import shipped
from codesign.checks import check_whole
from codesign.errors import DomainError, FileFormatError
from codesign.events.formats.hdf5 import Hdf5Events
from codesign.events.formats.hdf5_rows import Rows
from codesign.flow.checks import MOST_STEPS
from codesign.flow.sources.windows import Recording, Windows
from codesign.flow.warp import chained
from codesign.reading import read_json, reading
from codesign.types import EventStream

FORMAT = "codesign-dataset/1"
# of the fit of a camera
DEGREE = 11
LARGEST_ERROR_PX = 1e-2
STEPS = 3
BEYOND = 1.2  # of the half field, up to where the fit is used
MOST_SIDE = 48  # pixels a side that are fitted


class DatasetWindows(Windows):
    """Windows of all sequences of a data set, one after the other.

    Args:
      folder: a data set (with manifest.json) or one sequence of it.
      bins: of the volumes.
      window_frames: frame intervals per window.
      crop_px: (height, width) of a piece at a random place, or None.
      seed: of that place.
    Raises: FileFormatError, before anything is read in earnest, for files that are missing, cut, or
      do not fit together; DomainError for sequences too short.

    Flow over one interval is the stored one. Over several, points of the static world are carried
    there by depth and poses through the camera's rays (exact to the fit of the camera,
    CameraFit.error_px); points of moving objects, whose poses are not stored, along the flows in
    between (``warp.chained``).
    """

    def __init__(
        self,
        folder: str | Path,
        bins: int = 8,
        window_frames: int = 1,
        crop_px: tuple[int, int] | None = None,
        seed: int = 0,
    ) -> None:
        check_whole(window_frames, "window_frames", 1, MOST_STEPS)
        sequences = [Sequence(place, sizes) for place, sizes in _places(Path(folder))]
        windows = [
            (k, tuple(sequence.times_us[[first, last]].tolist()), first, last)
            for k, sequence in enumerate(sequences)
            for first, last in pairwise(range(0, sequence.count, window_frames))
        ]
        if not windows:
            raise DomainError(
                f"no sequence of {folder} has the {window_frames + 1} frames that windows of "
                f"{window_frames} interval(s) need."
            )
        super().__init__(sequences, windows, bins, crop_px, seed)


class Sequence(Recording):
    """One sequence folder. times_us: [T] frame times. size_px: (height, width). count: T."""

    def __init__(self, folder: Path, sizes: dict[str, int] | None = None) -> None:
        self.folder = folder
        for name in ("frames.h5", "events.h5", "camera.h5"):
            if not (folder / name).is_file():
                raise FileFormatError(
                    f"{folder} lacks {name}; copy the sequence again, or make the data set anew."
                )
            found = (folder / name).stat().st_size
            if sizes is not None and found != sizes.get(name):
                raise FileFormatError(
                    f"{folder / name} has {found} bytes, {sizes.get(name)} by the manifest; it was cut or "
                    "changed."
                )
        path = folder / "frames.h5"
        self.rows = {"frames": Rows(path, "frames")}
        if len(self.rows["frames"].shape) != 3:
            raise FileFormatError(
                f"{path}: frames has shape {list(self.rows['frames'].shape)}; [T, H, W] is needed."
            )
        self.count, *size = self.rows["frames"].shape
        self.size_px = tuple(size)
        for name, shape, count in (
            ("depth", size, self.count),
            ("object_id", size, self.count),
            ("flow", [2, *size], self.count - 1),
            ("valid", size, self.count - 1),
            ("occluded", size, self.count - 1),
            ("poses", [4, 4], self.count),
            ("timestamps", [], self.count),
        ):
            self.rows[name] = Rows(path, name, shape, count)
        self.times_us = self.rows["timestamps"].read(0, self.count).astype(np.int64)
        self.poses = self.rows["poses"].read(0, self.count)
        if bool((np.diff(self.times_us) <= 0).any()) or not np.isfinite(self.poses).all():
            raise FileFormatError(
                f"{path}: its frame times do not rise, or its poses are not finite; the file is damaged."
            )
        self.events = Hdf5Events(folder / "events.h5")
        camera = {
            name: Rows(folder / "camera.h5", name, [size[1], 3], size[0]).read(0, size[0])
            for name in ("direction", "origin_m")
        }
        self.rays = camera
        self.fit = None

    def within(self, t0_us: int, t1_us: int) -> EventStream:
        """Events of a window: those at its start belong to the interval that ends there, as the
        sensor made them (``events.to_counts``)."""
        return self.events.window(t0_us + 1, t1_us, self.size_px)

    def frames(self, first: int, last: int) -> Tensor:
        """[2, H, W] at both ends."""
        return self._finite(
            "frames", torch.from_numpy(np.stack([self.rows["frames"][k] for k in (first, last)]))
        )

    def flow(self, first: int, last: int) -> tuple[Tensor, Tensor]:
        """(flow_px [2, H, W] float32, valid [H, W]) on the pixels of frame ``first``, to frame
        ``last``."""
        if last == first + 1:
            flow, seen = (torch.from_numpy(self.rows[name][first]) for name in ("flow", "valid"))
        else:
            moving = torch.from_numpy(self.rows["object_id"][first]) > 0
            flow, seen = self.carried(first, last)
            if bool(moving.any()):
                flows, valid, occluded = (
                    torch.from_numpy(self.rows[name].read(first, last))
                    for name in ("flow", "valid", "occluded")
                )
                moving_flow, followed = chained(flows.double(), valid, occluded)
                flow = torch.where(moving, moving_flow, flow)
                seen = torch.where(moving, followed, seen)
        self._finite("flow marked as valid", flow[:, seen])
        return flow.float(), seen

    def _finite(self, name, values):
        if not bool(values.isfinite().all()):
            raise FileFormatError(
                f"{self.folder / 'frames.h5'} holds {name} that is NaN or infinite; make the sequence anew."
            )
        return values

    def carried(self, first: int, last: int) -> tuple[Tensor, Tensor]:
        """Flow of points at rest, by their depth, both poses and the camera's rays: [2, H, W]
        float64, valid [H, W]."""
        if self.fit is None:
            self.fit = CameraFit(
                self.rays["direction"], self.rays["origin_m"], str(self.folder / "camera.h5")
            )
        depth = self.rows["depth"][first].astype(np.float64)
        direction = self.rays["direction"]
        origin = self.rays["origin_m"]
        height, width = self.size_px
        # depth counts along the camera's z axis
        scale = (depth - origin[..., 2]) / direction[..., 2]
        points = (origin + scale[..., None] * direction).reshape(-1, 3)
        T_last_first = np.linalg.inv(self.poses[last]) @ self.poses[first]
        landed = self.fit.project(points @ T_last_first[:3, :3].T + T_last_first[:3, 3]).reshape(
            height, width, 2
        )
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        flow = (landed - np.stack([x, y], -1)).transpose(2, 0, 1)
        valid = np.isfinite(flow).all(0) & (depth > 0)
        return torch.from_numpy(np.where(valid, flow, 0.0)), torch.from_numpy(valid)


class CameraFit:
    """Where points land in the picture of a recorded camera, from the chief rays of its pixels.

    Pixels are fitted as a polynomial of the rays' slopes, and the rays' origins as one of the
    pixels, so that points between pixels, and a little beside the picture, can be projected without
    the lens. The worst error of the fit is known, and what is worse than asked is refused. Args:
      direction, origin_m: [H, W, 3] of the chief rays in camera axes (x right, y down, z forward).
    name: for messages.

    error_px: largest distance between a pixel and where its own ray is projected to.
    Raises: FileFormatError when rays point backwards or the fit is worse than 0.01 px.
    """

    def __init__(
        self,
        direction: np.ndarray,
        origin_m: np.ndarray,
        name: str = "the camera",
    ) -> None:
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
            np.unique(np.linspace(0, n - 1, min(n, MOST_SIDE)).round().astype(int))
            for n in (height, width)
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
            # the pupil moves little over the field, so each step gains orders of magnitude
            for _ in range(STEPS):
                ray = points - origin
                slope = np.where(ray[:, 2:] > 0, ray[:, :2] / ray[:, 2:], np.nan)
                pixel = _value((slope - self.middle) / self.half, self.to_pixel)
                origin = _value(np.clip(2 * pixel / self.size - 1, -BEYOND, BEYOND), self.to_origin)
                origin = np.where(np.isfinite(origin), origin, 0.0)
        return pixel


def _fitted(unit, values, degree):
    """Coefficients [n, n, K] of Chebyshev products of total degree up to n - 1, for values [N, K]
    at places [N, 2] in [-1, 1]."""
    numbers = np.arange(degree + 1)
    kept = np.add.outer(numbers, numbers).ravel() <= degree
    design = chebyshev.chebvander2d(*unit.T, [degree, degree])[:, kept]
    coefficients = np.zeros((len(kept), values.shape[1]))
    coefficients[kept] = np.linalg.lstsq(design, values, rcond=None)[0]
    return coefficients.reshape(degree + 1, degree + 1, -1)


def _value(unit, coefficients):
    """Values [N, K]; NaN beyond BEYOND, where polynomials run away."""
    degree = coefficients.shape[0] - 1
    count = coefficients.shape[2]
    unit = np.where(np.abs(unit) <= BEYOND, unit, np.nan)
    # [n, N]: rows are long, which is fast
    one, two = (np.ascontiguousarray(chebyshev.chebvander(unit[:, k], degree).T) for k in (0, 1))
    # torch's threads are the caller's choice, NumPy's are not
    half = torch.from_numpy(coefficients.reshape(degree + 1, -1).T.copy()) @ torch.from_numpy(one)
    half = half.numpy().reshape(degree + 1, count, -1)
    return np.stack([(half[:, k] * two).sum(0) for k in range(count)], -1)


def _places(folder):
    """[(sequence folder, {file: bytes by the manifest} or None)]."""
    if (folder / "frames.h5").is_file():
        return [(folder, None)]
    path = folder / "manifest.json"
    if not path.is_file():
        raise FileFormatError(
            f"{folder} is no data set: it has no manifest.json, so it was not finished; "
            f"finish it with: {shipped.command('make_dataset')} --resume {shlex.quote(str(folder))}"
        )
    manifest = read_json(path)
    with reading(path, "it is no manifest of a data set; make the data set anew"):
        kind = manifest["format"]
        sequences = [str(name) for name in manifest["sequences"]]
        files = {name: int(entry["bytes"]) for name, entry in manifest["files"].items()}
    outside = [name for name in sequences if Path(name).name != name]
    if outside:
        raise FileFormatError(
            f"{path} names {outside[0]!r}, which is no folder of its own; make the data set anew."
        )
    if kind != FORMAT:
        raise FileFormatError(f"{path} says format {kind!r}; {FORMAT!r} is read.")
    return [
        (
            folder / name,
            {
                file[len(name) + 1 :]: size
                for file, size in files.items()
                if file.startswith(f"{name}/")
            },
        )
        for name in sequences
    ]
