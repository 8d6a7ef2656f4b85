"""What keeps simulated counts from equalling recorded ones: cancelled events, timing, weak changes,
motion."""

import torch

from studies.davis_fit.score import correlation, pooled, signed

# standard deviation over time below which a pixel counts as still, units of the 0-255 scale; reading noise
# alone is about 0.7
STILL_SD = 1.0


def cancelled_share(counts):
    """Share of the events whose pixel fires as many of the other polarity in the same interval: what the
    difference of two frames cannot show."""
    return float(1 - signed(counts).abs().sum() / counts.sum())


def offset_curve(simulated, recording, offsets_s, intervals):
    """Correlation of simulated signed counts with those recorded between mid-exposures moved by each offset;
    at 1 px. Returns a list."""
    return [
        correlation(signed(simulated[intervals]), signed(recording.counts(offset_s)[intervals]))
        for offset_s in offsets_s
    ]


def self_curve(recording, offsets_s, intervals, side_px=1):
    """Correlation of the recorded signed counts with themselves between times moved by each offset: what a
    mere error of timing costs."""
    truth = pooled(signed(recording.counts()[intervals]), side_px)
    return [
        correlation(truth, pooled(signed(recording.counts(offset_s)[intervals]), side_px))
        for offset_s in offsets_s
    ]


def still_events(recording):
    """Events where the frames show no motion, as metrics by name: share of pixels that are still, their share
    of all events, their events per pixel and second (ON, OFF), and the same, both together, in the interval
    with the fewest events. Without still pixels there is only their share, 0.
    """
    still = recording.frames.std(0) < STILL_SD
    found = {"still_pixel_share": float(still.double().mean())}
    if bool(still.any()):
        counts = recording.counts()
        interval_s = recording.mid_s.diff()
        on_hz, off_hz = (counts.sum(0)[:, still].mean(1) / float(interval_s.sum())).tolist()
        quietest = int(counts.sum((1, 2, 3)).argmin())
        found |= {
            "still_pixel_event_share": float(counts[..., still].sum() / counts.sum()),
            "still_pixel_on_hz": on_hz,
            "still_pixel_off_hz": off_hz,
        }
        found |= {
            "still_pixel_hz_in_quietest_interval": float(
                counts[quietest][:, still].sum(0).mean() / interval_s[quietest]
            )
        }
    return found


def median_motion_px(forth, recorded):
    """Median flow, pixels per interval, over the pixels that fired in it. forth: [T-1, 2, H, W]; recorded:
    [T-1, 2, H, W]. Returns a list."""
    fired = recorded.sum(1) > 1
    length = torch.as_tensor(forth).square().sum(1).sqrt()
    return [
        float(one[where].median()) if bool(where.any()) else 0.0
        for one, where in zip(length, fired, strict=True)
    ]
