"""The full sensor made differentiable: hard events forward, and backward the slopes of a smooth
account of the same physics."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Generator, Tensor

from codesign.errors import ShapeError
from codesign.events.entry import (
    Times,
    check_begun,
    check_frames,
    check_later,
    check_state,
    check_times,
)
from codesign.events.intensity import FrontEnd
from codesign.events.layers import dead_time, dead_time_limits
from codesign.events.layers.layer import EventLayer
from codesign.events.layers.memory import memory
from codesign.events.low_pass import low_pass
from codesign.events.sensor.model import (
    DESIGN,
    SensorModel,
    apart,
    of_pixels,
    with_design,
)
from codesign.events.sensor.simulate import dense_counts
from codesign.events.sensor.state import SensorState


@dataclass(frozen=True)
class PhysicalState:
    """What ``sensor_counts`` carries over chunks. sensor: SensorState of the hard sensor;
    reference, level:
    [...] of the smooth account (their graph is kept); frame: [...] last frame; time_s: time of the
    last frame;
    dead: state of the dead time's account, None where no gradient was asked."""

    sensor: SensorState
    reference: Tensor
    level: Tensor
    frame: Tensor
    time_s: float
    dead: dead_time.DeadTimeState | None = None


def sensor_counts(
    frames: Tensor,
    t_s: Times,
    sensor: SensorModel,
    *,
    generator: Generator | None = None,
    state: PhysicalState | None = None,
    log_input: bool = False,
    **design: Tensor | float,
) -> tuple[Tensor, PhysicalState]:
    """Event counts of the physical sensor with gradients to frames and to the sensor's own
    parameters.

    Forward: exactly the counts of ``simulate``, noise and all. Backward: the low-pass is linear and
      exact; thresholds are C = theta + sigma e with the drawn e held fixed; leakage adds a known
      ramp; counts follow ``memory`` (slope 1/C through the memorised level); dead time passes what
      it would pass on average over where events stand in the threshold, over frames, turns and
      polarities (``layers.dead_time``; one shorter than an eighth of an interval thins n events of
      rate r to n / max(1, r T + 1/2)). Noise events have no gradient, and block none in it.

    Args:
      frames: [T, ...] intensity on the 0-255 scale, or its natural logarithm with ``log_input``.
        t_s: [T] seconds. sensor: SensorModel, timing "interpolated".
      generator: for thresholds and noise; None: seed 0. state: PhysicalState of an earlier chunk
        (then T frames give T intervals).
      design: tensors that replace fields of the sensor and receive gradients: theta_on, theta_off,
        theta_sigma, cutoff_hz, refractory_s (0-dim).
    Returns: counts [T-1, 2, ...] whole numbers, ON first; PhysicalState.
    Gradient: frames and design, as above; docs/events.md has each against differences of the hard
      counts. With a dead time, over a step, cosine (scale) by rate x dead time of the average
      event, 240 frames per second:
        0.7: contrast 1.00 (0.99), focus 0.98 (0.92), shift by a pixel 0.93 (0.92), thresholds 1.00
        (1.02), dead time 1.00 (0.89) 2.9: contrast 1.00 (0.99), focus 0.98 (0.98), shift 0.90
        (0.92), thresholds 0.96 (0.93), dead time 1.00 (0.98) 8.8: contrast 0.98 (0.89), focus 0.86
        (0.99), shift 0.45 (0.84) Warns:
        UserWarning where rate x dead time exceeds 5, or 2 with gradients to thresholds: one
        threshold alone had cosine 0.11 to 0.96 at 2.6 to 2.9, by signal (the play of the mean width
        does not follow fast turns).
    Raises: DomainError for other names in ``design`` (they have no gradient) or values outside the
      sensor's domain, or a dead time that its gradient cannot follow over thousands of intervals;
      and as ``simulate``.
    """
    check_state(state, PhysicalState)
    check_begun(state, generator)
    (state,) = _apart((state,))
    counts, after = _counts(frames, t_s, sensor, generator, state, log_input, design)
    return counts, _apart((after,))[0]


def _apart(states):
    """The states with generators of their own, so that one used twice gives the same twice."""
    if None in states:
        return states
    generators = apart([state.sensor.generator for state in states])
    return tuple(
        replace(state, sensor=replace(state.sensor, generator=generator))
        for state, generator in zip(states, generators, strict=True)
    )


