"""The recording at a higher frame rate: pictures moved along their optical flow, each pixel speeding up or
slowing down towards its neighbouring intervals.

Even motion within an interval makes the event rate jump where the next one begins; a cubic through both ends
with the mean speed of the two intervals there does not.
"""

from itertools import pairwise

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, map_coordinates

from codesign import events
from studies.davis_fit.recording import Recording
from studies.davis_fit.upsample import flows
from studies.spike_esim.data import Sequence

STEPS_PER_INTERVAL = 8  # 5 ms
SMOOTH_PX = 6.0  # of the speed, which is compared between intervals pixel by pixel
STILL_PX = 0.1  # added to speeds, so that what hardly moves is moved evenly
STEEPEST = 3.0  # slope up to which the cubic never goes back


def upsampled(recording: Recording, steps=STEPS_PER_INTERVAL, advance=lambda: None):
    """The recording as one Sequence: ``steps`` pictures per frame interval, events counted between them.
    ``advance`` is called after each interval."""
    fields = []
    made = []
    for first, second in pairwise(recording.frames):
        fields.append(flows(first, second))
        advance()
    speeds = [gaussian_filter(np.sqrt((forth**2).sum(0)), SMOOTH_PX) + STILL_PX for forth, _ in fields]
    for index, (first, second) in enumerate(pairwise(recording.frames)):
        forth, back = fields[index]
        before = speeds[max(index - 1, 0)]
        speed = speeds[index]
        after = speeds[min(index + 1, len(speeds) - 1)]
        slopes = [np.clip((speed + beside) / (2 * speed), 0, STEEPEST) for beside in (before, after)]
        made += [
            first,
            *(
                moved(first, second, forth, back, travelled(step / steps, *slopes))
                for step in range(1, steps)
            ),
        ]
    share = torch.arange(steps, dtype=torch.float64) / steps
    t_s = (recording.mid_s[:-1, None] + share * recording.mid_s.diff()[:, None]).flatten()
    t_s = torch.cat((t_s, recording.mid_s[-1:]))
    return Sequence(
        "DAVIS recording",
        torch.stack((*made, recording.frames[-1])),
        t_s,
        events.to_counts(recording.stream, t_s),
    )


def travelled(time, start_slope, end_slope):
    """Share of the way after a share of the time, by the cubic from 0 to 1 with given slopes at both ends (1
    and 1: even motion)."""
    return (
        3 * time**2
        - 2 * time**3
        + start_slope * (time**3 - 2 * time**2 + time)
        + end_slope * (time**3 - time**2)
    )


def moved(first, second, forth, back, share):
    """Picture between two: (1 - a) first(x + a back(x)) + a second(x + (1 - a) forth(x)) with the share a [H,
    W] of the way. flows: [2, H, W] (rows, columns)."""
    place = np.indices(first.shape, dtype=np.float32)
    early = map_coordinates(first.numpy(), place + share * back, order=1, mode="nearest")
    late = map_coordinates(second.numpy(), place + (1 - share) * forth, order=1, mode="nearest")
    return torch.from_numpy(((1 - share) * early + share * late).astype(np.float32))
