"""Errors of frames, flow and events of an upsampled sequence."""

import math
import time
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch.nn.functional import avg_pool2d

from codesign import events
from codesign.events.upsampling.between import between, visibility
from codesign.events.upsampling.flow import flow_both_ways, flow_levels
from codesign.events.upsampling.hidden import repaired

WAYS = ("upsampled", "blended", "kept")
POOL_PX = 4
POOL_S = 0.005
LOOKED_AT = 2  # intervals whose frames are compared


class EventErrors(NamedTuple):
    """correlation: of the total counts of pixels, both polarities side by side. on, off: events over true
    events. wrong: sum of absolute differences of counts in POOL_PX squares and POOL_S, per true event."""

    correlation: float
    on: float
    off: float
    wrong: float


@dataclass(frozen=True)
class Row:
    """One scene at one motion between kept frames: error of the flow, of frames made by upsampling and
    blending, and of events by way."""

    scene: str
    motion_px: float
    flow_px: float
    psnr_db: float
    blended_db: float
    errors: dict[str, EventErrors]
    mpixel_per_s: float


def event_errors(stream, truth, t_s):
    """EventErrors of a stream against the true one over the times t_s [T]."""
    edges = torch.linspace(
        float(t_s[0]), float(t_s[-1]), round(float(t_s[-1] - t_s[0]) / POOL_S) + 1, dtype=torch.float64
    )
    mine, true = (events.to_counts(each, edges) for each in (stream, truth))
    totals = torch.stack([each.sum(0).flatten() for each in (mine, true)])
    pooled = [avg_pool2d(each.flatten(0, 1)[:, None], POOL_PX) * POOL_PX**2 for each in (mine, true)]
    on, off = (mine.sum((0, 2, 3)) / true.sum((0, 2, 3))).tolist()
    return EventErrors(
        float(torch.corrcoef(totals)[0, 1]),
        on,
        off,
        float((pooled[0] - pooled[1]).abs().sum() / pooled[1].sum()),
    )


def between_kept(frames, stride, most=LOOKED_AT):
    """Frames at the times of those left out of the first intervals, ``most`` at most, and the flow over the
    first.

    Returns: [n, H, W] upsampled, with the kept ones as they are, and [2, H, W].
    """
    made = frames[: min(most, (len(frames) - 1) // stride) * stride + 1].clone()
    first_flow = None
    for start in range(0, len(made) - 1, stride):
        first = frames[start]
        second = frames[start + stride]
        flows = flow_both_ways(first, second)
        first_flow = flows[0] if first_flow is None else first_flow
        flows = repaired(flow_levels(first, second), flows, visibility(flows))
        seen = visibility(flows)
        for step in range(1, stride):
            made[start + step] = between(first, second, flows, seen, step / stride)
    return made, first_flow


def blended_frames(frames, stride):
    """Frames [T, H, W] with those left out replaced by the straight line between the kept ones."""
    share = (torch.arange(stride, dtype=frames.dtype) / stride)[:, None, None]
    lines = [
        frames[start] + share * (frames[start + stride] - frames[start])
        for start in range(0, len(frames) - 1, stride)
    ]
    return torch.cat((*lines, frames[-1:]))


def flow_error(flow, shown, stride):
    """Mean endpoint error, px, of the flow over the first interval, in points that both frames show."""
    truth, seen = (part[0] for part in shown.truth[stride])
    return float((flow - truth).norm(dim=0)[seen].mean())


def psnr(made, frames, stride):
    """Peak (255) over the root mean square difference in the frames that were left out, dB; 120 at most."""
    left_out = torch.arange(len(made)) % stride != 0
    return -10 * math.log10(
        max(float((made - frames[: len(made)])[left_out].div(255).square().mean()), 1e-12)
    )


def pace(work):
    """What ``work`` returns (frames and times), and how many million pixels of frames it gave per second of
    processor time."""
    start = time.process_time()
    frames, t_s = work()
    return frames, t_s, frames.numel() / (time.process_time() - start) / 1e6
