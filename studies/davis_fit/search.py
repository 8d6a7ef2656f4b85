"""Fitting to one half of a recording: the sensor by gradient, the naive emulator by trying a grid."""

import itertools

import torch

from codesign import events
from studies.davis_fit.loss import match
from studies.davis_fit.score import correlation, signed

LEARNING_RATE = 1.0  # a step of about a tenth of each value, which falls to 0 on a line
NAIVE_THETAS = [0.03 * 1.25**k for k in range(14)]  # to 0.55
NAIVE_DARK_OFFSETS = (2.5, 5.0, 10.0, 20.0, 40.0)


def descend(sensor, clip, recorded, intervals, loss, steps, advance):
    """Fit a FittedSensor in place by Adam.

    Args:
      sensor: FittedSensor. clip: Clip of the whole recording. recorded: [T-1, 2, H, W] recorded counts.
      intervals: slice of intervals to fit; later frames are not looked at, earlier ones warm the memory up.
      loss: function of simulated and recorded counts. steps: whole number >= 1. advance: called after each
        step with ``loss``.
    Returns: loss of every step, before it was made.
    """
    seen = clip.until(intervals.stop)
    truth = recorded[intervals]
    optimiser = torch.optim.Adam(sensor.parameters(), lr=LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 1.0 / steps, total_iters=max(steps - 1, 1))
    losses = []
    for _ in range(steps):
        optimiser.zero_grad()
        value = loss(sensor.expected(seen)[intervals], truth)
        value.backward()
        optimiser.step()
        schedule.step()
        losses.append(float(value.detach()))
        advance(loss=losses[-1])
    return losses


def naive_counts(frames, step_s, per_interval, theta, dark_offset=None):
    """Counts of the naive emulator per recorded interval, [T-1, 2, H, W]; lin-log levels, or ln(I +
    dark_offset) where one is given."""
    t_s = torch.arange(len(frames), dtype=torch.float64) * step_s
    levels = events.lin_log(frames) if dark_offset is None else (frames + dark_offset).log()
    return events.to_counts(events.naive(levels, t_s, theta, log_input=True), t_s[::per_interval])


def scan_naive(clip, recorded, intervals, advance):
    """Best (theta, dark_offset) of the naive emulator on a grid; the arguments are as for ``descend``.

    Returns: dictionary: "fitted": least ``match`` loss, as the sensor is fitted; "shape": highest correlation
      of signed counts, whatever the rates.
    """
    seen = clip.until(intervals.stop)
    truth = recorded[intervals]
    rows = []
    for theta, dark_offset in itertools.product(NAIVE_THETAS, NAIVE_DARK_OFFSETS):
        counts = naive_counts(seen.sharp, clip.step_s, clip.per_interval, theta, dark_offset)[intervals]
        rows.append(
            (float(match(counts, truth)), -correlation(signed(counts), signed(truth)), (theta, dark_offset))
        )
        advance(loss=min(rows)[0])
    return {"fitted": min(rows)[2], "shape": min(rows, key=lambda row: row[1])[2]}


def scan_length():
    """Number of grid points of ``scan_naive``."""
    return len(NAIVE_THETAS) * len(NAIVE_DARK_OFFSETS)
