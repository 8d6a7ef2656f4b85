"""The event sensor: its parameters, and the random parts that the hard simulator and the memory layer share."""

import math
from dataclasses import dataclass, fields

import torch

from codesign.errors import DomainError, ShapeError

THETA_MINIMUM = 0.01  # no drawn threshold falls below, as in v2e


@dataclass(frozen=True)
class SensorModel:
    """Parameters of an event sensor.

    theta_on, theta_off: nominal contrast thresholds, natural log units, > 0.
    theta_sigma: standard deviation of the thresholds over pixels, natural log units, >= 0.
    shot_rate_hz: noise events per pixel and second, both polarities together, >= 0; the same at every intensity.
    timing: "interpolated": each event at the time its pixel crosses the threshold, log intensity linear in time between frames.
    """

    theta_on: float = 0.2
    theta_off: float = 0.2
    theta_sigma: float = 0.0
    shot_rate_hz: float = 0.0
    timing: str = "interpolated"

    def __post_init__(self):
        if self.timing != "interpolated":
            raise DomainError(f"timing is {self.timing!r}; allowed: 'interpolated'.")
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "timing":
                continue
            positive = field.name in ("theta_on", "theta_off")
            if not isinstance(value, (int, float)) or not math.isfinite(value) or value < 0 or (positive and value == 0):
                raise DomainError(f"SensorModel.{field.name} is {value!r}; a finite number {'> 0' if positive else '>= 0'} is needed.")


def draw_thresholds(sensor, pixels, generator, *, dtype=torch.float32, device="cpu"):
    """Contrast thresholds of every pixel.

    Args:
      sensor: SensorModel. pixels: shape of one frame. generator: draws happen on its device; untouched when theta_sigma is 0.
    Returns: theta_on, theta_off: ``pixels`` each, natural log units: N(theta, sigma), values below 0.01 set to 0.01; first all ON, then all OFF.
    Source: v2e (Hu et al., CVPR-W 2021), threshold mismatch.
    """
    nominal = (sensor.theta_on, sensor.theta_off)
    if sensor.theta_sigma == 0:
        return tuple(torch.tensor(theta, dtype=dtype, device=device).expand(pixels) for theta in nominal)
    spread = (sensor.theta_sigma * torch.randn(tuple(pixels), generator=generator, dtype=dtype, device=generator.device) for _ in nominal)
    return tuple((theta + noise).clamp(min=THETA_MINIMUM).to(device) for theta, noise in zip(nominal, spread, strict=True))


def draw_shot_counts(sensor, pixels, interval_s, generator, *, dtype=torch.float32, device="cpu"):
    """Noise events per pixel and interval: Poisson, shot_rate_hz/2 per polarity. Add them to the counts of any event layer.

    They leave the memorised level alone (v2e resets it, and fires at most one per frame), so they are one fixed draw for a whole optimisation.

    Args:
      sensor: SensorModel. pixels: shape of one frame. interval_s: [T-1] lengths of the intervals, seconds, > 0.
      generator: draws happen on its device, one interval after the other, so chunks draw what the whole draws; untouched when the rate is 0.
    Returns: [T-1, 2, *pixels] whole numbers >= 0, ON first.
    """
    interval_s = torch.as_tensor(interval_s, dtype=torch.float64)
    if interval_s.ndim != 1:
        raise ShapeError(f"interval_s has shape {list(interval_s.shape)}; one length per interval is needed, [T-1].")
    if not bool(((interval_s > 0) & interval_s.isfinite()).all()):
        raise DomainError("interval_s holds a length that is not a finite number > 0; give t_s.diff() of increasing frame times.")
    counts = torch.zeros((len(interval_s), 2, *pixels), dtype=dtype, device=device)
    if sensor.shot_rate_hz > 0:
        rate_hz = torch.full((2, *pixels), sensor.shot_rate_hz / 2, dtype=torch.float64, device=generator.device)
        for index, length_s in enumerate(interval_s.tolist()):
            counts[index] = torch.poisson(rate_hz * length_s, generator=generator).to(counts)
    return counts
