"""What may enter a function of flow: volumes, flows, masks, numbers. Everything else is refused with a
sentence."""

import math
import os
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from codesign.errors import DomainError, FileFormatError, ShapeError, as_number, check_finite, shown
from codesign.events.entry import check_whole
from codesign.types import EventVolume, FlowField

Kind = TypeVar("Kind")
MOST_SIDE_PX = 2**15
MOST_STEPS = 1000  # of an iteration
COUNTS = (torch.float32, torch.float64)
MOST_EVENTS = 1e9  # of a pixel and bin: squares of it are far from overflow
LEAST_SPREAD = 0.01  # of the centroids, over the interval
NEGATIVE = -1e-3  # counts a hair below 0 are let through: steps of differences go there


def check_real(value: Any, name: str, dtypes: tuple[torch.dtype, ...] | None = None) -> Tensor:
    """``value`` unchanged when it is a dense tensor of real floating-point numbers, of one of
    ``dtypes`` where given; DomainError otherwise."""
    if not isinstance(value, Tensor):
        raise DomainError(f"{name} is a {type(value).__name__}; a torch tensor is needed.")
    if not value.is_floating_point() or (dtypes is not None and value.dtype not in dtypes):
        wanted = "floating-point numbers" if dtypes is None else "float32 or float64"
        raise DomainError(f"{name} is {value.dtype}; {wanted} are needed: convert with .float().")
    return check_dense(value, name)


def check_dense(value: Tensor, name: str) -> Tensor:
    """``value`` unchanged when it is a dense tensor with values; DomainError otherwise."""
    if value.layout != torch.strided or value.is_meta:
        given = "a meta tensor without values" if value.is_meta else f"stored as {value.layout}"
        raise DomainError(f"{name} is {given}; a dense tensor is needed (sparse ones: to_dense()).")
    return value


def check_mask(value: Any, name: str, shape: tuple[int, ...]) -> Tensor:
    """``value`` unchanged when it is a bool tensor of this shape; DomainError, ShapeError otherwise."""
    if not isinstance(value, Tensor) or value.dtype != torch.bool:
        given = value.dtype if isinstance(value, Tensor) else type(value).__name__
        raise DomainError(f"{name} is {given}; a bool tensor is needed, True where pixels count.")
    if tuple(value.shape) != tuple(shape):
        raise ShapeError(f"{name} must be {tuple(shape)}, one entry per pixel, got {tuple(value.shape)}.")
    return check_dense(value, name)


def check_volume(volume: EventVolume, bins: int | None = None, least_bins: int = 1) -> Tensor:
    """Counts [B, 2, bins, H, W] of an event volume that an estimator or a loss can take.

    Args:
      bins: as many are needed; None: at least ``least_bins``.
    Raises: DomainError for anything but an EventVolume, counts that are not float32 or float64, NaN, infinite
      or below -0.001, bins that collect no time; ShapeError for other axes, empty ones, or other bins.
    """
    if not isinstance(volume, EventVolume):
        raise DomainError(
            f"the events are a {type(volume).__name__}; an EventVolume is needed, as events.from_stream and "
            "events.from_counts make it."
        )
    counts = check_real(volume.counts, "the counts of the event volume", COUNTS)
    wanted = f"bins >= {least_bins}" if least_bins > 1 else "bins"
    wanted = wanted if bins is None else str(bins)
    fits = counts.ndim == 5 and counts.shape[1] == 2 and 0 not in counts.shape
    if not fits or counts.shape[2] < least_bins or bins not in (None, counts.shape[2]):
        advice = "" if bins is None else f"; make the volume with {bins} bins or build the network for others"
        raise ShapeError(
            f"this takes event volumes [B, 2, {wanted}, H, W], got {tuple(counts.shape)} (no axis may be "
            f"empty){advice}."
        )
    low, high = (float(bound) for bound in counts.detach().aminmax())
    if not (math.isfinite(low) and math.isfinite(high)):
        check_finite(counts, "event volume")
    if high > MOST_EVENTS:
        raise DomainError(
            f"the counts of the event volume reach {high:g}; at most {MOST_EVENTS:g} are possible."
        )
    if low < NEGATIVE:
        raise DomainError(
            f"the counts of the event volume reach down to {low:g}; numbers of events are 0 or more, OFF "
            "events are counted on axis 1, index 1."
        )
    for name, least in (("centroid_s", -math.inf), ("collected_s", 0.0)):
        times = check_real(getattr(volume, name), f"{name} of the event volume")
        if tuple(times.shape) != counts.shape[2:3]:
            raise ShapeError(
                f"{name} of the event volume is {list(times.shape)}; [{counts.shape[2]}] is needed."
            )
        if not bool((times.detach().isfinite() & (times.detach() > least)).all()):
            raise DomainError(
                f"{name} of the event volume is {times.tolist()}; finite times > {least} are needed."
            )
    times = volume.centroid_s.detach().tolist()
    span = float(volume.collected_s.detach().sum())
    rising = all(first < second for first, second in pairwise(times))
    if not (
        rising
        and times[0] >= 0
        and times[-1] <= span
        and times[-1] - times[0] >= (len(times) > 1) * LEAST_SPREAD * span
    ):
        raise DomainError(
            f"centroid_s of the event volume is {times} in an interval of {span:g} s (the sum of collected_s); rising "
            "times spread over it are needed."
        )
    return counts


