"""Windows cut as real recordings are: a packet of a fixed number of events, however long that takes."""

import numpy as np
import torch

from codesign.errors import DomainError
from codesign.events import memory
from scenes.flow_layers import compose
from scenes.flow_windows import LEAD, RenderedWindows, log_level

PROBES = 48  # looks at the motion for where the packet ends
SHORTEST = 1e-3  # of the motion that is drawn
SETTLING = 0.3  # of it, over which memorised levels settle before the window


class PacketWindows(RenderedWindows):
    """Source of FlowWindows that end where they hold ``events_per_px`` events of the scene per pixel, and at
    the latest where the motion drawn ends.

    So much contrast, fine texture and a low threshold make short windows of little motion; a few edges make
    long ones. Noise comes on top. Args: as RenderedWindows.
    """

    def __init__(self, draws, events_per_px, **sizes):
        super().__init__(draws, **sizes)
        if not events_per_px > 0:
            raise DomainError(f"events_per_px is {events_per_px}; a number > 0 is needed.")
        self.events_per_px = events_per_px

    def _times(self, index):
        lead = np.linspace(-SETTLING, 0, LEAD, endpoint=False)
        probes = np.linspace(0, 1, PROBES + 1) ** 2  # fine where packets of busy scenes end
        sample = self._draw(index, np.concatenate([lead, probes]))
        points = self._undistorted([sample["distortion"]])[0]
        level = log_level(compose(sample, points), sample)
        counts, _ = memory(level, *sample["theta"], log_input=True)
        so_far = counts[LEAD:].sum((1, 2, 3)).cumsum(0).double() / (self.height_px * self.width_px)
        held = torch.cat([so_far.new_zeros(1), so_far]).numpy()
        end = np.interp(self.events_per_px, held, probes) if held[-1] > self.events_per_px else 1.0
        return np.concatenate([lead, max(end, SHORTEST) * np.linspace(0, 1, self.intervals + 1)])
