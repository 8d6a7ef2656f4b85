"""A sensor that runs before the window it is read in: one that begins with the window, at rest with the first frame,
misses the first events of every pixel and is late by its bandwidth, and flow is read some ten percent short."""

import math

from torch import Generator, Tensor, nn

from codesign.errors import DomainError, as_number
from codesign.events.entry import check_times
from codesign.events.layers.layer import PARTS_PER_BIN, EventLayer, check_axes
from codesign.events.volumes.volume import check_bins, from_counts
from codesign.types import EventVolume

MOST_S = 1e9
NEAR = 1e-6  # of the lead, by which a frame may miss its end


class Settled(nn.Module):
    """An event layer whose events in the first ``lead_s`` are not read; frames begin as much before the window.

    A few time constants of the sensor's bandwidth are enough, and as much motion as makes an event or two.

    Args: layer: of ``events.layer``. lead_s: length of a whole number of intervals between frames, seconds, >= 0.

    >>> import torch
    >>> from codesign import events
    >>> settled = events.Settled(events.layer("memory"), lead_s=0.01)
    >>> frames = torch.rand(1, 5, 8, 8, generator=torch.Generator().manual_seed(0))
    >>> float(settled.volume(frames, torch.linspace(0, 0.04, 5), 3).collected_s.sum().round(decimals=3))
    0.03
    """

    def __init__(self, layer: EventLayer, lead_s: float) -> None:
        super().__init__()
        if not isinstance(layer, EventLayer):
            raise DomainError(f"the layer is a {type(layer).__name__}; one of events.layer is needed.")
        self.layer = layer
        self.lead_s = check_lead(lead_s)

    def volume(
        self, frames: Tensor, t_s: Tensor, bins: int, generator: Generator | None = None
    ) -> EventVolume:
        """Events after the lead in time bins, [B, 2, bins, H, W]. Args and gradient: as ``EventLayer.volume``.
        Raises: DomainError when no frame stands at the end of the lead."""
        check_bins(bins)
        check_axes(frames)
        given_s = check_times(t_s, frames.shape[-3])
        start_s = float(given_s[0]) + self.lead_s
        if len(given_s) < 2 or float((given_s[:-1] - start_s).abs().min()) > NEAR * max(
            self.lead_s, float(given_s.diff().min())
        ):
            raise DomainError(
                f"settled: no frame stands {self.lead_s:g} s after the first; give frames at "
                f"{(given_s - given_s[0]).tolist()} s a lead that ends with one, before the last."
            )
        longest_s = float(given_s[-1] - start_s) / (bins - 1) / PARTS_PER_BIN if bins > 1 else math.inf
        counts, times_s = self.layer.finely(frames, t_s, longest_s, generator)
        first = int((times_s - start_s).abs().argmin())
        return from_counts(counts.movedim((-4, -3), (0, 1))[first:], times_s[first:], bins)


def check_lead(lead_s: float) -> float:
    """Seconds. Raises: DomainError for others than finite ones of at least 0."""
    if not 0 <= as_number(lead_s, "lead_s") < MOST_S:
        raise DomainError(f"lead_s is {lead_s}; seconds of at least 0 and less than {MOST_S:g} are needed.")
    return float(lead_s)
