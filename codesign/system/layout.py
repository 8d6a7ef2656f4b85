"""What stands at every junction: kinds, shapes, dtypes and devices in every pass, values where a
pass is looked at."""

import warnings
from typing import Any

import torch
from torch import Tensor

from codesign.checks import check, check_kind
from codesign.errors import DomainError
from codesign.events.entry import on_unit_scale
from codesign.types import EventVolume, FlowField, Rays

LAYOUT = {
    Rays: {"direction": "rays 3", "origin_m": "rays 3", "weight": "rays"},
    EventVolume: {"counts": "N 2 bins H W", "centroid_s": "bins", "collected_s": "bins"},
    FlowField: {
        "flow_px": "N 2 H W",
        "valid": "N H W",
        "confidence": "N H W",
        "covariance_px2": "N 3 H W",
    },
}
OPTIONAL = ("confidence", "covariance_px2")
LONGEST_S = 2.0  # a window of flow that lasts longer is in milliseconds


def check_layout(
    by: str,
    value: Any,
    kind: type,
    shape: str | tuple[int, ...] = "",
    **sizes: int,
) -> None:
    """Raise unless a value is of a kind and its tensors have their layouts, with the sizes that
    letters stand for.

    Args:
      by: subject and verb of the sentence, such as "stage 'flow' returned".
      shape: of a plain tensor, as ``check`` takes it.
    Raises: DomainError for kinds, dtypes and devices; ShapeError for shapes.
    """
    check_kind(value, kind, f"what {by}")
    devices = []
    for name, axes in LAYOUT.get(kind, {"": shape}).items():
        tensor = getattr(value, name) if name else value
        if tensor is None and name in OPTIONAL:
            continue
        what = f"{name} of what {by}" if name else f"what {by}"
        check(tensor, axes, what, (torch.bool,) if name == "valid" else (), sizes=sizes)
        devices.append(tensor.device)
    if len(set(devices)) > 1:
        raise DomainError(
            f"{by} tensors on {' and '.join(sorted(map(str, set(devices))))}; use one device."
        )


def look_at(by: str, value: Any) -> None:
    """Warn of frames on 0 to 1, and raise DomainError for numbers of events below 0, further than
    rounding takes them."""
    tensor = value.counts if isinstance(value, EventVolume) else value
    low, high = (float(bound) for bound in tensor.detach().aminmax())
    if tensor is not value and low < -1e-4 * max(high, 1e-3):
        raise DomainError(
            f"{by} counts down to {low:.3g}; numbers of events are 0 or more, ON first: a signed change belongs into "
            "two channels, change.relu() and (-change).relu()."
        )
    if tensor is value and low >= 0 and on_unit_scale(value):
        warn(
            f"{by} between {low:.3g} and {high:.3g}; the scale is 0 to 255, on which these are black: multiply "
            "by 255 if they are on 0 to 1."
        )


def look_at_times(t_s: Tensor) -> None:
    """Warn of times that seem to be milliseconds."""
    if float(t_s[-1] - t_s[0]) > LONGEST_S:
        warn(
            f"the batch's times span {float(t_s[-1] - t_s[0]):.4g} s, one window of flow; t_s are seconds: divide by 1e3 "
            "if they are milliseconds."
        )


def warn(sentence: str) -> None:
    """A warning to the caller of the caller."""
    warnings.warn(sentence, UserWarning, stacklevel=3)
