"""The sensor that is fitted: dark offset, blur, low-pass, two thresholds on a memorised level, and
noise that fades with light."""

import json
import math
from pathlib import Path

import torch
from kornia.filters import gaussian_blur2d

from codesign import events
from codesign.atomic import write_atomic
from codesign.errors import FileFormatError
from codesign.reading import building, read_json

BLUR_SIGMA_PX = 1.0
BLUR_TAPS = 9
LEARNING_RATE = 1.0  # a step of about a tenth of each value, which falls to 0 on a line
START = {
    "theta_on": 0.2,
    "theta_off": 0.2,
    "dark_offset": 10.0,
    "blur_odds": 0.3,
    "time_constant_s": 2e-3,
    "noise_on_hz": 0.3,
    "noise_off_hz": 0.3,
}


class FittedSensor(torch.nn.Module):
    """Sensor that is fitted: an event layer with learnt thresholds, and what stands before and
    behind it.

    ``values()`` are: theta_on, theta_off (natural log units), dark_offset
    (units of the 0-255 scale), blur_odds (share s of the blurred picture as s/(1-s)),
    time_constant_s, noise_on_hz, noise_off_hz (events per pixel and second in the dark). A unit
    step of a parameter is a tenth of its value. Frames are [T, H, W] float32 on the 0-255 scale,
    t_s their times [T] float64, counts [T-1, 2, H, W].
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

    def levels(self, frames, t_s):
        """Level that the comparators see, [T, H, W]: low-pass of ln((1 - s) sharp + s blurred +
        dark_offset).

        ``events.simulate(levels, t_s, SensorModel(theta_on, theta_off), log_input=True)`` gives a
        stream.
        """
        share = self.others["blur_odds"] / (1 + self.others["blur_odds"])
        picture = torch.lerp(frames, blur(frames), share.to(frames))
        pace = t_s.diff() / self.others["time_constant_s"]
        return events.one_pole((picture + self.others["dark_offset"]).log(), pace.to(frames))

    def signal(self, frames, t_s):
        """Hard counts per interval, with the straight-through gradient of ``events.memory``."""
        return self.pixel(self.levels(frames, t_s), t_s)

    def noise(self, frames, t_s):
        """Expected noise events per interval: rate in the dark times (d/(I + d))^2 with the dark
        offset d.

        A disturbance of the photocurrent moves the level by its share of I + d; the square stands
        for its power.
        """
        now = self.values()
        fade = (now["dark_offset"] / (blur(frames[:-1]) + now["dark_offset"])).square()
        both = torch.stack((now["noise_on_hz"] * fade, now["noise_off_hz"] * fade), dim=1)
        return t_s.diff()[:, None, None, None] * both

    def expected(self, frames, t_s):
        """Signal and expected noise together: what the fit compares with the recording."""
        return self.signal(frames, t_s) + self.noise(frames, t_s)

    @torch.no_grad()
    def draw(self, frames, t_s, generator):
        """One hard outcome: signal and Poisson noise."""
        return self.signal(frames, t_s) + torch.poisson(
            self.noise(frames, t_s).float(), generator=generator
        )

    def save(self, path):
        values = {name: float(value.detach()) for name, value in self.values().items()}
        write_atomic(Path(path), json.dumps(values, indent=2).encode())

    @classmethod
    def load(cls, path):
        """A sensor that ``save`` wrote. Raises: FileFormatError when the file is another."""
        stored = read_json(Path(path))
        if not isinstance(stored, dict) or stored.keys() != START.keys():
            raise FileFormatError(f"'{path}' is no fitted sensor; it holds {', '.join(START)}.")
        with building(path):
            return cls(**stored)


def blur(frames):
    """Gaussian blur of 1 px, edges repeated. frames: [T, H, W]."""
    size = (BLUR_TAPS, BLUR_TAPS)
    return gaussian_blur2d(frames[:, None], size, (BLUR_SIGMA_PX, BLUR_SIGMA_PX), "replicate")[:, 0]


def match(simulated, recorded):
    """What the fit makes small: 1 - correlation of the signed counts, plus the mean squared log
    ratio of the event numbers per interval and polarity.

    The correlation does not see a common factor of the counts and the ratio sees little else, so
    neither is paid for with the other. A squared error or a likelihood makes counts too few where
    edges are predicted a pixel off (figures in docs/sensor_fit.md).
    """
    signed, truth = (counts[:, 0] - counts[:, 1] for counts in (simulated, recorded))
    signed = signed - signed.mean()
    truth = truth - truth.mean()
    correlation = (signed * truth).sum() / (signed.square().sum() * truth.square().sum()).sqrt()
    # one event more, so that an empty interval has a ratio
    ratio = (simulated.sum((2, 3)) + 1) / (recorded.sum((2, 3)) + 1)
    return 1 - correlation + ratio.log().square().mean()


class Fit:
    """Adam on a sensor's parameters, step by step; ``state`` and ``restore`` go on with it exactly,
    ``keep_best`` sets the parameters that fitted best. The first interval is left out: the camera's
    pixels began it with a memory that nobody knows.
    """

    def __init__(self, sensor, frames, t_s, recorded, steps):
        self.sensor = sensor
        self.seen = frames, t_s
        self.recorded = recorded
        self.steps = steps
        self.losses = []
        self.best = {}
        self.optimiser = torch.optim.Adam(sensor.parameters(), lr=LEARNING_RATE)

    def step(self):
        """One step. Returns the loss before it."""
        for group in self.optimiser.param_groups:
            group["lr"] = LEARNING_RATE * (1 - len(self.losses) / self.steps)
        self.optimiser.zero_grad()
        loss = match(self.sensor.expected(*self.seen)[1:], self.recorded[1:])
        if float(loss.detach()) <= min(self.losses, default=math.inf):
            self.best = {
                f"best.{name}": value.clone() for name, value in self.sensor.state_dict().items()
            }
        loss.backward()
        self.optimiser.step()
        self.losses.append(float(loss.detach()))
        return self.losses[-1]

    def state(self):
        moments = self.optimiser.state_dict()["state"]
        tensors = {
            f"{index}/{name}": value for index, of in moments.items() for name, value in of.items()
        }
        return {**tensors, **self.sensor.state_dict(), **self.best}, {"losses": self.losses}

    def restore(self, tensors, numbers):
        self.losses = list(numbers["losses"])
        self.sensor.load_state_dict({name: tensors[name] for name in self.sensor.state_dict()})
        self.best = {name: tensors[name] for name in tensors if name.startswith("best.")}
        moments = {}
        for name in tensors.keys() - self.sensor.state_dict().keys() - self.best.keys():
            index, key = name.split("/")
            moments.setdefault(int(index), {})[key] = tensors[name]
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": moments})

    def keep_best(self):
        """The sensor with the parameters of the smallest loss."""
        best = {name.removeprefix("best."): value for name, value in self.best.items()}
        self.sensor.load_state_dict(best)
        return self.sensor
