"""The sensor whose parameters are fitted: dark offset, blur, low-pass, two thresholds on a memorised level,
and noise that fades with light."""

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor

from codesign import events

BLUR_SIGMA_PX = 1.0
BLUR_RADIUS_PX = 4
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
    """Sensor with unconstrained parameters; ``values()`` are the physical ones, exp of the stored: theta_on,
    theta_off (natural log units),
    dark_offset (units of the 0-255 scale), blur_odds (share s of the blurred picture as s/(1-s)),
    time_constant_s, noise_on_hz, noise_off_hz
    (events per pixel and second in the dark).
    """

    def __init__(self, **start: float):
        super().__init__()
        self.raw = torch.nn.ParameterDict(
            {
                name: torch.nn.Parameter(torch.tensor(math.log(value)))
                for name, value in {**START, **start}.items()
            }
        )

    def values(self):
        """Dictionary of the physical values, 0-d tensors with gradients."""
        return {name: raw.exp() for name, raw in self.raw.items()}

    def levels(self, clip):
        """Level that the comparators see, [(T-1) n + 1, H, W]: low-pass of ln((1 - s) sharp + s blurred +
        dark_offset)."""
        now = self.values()
        share = now["blur_odds"] / (1 + now["blur_odds"])
        return low_pass(
            (torch.lerp(clip.sharp, clip.blurred, share) + now["dark_offset"]).log(),
            clip.step_s,
            now["time_constant_s"],
        )

    def signal(self, clip):
        """Hard counts per recorded interval, [T-1, 2, H, W], with the straight-through gradient of
        ``events.memory``."""
        now = self.values()
        counts, _ = events.memory(self.levels(clip), now["theta_on"], now["theta_off"], log_input=True)
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


def low_pass(level, step_s, time_constant_s):
    """One-pole low-pass of a level that runs linearly between its samples, exact.

    Args: level: [T, ...]. step_s: time between samples. time_constant_s: tensor > 0.
    Returns: [T, ...], starting at rest: y' = (L - y)/tau, y(0) = L(0). A steady ramp comes out tau later.
    Gradient: level, time_constant_s.
    """
    fade = torch.exp(-step_s / time_constant_s)
    out = [level[0]]
    for before, now in pairwise(level):
        lag = (now - before) * (time_constant_s / step_s)
        out.append(now - lag + (out[-1] - before + lag) * fade)
    return torch.stack(out)


def blur(frames):
    """Gaussian blur of 1 px, edges repeated. frames: [T, H, W]."""
    place = torch.arange(-BLUR_RADIUS_PX, BLUR_RADIUS_PX + 1, dtype=frames.dtype)
    weight = torch.exp(-place.square() / (2 * BLUR_SIGMA_PX**2))
    weight = weight / weight.sum()
    wide = F.pad(frames[:, None], (BLUR_RADIUS_PX,) * 4, mode="replicate")
    return F.conv2d(F.conv2d(wide, weight[None, None, :, None]), weight[None, None, None, :])[:, 0]
