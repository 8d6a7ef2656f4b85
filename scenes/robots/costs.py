"""What a whole design has to pay for: light, low thresholds, a bus of limited width, and high
masts.

Without these a wide, fast lens on the tallest mast before the most sensitive pixels is best at
everything, and there is nothing to design.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from codesign.checks import check_number, check_positive
from codesign.events import SensorModel
from codesign.events.sensor.model import threshold_to_noise
from codesign.types import EventVolume

FASTEST = 1.2  # f-number of full light
DAVIS_BUS_HZ = 12e6  # events per second that a DAVIS346 reads out
WALKING_M_S = 1.0  # above which a mast sways no more
MOST_RATE = 10.0  # of noise events, per 2 x bandwidth
LEAST_RATE = 1e-7


@dataclass(frozen=True)
class Costs:
    """What a robot's camera pays.

    light: of a world, 1 is daylight; a lens of f-number N passes light (1.2 / N)^2 of it. Bandwidth
      and shot noise follow the light, and dim pixels lose contrast, as the sensor's model has it.
    noise: whether noise events become more as thresholds fall and bandwidth grows.
    bus_hz: events per second that the whole sensor can read out; what comes on top is lost.
    sway_per_m_s: rate in rad/s, root mean square about roll and pitch, of the tip of a mast of 1 m
      at 1 m/s. It grows with the square of the mast's length (as the slope of a cantilever) and
      with the speed, up to 1 m/s.
    """

    light: float = 1.0
    noise: bool = True
    bus_hz: float = DAVIS_BUS_HZ
    sway_per_m_s: float = 2.0

    def __post_init__(self) -> None:
        check_number(self.light, "light", above=0.0, most=1.0)
        check_positive(self.bus_hz, "bus_hz")
        check_number(self.sway_per_m_s, "sway_per_m_s", least=0.0)

    def gain(self, fno: float) -> float:
        """Share of full light on the film behind an f-number."""
        return self.light * (FASTEST / fno) ** 2

    def sensor(self, nominal: SensorModel, theta: float, cutoff_hz: float) -> SensorModel:
        """The nominal sensor at another threshold and bandwidth, with the noise rate that they
        bring.

        The noise of the level is white, so its deviation grows with the root of the bandwidth; the
        nominal sensor's own rate says how strong it is.
        Source: v2e's fit of rate over threshold-to-noise ratio (Hu, Liu, Delbruck, CVPR-W 2021),
          solved for the rate.
        """
        changed = replace(nominal, theta_on=theta, theta_off=theta, cutoff_hz=cutoff_hz)
        if not self.noise:
            return changed
        ratio = nominal.theta_on / threshold_to_noise(nominal.shot_rate_hz, nominal.cutoff_hz)
        deviation = ratio * math.sqrt(cutoff_hz / nominal.cutoff_hz)
        return replace(changed, shot_rate_hz=noise_rate_hz(theta / deviation, cutoff_hz))

    def sway(
        self, T_body_cam: Tensor, foot_m: float, speed_m_s: Tensor, deviates: Tensor
    ) -> Tensor:
        """[N, 6] m/s and rad/s in body axes: the twist by which a camera moves beside its body.

        The tip of a cantilever under a load there turns by 3/2 of its deflection over its length,
        so it moves as if it turned about a point at a third of the mast.

        Args:
          T_body_cam: [4, 4], or [N, 4, 4].
          foot_m: height of the mast's foot in body axes.
          speed_m_s: [N].
          deviates: [N, 2] standard normal, for roll and pitch.
        Gradient: pose and speed.
        """
        place = T_body_cam[..., :3, 3].expand(len(speed_m_s), 3)
        length = (place[:, 2] - foot_m).clamp_min(0)
        rate = self.sway_per_m_s * length**2 * speed_m_s.clamp_max(WALKING_M_S)
        turn = torch.cat([rate[:, None] * deviates, torch.zeros_like(deviates[:, :1])], 1)
        pivot = torch.cat([place[:, :2], (foot_m + length / 3)[:, None]], 1)
        return torch.cat([-torch.linalg.cross(turn, pivot), turn], 1)


def noise_rate_hz(ratio: float, cutoff_hz: float) -> float:
    """Noise events per pixel and second at a threshold of so many noise deviations:
    ``threshold_to_noise`` solved for the rate by bisection, which falls from MOST_RATE to
    LEAST_RATE times twice the bandwidth."""
    low, high = math.log(LEAST_RATE), math.log(MOST_RATE)
    for _ in range(60):
        middle = (low + high) / 2
        above = threshold_to_noise(2 * cutoff_hz * math.exp(middle), cutoff_hz) > ratio
        low, high = (middle, high) if above else (low, middle)
    return 2 * cutoff_hz * math.exp(low)


class Exposed(nn.Module):
    """An event stage behind a lens that passes a share of the light, before a bus of limited width.

    Args:
      stage: a layer with ``volume`` (``events.Settled``), or ``events.HardSensor``.
      gain: share of full light.
      most: events that a body's windows may read out in one interval; None: all are read.
      windows: of one body.
    Beyond ``most`` every event is kept with the same probability, as by a bus that serves pixels at
    random; of a fraction of an event the fraction is. Gradient: that of the mean, counts alike.
    """

    def __init__(self, stage: nn.Module, gain: float, most: float | None, windows: int) -> None:
        super().__init__()
        self.stage = stage
        self.gain = gain
        self.most = most
        self.windows = windows

    @property
    def lead_s(self) -> float:
        """That of the stage."""
        return getattr(self.stage, "lead_s", 0.0)

    def volume(
        self, frames: Tensor, t_s: Tensor, bins: int, generator: torch.Generator | None = None
    ) -> EventVolume:
        """[B, 2, bins, H, W] events that are read out of frames [B, T, H, W]."""
        frames = self.gain * frames
        stage: Any = self.stage
        if hasattr(stage, "volume"):
            made = stage.volume(frames, t_s, bins, generator)
        else:
            made = stage(frames, t_s, generator)
        if self.most is None:
            return made
        return replace(made, counts=self._read_out(made.counts, generator))

    def _read_out(self, counts, generator):
        per_body = counts.detach().unflatten(0, (-1, self.windows)).flatten(1).sum(1)
        kept = (self.most / per_body.clamp_min(1e-9)).clamp_max(1).repeat_interleave(self.windows)
        kept = kept[:, None, None, None, None].to(counts)
        if (kept == 1).all():
            return counts
        whole = counts.detach().floor()
        if not isinstance(generator, torch.Generator):
            generator = torch.Generator().manual_seed(0)
        share = kept.expand_as(whole).contiguous()
        read = torch.binomial(whole, share, generator=generator)
        rest = counts.detach() - whole
        read = read + rest * torch.bernoulli(share, generator=generator)
        mean = kept * counts
        return torch.where(kept == 1, counts, mean + (read - mean).detach())
