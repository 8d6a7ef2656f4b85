"""How far the light of a pixel jumps from frame to frame, in thresholds: whether a video is fast enough to
make events of."""

import torch

from codesign.events import soft_counts

LARGEST = 64  # steps of more thresholds are counted as this many
LARGE = 3  # thresholds: an event in the middle of such a step is placed by interpolation over several others
WORRYING = 0.1  # share of the moving pixels


class Steps:
    """Histogram of the steps of log intensity between consecutive frames, in whole thresholds of the nominal
    sensor.

    histogram: [LARGEST + 1] int64; entry n counts pixels and intervals whose level moved by n to n + 1
      thresholds. before: [H, W] the last frame seen.
    """

    def __init__(self, sensor, state):
        self.thetas = sensor.theta_on, sensor.theta_off
        self.histogram = state.histogram
        self.before = state.before

    def add(self, frames):
        """Count the steps up to and between the frames [N, H, W] of a chunk."""
        if self.before is not None:
            frames = torch.cat((self.before.to(frames)[None], frames))
        self.before = frames[-1].clone()
        if len(frames) > 1:
            size = (
                soft_counts(frames, *self.thetas).sum(1).clamp(max=LARGEST)
            )  # of the two polarities one is 0
            self.histogram += torch.bincount(size.flatten().to(torch.int64), minlength=LARGEST + 1).cpu()

    @property
    def large_share(self):
        """Share of all pixels and intervals whose step exceeds LARGE thresholds."""
        return float(self.histogram[LARGE:].sum() / self.histogram.sum().clamp(min=1))

    @property
    def large_share_of_moving(self):
        """The same among those whose step reaches one threshold: the ones that make events."""
        return float(self.histogram[LARGE:].sum() / self.histogram[1:].sum().clamp(min=1))

    @property
    def remedy(self):
        """By which factor the frame rate would have to grow so that nine in ten moving pixels step at most
        LARGE thresholds; 1 where they do."""
        moving = self.histogram[1:].cumsum(0)
        if not int(moving[-1]):
            return 1.0
        step = 2 + int(torch.searchsorted(moving, int(0.9 * int(moving[-1])) + 1).clamp(max=len(moving) - 1))
        return max(1.0, step / LARGE)

    @property
    def too_large(self):
        """Whether the video is too slow to be trusted in time."""
        return self.large_share_of_moving > WORRYING
