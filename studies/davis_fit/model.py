"""The sensor whose parameters are fitted: dark offset, blur, low-pass, two thresholds on a memorised level,
and noise that fades with light."""

from dataclasses import dataclass

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor

from codesign import events

BLUR_SIGMA_PX = 1.0
BLUR_TAPS = 9
START = {
    "theta_on": 0.2,
    "theta_off": 0.2,
    "dark_offset": 10.0,
    "blur_odds": 0.3,
    "time_constant_s": 2e-3,
    "noise_on_hz": 0.3,
    "noise_off_hz": 0.3,
}


@dataclass(frozen=True)
class Clip:
    """Frames as the model sees them. sharp, blurred: [(T-1) n + 1, H, W]; step_s: time between them;
    per_interval: n, steps per recorded interval."""

    sharp: Tensor
    blurred: Tensor
    step_s: float
    per_interval: int

    def until(self, interval):
        """The clip up to the end of interval number ``interval`` - 1."""
        stop = interval * self.per_interval + 1
        return Clip(self.sharp[:stop], self.blurred[:stop], self.step_s, self.per_interval)


def clip(frames, step_s, per_interval):
    """Clip of frames [(T-1) n + 1, H, W] and of the same blurred by a Gaussian of 1 px."""
    return Clip(frames, blur(frames), step_s, per_interval)


class FittedSensor(torch.nn.Module):
    """Sensor that is fitted: an event layer with learnt thresholds, and what stands before and behind it.

    ``values()`` are: theta_on, theta_off (natural log units), dark_offset (units of the 0-255 scale),
    blur_odds (share s of the blurred picture as s/(1-s)), time_constant_s, noise_on_hz, noise_off_hz (events
    per pixel and second in the dark). A unit step of a parameter is a tenth of its value.
    """

    def __init__(self, **start: float):
        super().__init__()
        begun = {**START, **start}
        sensor = events.SensorModel(begun.pop("theta_on"), begun.pop("theta_off"))
        self.pixel = events.layer("memory", sensor, log_input=True)
        self.others = events.PositiveValues(begun)

    def values(self):
        """Dictionary of the physical values, 0-d tensors with gradients."""
        return {name: part[name] for part in (self.pixel.learnt, self.others) for name in part}

    def levels(self, clip):
        """Level that the comparators see, [(T-1) n + 1, H, W]: low-pass of ln((1 - s) sharp + s blurred +
        dark_offset)."""
        share = self.others["blur_odds"] / (1 + self.others["blur_odds"])
        level = (
            torch.lerp(clip.sharp, clip.blurred, share.to(clip.sharp)) + self.others["dark_offset"]
        ).log()
        pace = clip.step_s / self.others["time_constant_s"]
        return events.one_pole(level, pace.to(level).expand(len(level) - 1))

    def signal(self, clip):
        """Hard counts per recorded interval, [T-1, 2, H, W], with the straight-through gradient of
        ``events.memory``."""
        counts = self.pixel(self.levels(clip), torch.arange(len(clip.sharp)) * clip.step_s)
        return counts.unflatten(0, (-1, clip.per_interval)).sum(1)

    def noise(self, clip):
        """Expected noise events per interval, [T-1, 2, H, W]: rate in the dark times (d/(I + d))^2 with the
        dark offset d.

        A disturbance of the photocurrent moves the level by its share of I + d; the square stands for its
        power.
        """
        now = self.values()
        fade = (now["dark_offset"] / (clip.blurred[: -1 : clip.per_interval] + now["dark_offset"])).square()
        return (
            clip.step_s
            * clip.per_interval
            * torch.stack((now["noise_on_hz"] * fade, now["noise_off_hz"] * fade), dim=1)
        )

    def expected(self, clip):
        """Signal and expected noise together, [T-1, 2, H, W]: what the fit compares with the recording."""
        return self.signal(clip) + self.noise(clip)

    @torch.no_grad()
    def draw(self, clip, generator):
        """One hard outcome, [T-1, 2, H, W]: signal and Poisson noise."""
        return self.signal(clip) + torch.poisson(self.noise(clip), generator=generator)


def blur(frames):
    """Gaussian blur of 1 px, edges repeated. frames: [T, H, W]."""
    size = (BLUR_TAPS, BLUR_TAPS)
    return gaussian_blur2d(frames[:, None], size, (BLUR_SIGMA_PX, BLUR_SIGMA_PX), "replicate")[:, 0]
