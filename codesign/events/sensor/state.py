"""What a sensor remembers between chunks of frames, and how it begins."""

from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from codesign.checks import check_kind
from codesign.errors import DomainError
from codesign.events.sensor.model import (
    draw_deviates,
    draw_keys,
    draw_leaks,
    leak_rates,
    thresholds,
)


@dataclass
class SensorState:
    """Memory of a sensor. Make an empty one; ``simulate`` fills it and moves it on.

    reference: [H, W] memorised log level. level: [H, W] log level behind the low-pass. theta_on,
      theta_off: [H, W] thresholds as they are now.
    start_s, time_s: times of the first and the last frame. generator: used when none is passed;
      starts at seed 0. Only where the sensor needs them: reference_rest: [H, W] what rounding took
      from the memorised level (not for timing "v2e"); input_level, input: [H, W] last log level
      before the low-pass, last intensity; noise: [H, W] photoreceptor noise; leak_hz: [H, W] as it
      is now; deviate_on, deviate_off, leak_spread, leak_heat: [H, W] numbers drawn for thresholds
      and leaks; last_event_s: [H, W] time of the last event (since the first frame for timing
      "v2e", since the last frame otherwise, so <= 0); hazard: [H, W] noise still to pass until the
      next noise event; key, shots: [H, W] int32 random key and noise events so far.
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
    deviate_on: Tensor | None = None
    deviate_off: Tensor | None = None
    leak_spread: Tensor | None = None
    leak_heat: Tensor | None = None
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
    check_kind(state, SensorState, "the state", "pass an events.SensorState")
    if state.level is None:
        return
    needs = {
        "timing='interpolated'": ("reference_rest", sensor.timing == "interpolated"),
        "a mismatch of thresholds": ("deviate_on", sensor.theta_sigma > 0),
        "a spread of leaks": ("leak_spread", sensor.leaks_unevenly),
        "hot pixels": ("leak_heat", sensor.has_hot_pixels),
        "a dead time": ("last_event_s", sensor.refractory_s > 0),
        "a bandwidth": ("input_level", sensor.cutoff_hz > 0),
        "noise events": ("hazard", sensor.has_shots and sensor.timing == "interpolated"),
        "a leak that jitters": ("key", sensor.leak_jitters and sensor.timing == "interpolated"),
        "photoreceptor noise": ("noise", sensor.photoreceptor_noise),
    }
    lacks = [
        what for what, (name, asked) in needs.items() if asked and getattr(state, name) is None
    ]
    if sensor.timing == "v2e" and state.reference_rest is not None:
        lacks.append("timing='v2e'")
    if lacks:
        raise DomainError(
            f"the sensor has {' and '.join(lacks)}, the one that began the state had not; pass the sensor of "
            "the first chunk, or an empty state."
        )


def begin(state, sensor, frame, level, time_s, generator):
    """Fill an empty state at the first frame, which gives no event.

    Draws, in this order and only what the sensor has: thresholds, leak rates, hot pixels, first
    noise hazards, keys. Args:
      frame: [H, W] intensity.
      level: [H, W] its log level.
    """
    pixels = level.shape
    place = {"dtype": level.dtype, "device": level.device}
    if sensor.theta_sigma > 0:
        state.deviate_on, state.deviate_off = draw_deviates(pixels, generator, dtype=level.dtype)
    state.leak_spread, state.leak_heat = draw_leaks(sensor, pixels, generator, dtype=level.dtype)
    state.reference = level.clone()
    state.level = level.clone()
    if sensor.timing == "interpolated":
        state.reference_rest = torch.zeros_like(level)
    state.start_s = state.time_s = time_s
    if sensor.refractory_s > 0:
        # v2e's first event also waits
        quiet_s = sensor.refractory_s if sensor.timing == "v2e" else 1e6
        state.last_event_s = torch.full(pixels, -quiet_s, **place)
    _set(state, sensor)
    if sensor.cutoff_hz > 0 or sensor.has_shots:
        state.input = frame.clone()
    if sensor.cutoff_hz > 0:
        state.input_level = level.clone()
    if sensor.photoreceptor_noise:
        state.noise = torch.zeros(pixels, **place)
    draws = sensor.has_shots or sensor.photoreceptor_noise or sensor.leak_jitters
    if sensor.timing == "interpolated" and draws:
        uniform = torch.rand(
            tuple(pixels), generator=generator, dtype=torch.float64, device=generator.device
        )
        state.hazard = (-torch.log1p(-uniform)).to(level)
        state.key = draw_keys(tuple(pixels), generator).to(level.device)
        state.shots = torch.zeros(pixels, dtype=torch.int32, device=level.device)


def leak_before(state, sensor, generator):
    """Let a state that has begun have leaked for some time, drawn evenly up to the event of each
    pixel: else all leaks would come together, and none in a short run."""
    if sensor.leaks:
        come = torch.rand(state.level.shape, generator=generator, device=generator.device)
        state.reference = state.reference - come.to(state.level) * state.theta_on * (
            state.leak_hz > 0
        )


def change(state, sensor):
    """Give the pixels of a state the values of a sensor, which may be another than before: its
    thresholds and leaks by the numbers drawn at first, and no noise where it has none.

    Returns: [2, H, W] events, ON first, of pixels that stand beyond their thresholds now (at the
      time of the last frame; the memorised level moves by them), None where nothing of that kind
      has changed, or with the timing of v2e, which looks at the ends of intervals alone.
    """
    before = state.theta_on, state.theta_off
    quiets = state.noise is not None and not sensor.photoreceptor_noise and bool(state.noise.any())
    _set(state, sensor)
    if quiets:
        state.noise = torch.zeros_like(state.noise)
    same = all(map(torch.equal, before, (state.theta_on, state.theta_off)))
    if (same and not quiets) or sensor.timing == "v2e":
        return None
    seen = state.level if state.noise is None else state.level + state.noise
    beyond = (seen - state.reference) - state.reference_rest
    counts = torch.stack(((beyond / state.theta_on).floor(), (-beyond / state.theta_off).floor()))
    counts = counts.clamp(min=0)
    state.reference = state.reference + counts[0] * state.theta_on - counts[1] * state.theta_off
    if sensor.refractory_s > 0:  # of those at one time the first is kept
        counts = counts.clamp(max=1) * (-state.last_event_s >= sensor.refractory_s)
        state.last_event_s = state.last_event_s.where(counts.sum(0) == 0, 0)
    return counts


def _set(state, sensor):
    """Thresholds and leaks of a sensor, by the numbers drawn for the pixels."""
    level = state.reference
    kinds = (level.dtype, level.dtype)
    # it keeps what is drawn in single, nominal thresholds in double precision
    if sensor.timing == "v2e":
        kinds = torch.float32, torch.float32 if sensor.theta_sigma > 0 else torch.float64
    rates, thetas = ({"dtype": kind, "device": level.device} for kind in kinds)
    deviates = state.deviate_on, state.deviate_off
    state.theta_on, state.theta_off = thresholds(sensor, level.shape, deviates, **thetas)
    drawn = state.leak_spread, state.leak_heat
    state.leak_hz = leak_rates(sensor, level.shape, *drawn, **rates) if sensor.leaks else None
