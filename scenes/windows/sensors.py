"""Windows of events as real sensors give them, to train on: few or many events per pixel, unequal
thresholds, bandwidth, dead time, noise per second, leak and hot pixels; layers that bend and hurry
while they move."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from codesign.events import SensorModel, SensorState, dense_counts
from codesign.events.sensor.state import begin
from scenes.windows.layers import Bent, compose
from scenes.windows.motion import displacement, pace
from scenes.windows.rendered import DARKEST, LEAD, RenderedWindows, Windows, log_uniform

CONTRAST = (0.02, 2.5)  # factors on the texture's log radiance that a density may ask for
NOISE_SHARE = 0.5  # noise events at most, per event of the scene


@dataclass(frozen=True)
class Sensors:
    """Ranges (least, most) of sensors and of what they look at, each drawn evenly in the logarithm.

    Args:
      density: events per pixel and window that contrast is set for (noise comes on top, and what
        contrasts of 0.02 to 2.5 times the texture's cannot reach stays as it is).
      light: mean radiance, 0..255 scale; the bandwidth grows with it.
      duration_s: length of the window, which noise, leak, bandwidth and dead time refer to.
      theta, imbalance: threshold ON, and OFF over ON.
      mismatch: spread over pixels, relative.
      cutoff_hz, shot_rate_hz, leak_rate_hz, refractory_s, hot_rate_hz: as in events.SensorModel.
      hot_share: of the pixels, drawn evenly from 0 to this.
      bend: displacement of a layer on top of its homography, relative to flow_px's upper end,
        evenly from 0.
      pace: largest change of speed within a window.
    """

    density: tuple[float, float] = (0.08, 12.0)
    light: tuple[float, float] = (10.0, 150.0)
    duration_s: tuple[float, float] = (0.003, 0.06)
    theta: tuple[float, float] = (0.1, 0.4)
    imbalance: tuple[float, float] = (0.75, 1.33)
    mismatch: tuple[float, float] = (0.01, 0.15)
    cutoff_hz: tuple[float, float] = (50.0, 3000.0)
    shot_rate_hz: tuple[float, float] = (0.05, 5.0)
    leak_rate_hz: tuple[float, float] = (0.01, 0.3)
    refractory_s: tuple[float, float] = (1e-5, 1e-3)
    hot_share: float = 5e-4
    hot_rate_hz: tuple[float, float] = (30.0, 600.0)
    bend: float = 0.0
    pace: float = 0.3


class SensorWindows(RenderedWindows):
    """Windows seen by sensors that all differ.

    The memorised levels start between the thresholds with the triangular density of a level that
    has wandered for long: each event sets it to the middle. Args:
      draws: what moves (its theta, mismatch, noise and contrast are not used).
      sensors: what looks.
      intervals: frames per window.
      options: others as RenderedWindows.
    """

    def __init__(self, draws=None, sensors=None, *, intervals=24, **options):
        super().__init__(draws, intervals=intervals, **options)
        self.sensors = sensors or Sensors()

    def _window(self, index):
        draw = np.random.default_rng((self.seed, index, 1))
        sample = self._draw(index, pace(draw, self.t, self.sensors.pace))
        if self.sensors.bend > 0:
            layers = [
                replace(layer, motion=self._bent(draw, layer.motion)) for layer in sample.layers
            ]
            sample = replace(sample, layers=layers)
        points = self._undistorted(sample.distortion)
        frames = compose(sample.layers, points)
        return self._events(draw, frames), *self._truth(sample, points), frames[[LEAD, -1]]

    def _counts(self, seen):
        return Windows._counts(self, seen)

    def _bent(self, draw, plane):
        rms_px = draw.uniform(0, self.sensors.bend) * self.draws.flow_px[1]
        field = displacement(draw, self.width_px, self.height_px, rms_px)
        return Bent(plane.homographies, field, torch.from_numpy(pace(draw, self.t, 0.0)).float())

    def _events(self, draw, frames):
        """Counts [intervals, 2, H, W] of the window behind a sensor of its own."""
        s = self.sensors
        density, light, duration_s, theta, imbalance, mismatch = (
            log_uniform(draw, *limits)
            for limits in (s.density, s.light, s.duration_s, s.theta, s.imbalance, s.mismatch)
        )
        sensor = SensorModel(
            theta_on=theta,
            theta_off=theta * imbalance,
            theta_sigma=theta * mismatch,
            cutoff_hz=log_uniform(draw, *s.cutoff_hz),
            leak_rate_hz=min(
                log_uniform(draw, *s.leak_rate_hz), NOISE_SHARE / 2 * density / duration_s
            ),
            rate_cov_decades=0.2,
            shot_rate_hz=min(
                log_uniform(draw, *s.shot_rate_hz), NOISE_SHARE * density / duration_s
            ),
            refractory_s=log_uniform(draw, *s.refractory_s),
            hot_pixel_share=draw.uniform(0, s.hot_share),
            hot_pixel_rate_hz=log_uniform(draw, *s.hot_rate_hz),
        )
        level = frames.clamp_min(DARKEST).log()
        path = float(level[LEAD:].diff(dim=0).abs().sum(0).mean())
        contrast = float(np.clip(density * theta * np.sqrt(imbalance) / max(path, 1e-9), *CONTRAST))
        level = np.log(light) + contrast * (level - level.mean())
        t_s = duration_s * torch.from_numpy(self.t)
        generator = torch.Generator().manual_seed(int(draw.integers(2**62)))
        state = SensorState()
        begin(state, sensor, level[0].exp(), level[0], float(t_s[0]), generator)
        place = torch.rand((2, *level[0].shape), generator=generator).sum(0) - 1
        state.reference = state.reference - place * torch.where(
            place > 0, state.theta_on, state.theta_off
        )
        return dense_counts(level[1:], t_s[1:], sensor, generator, state, log_input=True)[LEAD:]
