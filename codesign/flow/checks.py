"""What may enter a function of flow: volumes, flows, masks, numbers. Everything else is refused
with a sentence."""

import math
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from codesign.checks import FLOATS, check, check_finite, check_kind, check_whole
from codesign.errors import DomainError, ShapeError, shown
from codesign.types import EventVolume, FlowField

MOST_SIDE_PX = 2**15
MOST_STEPS = 1000  # of an iteration
MOST_EVENTS = 1e9  # of a pixel and bin: squares of it are far from overflow
LEAST_SPREAD = 0.01  # of the centroids, over the interval
NEGATIVE = -1e-3  # counts a hair below 0 are let through: steps of differences go there


def check_volume(volume: EventVolume, bins: int | None = None, least_bins: int = 1) -> Tensor:
    """Counts [B, 2, bins, H, W] of an event volume that an estimator or a loss can take.

    Args:
      bins: as many are needed; None: at least ``least_bins``.
    Raises: DomainError for anything but an EventVolume, counts that are not float32 or float64,
      NaN, infinite or below -0.001, bins that collect no time; ShapeError for other axes, empty
      ones, or other bins.
    """
    check_kind(
        volume, EventVolume, "the events", "events.from_stream and events.from_counts make one"
    )
    sizes = {} if bins is None else {"bins": bins}
    axes = f"B 2 bins{f'>={least_bins}' if least_bins > 1 else ''} H W"
    counts = check(volume.counts, axes, "the counts of the event volume", FLOATS, sizes=sizes)
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
        times = check(getattr(volume, name), "bins", f"{name} of the event volume", sizes=sizes)
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


def check_flow(
    flow_px: Any,
    shape: tuple[int, ...] | None = None,
    name: str = "the flow",
) -> Tensor:
    """``flow_px`` unchanged when it is a real tensor [B, 2, H, W] with pixels, of this shape where
    given, and finite; DomainError, ShapeError otherwise."""
    axes = "B 2 H W" if shape is None else shape
    return check(flow_px, axes, name, finite=True)


def check_field(field: FlowField, name: str) -> FlowField:
    """``field`` unchanged when it is a FlowField whose parts fit; values are not looked at: what is
    not valid may be NaN."""
    sizes = {}
    check_kind(field, FlowField, name)
    check(field.flow_px, "B 2 H W", f"flow_px of {name}", sizes=sizes)
    check(field.valid, "B H W", f"valid of {name}", (torch.bool,), sizes=sizes)
    return field


def check_size(size: Any, name: str) -> tuple[int, int]:
    """``size`` as (height, width), two whole numbers from 1; ShapeError, DomainError otherwise."""
    if not isinstance(size, (tuple, list)) or len(size) != 2:
        raise ShapeError(f"{name} is {shown(size)}; (height, width) in pixels is needed.")
    height, width = (check_whole(side, name, 1, MOST_SIDE_PX) for side in size)
    return height, width
