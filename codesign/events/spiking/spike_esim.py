"""Spike-ESIM: an event generator that starts as the ideal memorised-reference sensor and learns
what a real one does differently."""

import io
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Generator, Tensor, nn

from codesign.arrays import read_npz
from codesign.atomic import write_atomic
from codesign.checks import check_choice, check_path, check_positive, check_seed, check_whole
from codesign.errors import CodesignError, DomainError, FileFormatError, ShapeError
from codesign.events.entry import (
    Times,
    check_chunk,
    check_frames,
    check_later,
    check_state,
    check_times,
    shown,
    warn_of_scale,
)
from codesign.events.intensity import lin_log
from codesign.events.layers.memory import memory
from codesign.events.layers.physical import sensor_counts
from codesign.events.sensor.model import SensorModel, check_generator
from codesign.events.spiking.spike_esim_parts import (
    Bandwidth,
    NoiseRate,
    Prefilter,
    ResidualBranch,
    ToneCurve,
    stepwise,
)
from codesign.events.spiking.srm import count_spikes
from codesign.reading import reading

COMPARATORS = ("memory", "srm")
REMEDY = "give the .npz file that SpikeEsim.save wrote"
SETTINGS = "settings"  # name of the settings, JSON, in a file beside the parameters
SLOW_S = 0.05  # time constant of the slow level that the residual branch compares with


@dataclass(frozen=True)
class SpikeEsimState:
    """What Spike-ESIM carries over chunks; it keeps its graph.

    level, filtered, slow: [B, 1, H, W] level behind the tone curve, behind the bandwidth, and a
      slow mean of it. frame: [...] last frame, time_s its time.
    comparator: state of the comparator.
    """

    level: Tensor
    filtered: Tensor
    slow: Tensor
    frame: Tensor
    time_s: float
    comparator: Any