def check_flow(flow_px: Any, shape: tuple[int, ...] | None = None, name: str = "the flow") -> Tensor:
    """``flow_px`` unchanged when it is a real tensor [B, 2, H, W] with pixels, of this shape where given, and
    finite; DomainError, ShapeError otherwise."""
    check_real(flow_px, name)
    if shape is not None and tuple(flow_px.shape) != tuple(shape):
        raise ShapeError(f"{name} must be {list(shape)}, got {list(flow_px.shape)}.")
    if flow_px.ndim != 4 or flow_px.shape[1] != 2 or 0 in flow_px.shape:
        raise ShapeError(f"{name} is {list(flow_px.shape)}; [B, 2, H, W] with at least one pixel is needed.")
    return check_finite(flow_px, name)


def check_field(field: FlowField, name: str) -> FlowField:
    """``field`` unchanged when it is a FlowField whose parts fit; values are not looked at: what is not valid
    may be NaN."""
    if not isinstance(field, FlowField):
        raise DomainError(f"{name} is a {type(field).__name__}; a FlowField is needed.")
    flow = check_real(field.flow_px, f"flow_px of {name}")
    if flow.ndim != 4 or flow.shape[1] != 2 or 0 in flow.shape:
        raise ShapeError(
            f"flow_px of {name} is {list(flow.shape)}; [B, 2, H, W] with at least one pixel is needed."
        )
    check_mask(field.valid, f"valid of {name}", (flow.shape[0], *flow.shape[2:]))
    return field


def check_kind(value: Any, kind: type[Kind], name: str) -> Kind:
    """``value`` unchanged when it is a ``kind``; DomainError otherwise."""
    if not isinstance(value, kind):
        raise DomainError(f"{name} is a {type(value).__name__}; a {kind.__name__} is needed.")
    return value


def check_path(path: Any, name: str = "the path") -> Path:
    """``path`` as a Path; FileFormatError for anything but text or a Path."""
    if not isinstance(path, (str, os.PathLike)) or "\0" in str(path):
        raise FileFormatError(f"{name} is {shown(path)}; a path is needed.")
    return Path(path)


def check_size(size: Any, name: str) -> tuple[int, int]:
    """``size`` as (height, width), two whole numbers from 1; ShapeError, DomainError otherwise."""
    if not isinstance(size, (tuple, list)) or len(size) != 2:
        raise ShapeError(f"{name} is {shown(size)}; (height, width) in pixels is needed.")
    height, width = (check_whole(side, name) for side in size)
    if not (1 <= height <= MOST_SIDE_PX and 1 <= width <= MOST_SIDE_PX):
        raise ShapeError(f"{name} is {height} x {width}; 1 to {MOST_SIDE_PX} pixels a side are possible.")
    return height, width


def check_count(value: Any, name: str, least: int = 0, most: int = MOST_STEPS) -> int:
    """A whole number from ``least`` to ``most`` as an int; DomainError otherwise."""
    number = check_whole(value, name, least)
    if number > most:
        raise DomainError(f"{name} is {value!r}; a whole number from {least} to {most} is needed.")
    return number


def check_number(value: Any, name: str, least: float = -math.inf, above: float | None = None) -> float:
    """A finite number >= ``least``, or > ``above`` where given, as a float; DomainError for anything else."""
    number = math.nan if isinstance(value, bool) else as_number(value, name)
    if not (math.isfinite(number) and number >= least and (above is None or number > above)):
        bound = f" > {above:g}" if above is not None else "" if least == -math.inf else f" >= {least:g}"
        raise DomainError(f"{name} is {value!r}; a finite number{bound} is needed.")
    return number
