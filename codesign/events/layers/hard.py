"""The hard sensor where an event layer stands: single events with their times, no gradient. The judge of designs."""

import torch
from torch import Generator, Tensor, nn

from codesign.errors import ShapeError
from codesign.events.entry import check_layout, check_times
from codesign.events.layers.settled import check_lead
from codesign.events.sensor.model import SensorModel, check_sensor
from codesign.events.sensor.simulate import simulate
from codesign.events.volumes.volume import check_bins, from_stream
from codesign.types import EventVolume


class HardSensor(nn.Module):
    """``events.simulate`` and ``events.from_stream`` called like an event layer.

    Args: sensor: SensorModel. bins: time bins of the volume. lead_s: events before it are not read (``Settled``).
    """

    def __init__(self, sensor: SensorModel, bins: int, lead_s: float = 0.0):
        super().__init__()
        check_bins(bins)
        self.sensor = check_sensor(sensor)
        self.bins = bins
        self.lead_s = check_lead(lead_s)

    @torch.no_grad()
    def forward(self, frames: Tensor, t_s: Tensor, generator: Generator | None = None) -> EventVolume:
        """Events of frames [N, T, H, W] at t_s [T] in time bins, [N, 2, bins, H, W].

        generator: one for all samples, which stand above one another as one tall sensor; None: seed 0.
        Raises: ShapeError for other shapes; DomainError as ``simulate``.
        """
        check_layout(frames, 1)
        if frames.ndim != 4:
            raise ShapeError(f"the hard sensor takes frames [N, T, H, W], got {tuple(frames.shape)}.")
        count, times, height, width = frames.shape
        tall = frames.movedim(1, 0).reshape(times, count * height, width)
        stream = simulate(
            tall, t_s, self.sensor, Generator().manual_seed(0) if generator is None else generator
        )
        start_s, end_s = check_times(t_s, times)[[0, -1]].tolist()
        start_us, end_us = (round(time_s * 1e6) for time_s in (start_s + self.lead_s, end_s))
        volume = from_stream(stream, start_us, end_us, self.bins)
        counts = volume.counts.reshape(2, self.bins, count, height, width).permute(2, 0, 1, 3, 4).contiguous()
        return EventVolume(counts, volume.centroid_s, volume.collected_s)