class SpikeEsim(nn.Module):
    """Frames to events: log level, prefilter, tone curve, bandwidth, residual branch, and a
    comparator with a memorised level per pixel.

    Untrained it is the ideal sensor of the given thresholds, exactly: every learnt part starts as
    the identity or at zero effect.

    theta_on, theta_off: contrast thresholds > 0, natural log units. refractory_s: dead time, 0 for
      none; learnt when above 0. cutoff_hz: corner frequency at full light that the bandwidth starts
      to learn from.
      comparator: "memory" (any number of events per interval) or "srm" (coupled spike response
      layer, at most one per step and polarity). width, depth: of the residual branch. seed: of its
      weights.
    """

    def __init__(
        self,
        theta_on: float = 0.2,
        theta_off: float = 0.2,
        *,
        refractory_s: float = 0.0,
        cutoff_hz: float = 100.0,
        comparator: str = "memory",
        width: int = 6,
        depth: int = 1,
        seed: int = 0,
    ):
        super().__init__()
        self.settings = {
            "theta_on": check_positive(theta_on, "theta_on", least=1e-6),
            "theta_off": check_positive(theta_off, "theta_off", least=1e-6),
            "refractory_s": refractory_s and check_positive(refractory_s, "refractory_s"),
            "cutoff_hz": check_positive(cutoff_hz, "cutoff_hz", least=1e-6),
            "comparator": check_choice(comparator, "comparator", COMPARATORS),
            "width": check_whole(width, "width", 1, 4096),
            "depth": check_whole(depth, "depth", 1, 256),
            "seed": check_seed(seed, "seed"),
        }
        if comparator == "srm" and refractory_s > 0:
            raise DomainError(
                f"refractory_s is {refractory_s!r}, but the comparator 'srm' has no dead time; choose "
                "'memory', or refractory_s=0."
            )
        # of the thresholds, so that 0 is the given one exactly
        self.log_gain = nn.Parameter(torch.zeros(2, dtype=torch.float64))
        self.log_dead = (
            nn.Parameter(torch.zeros((), dtype=torch.float64)) if refractory_s > 0 else None
        )
        self.prefilter = Prefilter()
        self.tone = ToneCurve()
        self.bandwidth = Bandwidth(cutoff_hz)
        self.branch = ResidualBranch(width, depth, seed)
        self.noise_rate = NoiseRate()

    def thetas(self) -> Tensor:
        """Thresholds ON and OFF as they are now: [2] float64, natural log units."""
        given = self.settings["theta_on"], self.settings["theta_off"]
        return self.log_gain.new_tensor(given) * self.log_gain.exp()

    def refractory_s(self) -> Tensor | None:
        """Dead time as it is now, 0-dim tensor, or None when there is none."""
        return (
            None if self.log_dead is None else self.settings["refractory_s"] * self.log_dead.exp()
        )

    def forward(
        self,
        frames: Tensor,
        t_s: Times,
        state: SpikeEsimState | None = None,
        *,
        theta_scale: Tensor | float = 1.0,
    ) -> tuple[Tensor, SpikeEsimState]:
        """Events of the frames, without noise.

        Args:
          frames: [T, H, W] or [T, B, H, W] linear intensity on the 0-255 scale, finite, >= 0. t_s:
            [T] seconds.
          state: SpikeEsimState of the chunk before; then T frames give T intervals. None: T frames
            give T-1.
          theta_scale: factor on both thresholds for this call, a number or [2] tensor (ON, OFF):
            sensitivity at test time.
        Returns: counts [T-1, 2, ...] whole numbers, ON first; state to carry on. Chunks equal the
          whole bit for bit on one machine with one number of threads: every step sees the same
          calls on the same shapes. Batches equal their sequences but for levels within rounding of
          a threshold.
        Gradient: every parameter but the noise rates, and frames; through the comparator.
        Raises: ShapeError, DomainError for frames, times or scales that cannot be (NaN and infinity
          among them).
        """
        frames, times_s = _checked(frames, t_s, state)
        try:
            scale = torch.as_tensor(theta_scale, dtype=torch.float64)
        except (TypeError, ValueError, RuntimeError, OverflowError):
            scale = torch.zeros(())
        if (
            scale.is_meta
            or scale.shape not in ((), (2,))
            or not bool((scale.isfinite() & (scale > 0)).all())
        ):
            raise DomainError(
                f"theta_scale is {shown(theta_scale)}; a finite factor > 0, or one each for ON and "
                "OFF, is needed."
            )
        seen, after = self._levels(frames, times_s, state)
        theta = self.thetas() * scale
        before = None if state is None else state.comparator
        if self.settings["comparator"] == "srm":
            counts, comparator = count_spikes(seen, theta, before)
        elif self.log_dead is None:
            counts, comparator = memory(seen, theta[0], theta[1], state=before, log_input=True)
        else:
            counts, comparator = sensor_counts(
                seen,
                times_s[-len(seen) :],
                SensorModel(),
                state=before,
                log_input=True,
                theta_on=theta[0],
                theta_off=theta[1],
                refractory_s=self.refractory_s(),
            )
        return counts, SpikeEsimState(*after, frames[-1].clone(), float(times_s[-1]), comparator)

    def expected_noise(
        self,
        frames: Tensor,
        t_s: Times,
        state: SpikeEsimState | None = None,
    ) -> Tensor:
        """Mean number of noise events per interval, [T-1, 2, ...] ([T, 2, ...] with a state), ON
        first.
        Gradient: the noise rates, frames."""
        frames, times_s = _checked(frames, t_s, state)
        if state is not None:
            frames = torch.cat((state.frame[None], frames))
        interval_s = times_s.diff().to(frames).reshape(-1, *[1] * (frames.ndim - 1))
        return self.noise_rate((frames[1:] + frames[:-1]) / 2) * interval_s[:, None]

    @torch.no_grad()
    def draw(
        self,
        frames: Tensor,
        t_s: Times,
        generator: Generator,
        state: SpikeEsimState | None = None,
        *,
        theta_scale: Tensor | float = 1.0,
    ) -> tuple[Tensor, SpikeEsimState]:
        """Hard events with noise: ``forward`` plus a Poisson draw of ``expected_noise``. Returns
        counts and state."""
        check_generator(generator)
        noise = torch.poisson(self.expected_noise(frames, t_s, state), generator=generator)
        counts, after = self(frames, t_s, state, theta_scale=theta_scale)
        return counts + noise, after

    def save(self, path: str | Path) -> None:
        """Write settings and parameters as an .npz file."""
        parameters = {
            name: value.detach().cpu().numpy() for name, value in self.state_dict().items()
        }
        buffer = io.BytesIO()
        np.savez(buffer, **{SETTINGS: np.array(json.dumps(self.settings))}, **parameters)
        write_atomic(check_path(path), buffer.getvalue())

    @classmethod
    def load(cls, path: str | Path) -> "SpikeEsim":
        """A generator that ``save`` wrote. Raises: FileFormatError when the file is missing,
        damaged or of another kind."""
        path = check_path(path)
        stored = read_npz(path, REMEDY)
        with reading(f"'{path}'", REMEDY):
            settings = json.loads(str(stored.pop(SETTINGS)))
            parameters = {name: torch.from_numpy(values) for name, values in stored.items()}
        try:
            with reading(f"'{path}'", REMEDY):
                generator = cls(**settings)
                generator.load_state_dict(parameters)
        except CodesignError as error:
            raise FileFormatError(f"'{path}' holds no generator ({error}); {REMEDY}.") from error
        for name, value in parameters.items():
            if not bool(value.isfinite().all()):
                raise FileFormatError(
                    f"'{path}' holds NaN or infinity in '{name}'; train and save the generator again."
                )
        return generator

    def _levels(self, frames, times_s, state):
        """What the comparators see, [T, ...], and (level, filtered, slow) after the last frame."""
        intensity = frames.reshape(len(frames), -1, *frames.shape[-2:])
        # one by one: logarithms of vectors round by their place
        log_level = torch.stack([lin_log(picture[None])[0] for picture in intensity])
        levels = stepwise(
            lambda pictures: self.tone(self.prefilter(pictures)), log_level[:, :, None]
        )
        if state is None:
            filtered = slow = before = levels[0]
            light = intensity[0]
            follow = [(filtered, slow)]
        else:
            filtered, slow, before = state.filtered, state.slow, state.level
            light = state.frame.reshape(intensity.shape[1:])
            follow = []
        seen = zip(
            levels[len(follow) :], intensity[len(follow) :], times_s.diff().tolist(), strict=True
        )
        for now, picture, step_s in seen:
            filtered = self.bandwidth.advance(
                filtered, before, now, (light + picture)[:, None] / 2, step_s
            )
            slow = now + (slow - now) * math.exp(-step_s / SLOW_S)
            follow.append((filtered, slow))
            before = now
            light = picture
        low, mean = (torch.stack(pictures) for pictures in zip(*follow, strict=True))
        # of the order of 1
        pictures = torch.cat((levels / 4 - 1, 4 * (levels - low), 2 * (levels - mean)), dim=2)
        seen = self.bandwidth.mixed(levels, low) + stepwise(self.branch, pictures)
        return seen.reshape(frames.shape), (before, filtered, slow)


def _checked(frames, t_s, state):
    """Frames as given and the times of all frames seen by this call, that of the state's last frame
    first."""
    check_frames(frames, 2 if state is None else 1)
    if frames.ndim not in (3, 4) or min(frames.shape[-2:]) < 2:
        raise ShapeError(
            f"frames have shape {list(frames.shape)}; [T, H, W] or [T, B, H, W] of at least 2 x 2 pixels is "
            "needed."
        )
    warn_of_scale(frames, False)
    times_s = check_times(t_s, len(frames))
    if state is None:
        return frames, times_s
    check_state(state, SpikeEsimState)
    check_chunk(frames, state.frame.shape, state.frame.dtype)
    return frames, check_later(times_s, state.time_s)
