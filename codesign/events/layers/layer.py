"""One interface for every differentiable event layer: the same call, the same result, learnable sensor
parameters."""

import torch
from torch import nn

from codesign.errors import DomainError
from codesign.events.entry import check_frames
from codesign.events.intensity import FrontEnd
from codesign.events.layers.dense import dense
from codesign.events.layers.expected import expected
from codesign.events.layers.memory import memory
from codesign.events.layers.physical import DESIGN, sensor_counts
from codesign.events.layers.soft import soft
from codesign.events.sensor.model import SensorModel, draw_thresholds

KINDS = ("sigmoid", "dense", "memory", "expected", "sensor")


class EventLayer(nn.Module):
    """Frames to event counts, by one of five models of growing truth.

    kind: "sigmoid" (per frame pair, no memory: the baseline), "dense" (comparator with surrogate, one event
      per frame), "memory" (memorised level,
    straight-through counts: the default), "expected" (mean counts under threshold mismatch), "sensor" (the
      full physical sensor).
    sensor: SensorModel. The first four use its thresholds ("memory" and "dense" also its mismatch); "sensor"
      uses all of it.
    learn: fields of the sensor to learn, of theta_on, theta_off, theta_sigma, cutoff_hz, refractory_s; kept
      as logarithms in ``log_values``.
    spread: relative threshold spread of "expected"; assign to anneal it (see ``annealed``). seed: of
      thresholds and noise; fixed, so that calls repeat.
    """

    def __init__(self, kind="memory", sensor=None, *, learn=(), spread=0.15, seed=0, log_input=False):
        super().__init__()
        self.kind = kind
        self.sensor = sensor or SensorModel()
        self.spread = spread
        self.seed = seed
        self.log_input = log_input
        if kind not in KINDS:
            raise DomainError(f"kind is {kind!r}; event layers are {', '.join(map(repr, KINDS))}.")
        allowed = DESIGN if kind == "sensor" else ("theta_on", "theta_off")
        for name in learn:
            if name not in allowed:
                raise DomainError(
                    f"the layer {kind!r} cannot learn {name!r}; it learns {', '.join(allowed)}."
                )
            if getattr(self.sensor, name) <= 0:
                raise DomainError(
                    f"{name} is 0 in the sensor, so it is switched off; give a value above 0 to learn it."
                )
        self.log_values = nn.ParameterDict(
            {
                name: nn.Parameter(torch.tensor(getattr(self.sensor, name), dtype=torch.float64).log())
                for name in learn
            }
        )

    def value(self, name):
        """A field of the sensor as it is now: a 0-dim tensor with a gradient when it is learnt, a number
        otherwise."""
        return self.log_values[name].exp() if name in self.log_values else getattr(self.sensor, name)

    def forward(self, frames, t_s, state=None):
        """Counts of the frames.

        Args: frames: [T, ...] (0-255 scale; log levels with ``log_input``). t_s: [T] seconds. state: what an
          earlier call returned, to go on behind it.
        Returns: counts [T-1, 2, ...] ([T, 2, ...] with a state), ON first; the state to carry on (it keeps
          its graph).
        """
        if self.kind == "sensor":
            design = {name: self.value(name) for name in self.log_values}
            return sensor_counts(
                frames,
                t_s,
                self.sensor,
                generator=torch.Generator().manual_seed(self.seed),
                state=state,
                log_input=self.log_input,
                **design,
            )
        theta_on, theta_off = self._thetas(frames)
        if self.kind == "sigmoid":
            return self._sigmoid(frames, (theta_on, theta_off), state)
        if self.kind == "expected":
            return expected(frames, theta_on, theta_off, self.spread, state=state, log_input=self.log_input)
        return {"memory": memory, "dense": dense}[self.kind](
            frames, theta_on, theta_off, state=state, log_input=self.log_input
        )

    def _thetas(self, frames):
        """Thresholds ON and OFF, with the mismatch of every pixel where the layer knows mismatch."""
        nominal = [
            torch.as_tensor(self.value(name), dtype=frames.dtype, device=frames.device)
            for name in ("theta_on", "theta_off")
        ]
        if self.sensor.theta_sigma == 0 or self.kind in ("sigmoid", "expected"):
            return nominal
        place = {"dtype": frames.dtype, "device": frames.device}
        drawn = draw_thresholds(
            self.sensor, frames.shape[1:], torch.Generator().manual_seed(self.seed), **place
        )
        return [theta + (pixels - theta.detach()) for theta, pixels in zip(nominal, drawn, strict=True)]

    def _sigmoid(self, frames, thetas, state):
        check_frames(frames, 2 if state is None else 1, non_negative=not self.log_input)
        level = FrontEnd(self.log_input).level(frames)
        both = level if state is None else torch.cat((state[None], level))
        on, off = (soft(both, theta, log_input=True)[:, index] for index, theta in enumerate(thetas))
        return torch.stack((on, off), dim=1), level[-1]