def _counts(frames, t_s, sensor, generator, state, log_input, design):
    """``sensor_counts`` that draws from the generator, or from that of the state."""
    front_end = FrontEnd(log_input)
    hard_sensor = with_design(sensor, design)
    value: dict[str, Any] = {name: design.get(name, getattr(sensor, name)) for name in DESIGN}
    check_frames(frames, 2 if state is None else 1, non_negative=not log_input)
    times_s = check_times(t_s, len(frames))
    hard_state = SensorState(generator=generator) if state is None else replace(state.sensor)
    hard = dense_counts(frames, t_s, hard_sensor, state=hard_state, log_input=log_input)
    if state is not None:
        frames = torch.cat((state.frame[None], frames))
        times_s = check_later(times_s, state.time_s)
    interval_s = times_s.diff()
    level = front_end.level(frames)
    if hard_sensor.cutoff_hz > 0:
        light = frames.exp() if log_input else frames
        start = None if state is None else state.level
        level = low_pass(level, light, interval_s, value["cutoff_hz"], start)
    scatters = hard_sensor.theta_sigma > 0
    deviates = (hard_state.deviate_on, hard_state.deviate_off) if scatters else (None, None)
    thetas = [
        of_pixels(value[name], value["theta_sigma"], deviate, level)
        for name, deviate in zip(("theta_on", "theta_off"), deviates, strict=True)
    ]
    seen = level
    if hard_state.leak_hz is not None:  # a memorised level that falls is a signal that rises
        since_s = (times_s - times_s[0]).to(level).reshape(-1, *[1] * (level.ndim - 1))
        seen = level + since_s * hard_state.leak_hz * thetas[0]
    dead = value["refractory_s"] if hard_sensor.refractory_s > 0 else None
    smooth, reference, dead_state = _mean_counts(seen, thetas, interval_s, dead, state)
    counts = hard + (smooth - smooth.detach())
    ramp = seen[-1] - level[-1]
    after = (
        hard_state,
        reference - ramp,
        level[-1],
        frames[-1].clone(),
        float(times_s[-1]),
        dead_state,
    )
    return counts, PhysicalState(*after)


def _mean_counts(seen, thetas, interval_s, refractory_s, state):
    """Counts with the slopes of their mean over places inside the threshold and behind the dead
    time, [T-1, 2, ...]; the states of ``memory`` and of the dead time after them."""
    start = seen[0] if state is None else state.reference
    slopes = [seen, start, *thetas, refractory_s]
    asked = torch.is_grad_enabled() and any(
        isinstance(x, Tensor) and x.requires_grad for x in slopes
    )
    # without gradients the values are the hard sensor's: nobody asks for what the mean passes
    if refractory_s is None or not asked:
        return *memory(seen[1:], *thetas, state=start, log_input=True), None
    dead_time_limits.warn_beyond(seen, thetas, interval_s, refractory_s)
    dead_s = float(torch.as_tensor(refractory_s).detach())
    if not dead_time_limits.reaches(interval_s, dead_s):
        smooth, reference = memory(seen[1:], *thetas, state=start, log_input=True)
        share = dead_time_limits.local_share(seen.diff(dim=0), thetas, interval_s, refractory_s)
        return smooth * share[:, None], reference, None
    centre, before = (start, None) if state is None else (start[1], state.dead)
    passed, centre, dead = dead_time.mean_counts(
        seen, centre, thetas, interval_s, refractory_s, before
    )
    return passed, torch.stack((centre, centre)), dead


class PhysicalLayer(EventLayer):
    """``events.sensor_counts``: exactly the events of ``events.simulate``, noise and all, with
    gradients to the sensor. A batch is one sample after the other."""

    learnable = DESIGN
    refines = True

    def _count(self, frames, t_s, state, generators):
        samples = frames.reshape(len(frames), -1, *frames.shape[-2:]).unbind(1)
        check_state(state, tuple)
        if state is not None and len(state) != len(samples):
            raise ShapeError(
                f"{len(samples)} samples follow {len(state)}; a batch keeps its samples over the chunks."
            )
        none = [None] * len(samples)
        befores, own = (_apart(state), none) if state else (none, generators)
        design = {name: self.value(name) for name in self.learnt}
        found = [
            _counts(sample, t_s, self.sensor, generator, before, self.log_input, design)
            for sample, generator, before in zip(samples, own, befores, strict=True)
        ]
        counts, states = zip(*found, strict=True)
        return torch.stack(counts, 2).reshape(-1, 2, *frames.shape[1:]), _apart(states)
