"""What a sensor remembers between chunks of frames, and how it begins."""

from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from codesign.errors import DomainError
from codesign.events.sensor.model import draw_leak_rates, draw_thresholds


@dataclass
class SensorState:
    """Memory of a sensor. Make an empty one; ``simulate`` fills it and moves it on.

    reference: [H, W] memorised log level. level: [H, W] log level behind the low-pass. theta_on, theta_off:
      [H, W] drawn thresholds.
    start_s, time_s: times of the first and the last frame. generator: used when none is passed; starts at
      seed 0. Only where the sensor needs them: reference_rest: [H, W] what rounding took from the memorised
      level (not for timing "v2e"); input_level, input: [H, W] last log level before the low-pass,
      last intensity; noise: [H, W] photoreceptor noise; leak_hz: [H, W]; last_event_s: [H, W] time of the
      last event (since the first frame for timing "v2e", since the last frame otherwise, so <= 0); hazard:
      [H, W] noise still to pass until the next noise event; key, shots: [H, W] int32 random key and noise
      events so far.
    """

    # Any: filled by the first frame, and used as tensors and numbers from then on
    reference: Any = None
    level: Any = None
    theta_on: Any = None
    theta_off: Any = None
    start_s: Any = None
    time_s: Any = None
    generator: torch.Generator | None = None
    reference_rest: Tensor | None = None
    input_level: Tensor | None = None
    input: Tensor | None = None
    noise: Tensor | None = None
    leak_hz: Tensor | None = None
    last_event_s: Tensor | None = None
    hazard: Tensor | None = None
    key: Tensor | None = None
    shots: Tensor | None = None

    def tensors(self) -> dict[str, Tensor]:
        """Name -> tensor of everything remembered per pixel (for storing)."""
        named = ((field.name, getattr(self, field.name)) for field in fields(self))
        return {name: value for name, value in named if isinstance(value, Tensor)}


def check_state(state, sensor):
    """Raise DomainError unless ``state`` is empty, or holds what the sensor carries on."""
    if not isinstance(state, SensorState):
        raise DomainError(f"the state is a {type(state).__name__}; an events.SensorState is needed.")
    if state.level is None:
        return
    needs = {
        "timing='interpolated'": ("reference_rest", sensor.timing == "interpolated"),
        "a leak": ("leak_hz", sensor.leaks),
        "a dead time": ("last_event_s", sensor.refractory_s > 0),
        "a bandwidth": ("input_level", sensor.cutoff_hz > 0),
        "noise events": ("input", sensor.has_shots),
        "photoreceptor noise": ("noise", sensor.photoreceptor_noise),
    }
    lacks = [what for what, (name, asked) in needs.items() if asked and getattr(state, name) is None]
    if sensor.timing == "v2e" and state.reference_rest is not None:
        lacks.append("timing='v2e'")
    if lacks:
        raise DomainError(
            f"the sensor has {' and '.join(lacks)}, the one that began the state had not; pass the sensor of "
            "the first chunk, or an empty state."
        )


def begin(state, sensor, frame, level, time_s, generator):
    """Fill an empty state at the first frame, which gives no event.

    Draws, in this order and only what the sensor has: thresholds, leak rates, hot pixels, first noise
    hazards, keys.
    Args: frame: [H, W] intensity. level: [H, W] its log level.
    """
    pixels = level.shape
    place = {"dtype": level.dtype, "device": level.device}
    exact = (
        sensor.timing == "v2e" and sensor.theta_sigma == 0
    )  # v2e keeps drawn thresholds in single, nominal ones in double precision
    state.theta_on, state.theta_off = draw_thresholds(
        sensor, pixels, generator, dtype=torch.float64 if exact else level.dtype, device=level.device
    )
    state.reference = level.clone()
    state.level = level.clone()
    if sensor.timing == "interpolated":
        state.reference_rest = torch.zeros_like(level)
    state.start_s = state.time_s = time_s
    if sensor.leaks:
        state.leak_hz = draw_leak_rates(sensor, pixels, generator, **place)
    if sensor.refractory_s > 0:
        quiet_s = (
            sensor.refractory_s if sensor.timing == "v2e" else 1e6
        )  # seconds; v2e's first event also waits
        state.last_event_s = torch.full(pixels, -quiet_s, **place)
    if sensor.cutoff_hz > 0 or sensor.has_shots:
        state.input = frame.clone()
    if sensor.cutoff_hz > 0:
        state.input_level = level.clone()
    if sensor.photoreceptor_noise:
        state.noise = torch.zeros(pixels, **place)
    if sensor.timing == "interpolated" and (
        sensor.has_shots or sensor.photoreceptor_noise or (sensor.leaks and sensor.leak_jitter > 0)
    ):
        uniform = torch.rand(tuple(pixels), generator=generator, dtype=torch.float64, device=generator.device)
        state.hazard = (-torch.log1p(-uniform)).to(level)
        whole = torch.iinfo(torch.int32)
        state.key = torch.randint(
            whole.min,
            whole.max,
            tuple(pixels),
            generator=generator,
            dtype=torch.int64,
            device=generator.device,
        ).to(level.device, torch.int32)
        state.shots = torch.zeros(pixels, dtype=torch.int32, device=level.device)
