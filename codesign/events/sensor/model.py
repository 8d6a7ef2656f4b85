"""The event sensor: its parameters, and the random parts that the hard simulator and the
differentiable layers share."""

import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Generator, Tensor

from codesign.checks import check_choice, check_flag, check_kind, check_number
from codesign.errors import DomainError, ShapeError, shown
from codesign.events.entry import MOST_VALUES, as_seconds, check_dtype, exactly

THETA_MINIMUM = 0.01  # no drawn threshold falls below, as in v2e
THETA_MOST = 10.0  # light of 22,000 times as much; beyond, a percentage or gray levels are meant
MOST_NUMBER = 1e30
TIMINGS = ("interpolated", "v2e")
# fields of SensorModel that may carry a gradient
DESIGN = ("theta_on", "theta_off", "theta_sigma", "cutoff_hz", "refractory_s")


@dataclass(frozen=True)
class SensorModel:
    """Parameters of an event sensor. The defaults are ideal: equal thresholds, no noise, no limit
    of speed.

    theta_on, theta_off: nominal contrast thresholds, natural log units, > 0 and up to 10.
    theta_sigma: standard deviation of the thresholds over pixels, natural log units, >= 0.
    cutoff_hz: bandwidth of the photoreceptor at full light, a one-pole low-pass of the log level;
      it shrinks with intensity as (I + 20)/275. 0: none.
    leak_rate_hz: ON events per pixel and second from leakage, on average. leak_jitter: standard
      deviation of the leak from frame to frame, relative.
    rate_cov_decades: spread of the leak rate over pixels, standard deviation of its base-10
      logarithm.
    shot_rate_hz: noise events per pixel and second in the dark, both polarities together; a quarter
      at full light (1 - 0.75 (I + 20)/275). It scales inversely with the pixel's threshold, and a
      noise event sets the memorised level to the level seen.
    refractory_s: dead time of a pixel after an event of the signal, seconds; noise events neither
      start one nor are lost to it.
    photoreceptor_noise: noise of the log level before the comparator instead of separate noise
      events, of the strength that v2e's fit assigns to shot_rate_hz; the rate that comes out
      depends on bandwidth and frame rate (measured in docs/events.md). Needs cutoff_hz and
      shot_rate_hz above 0.
    hot_pixel_share: share of pixels that fire by themselves. hot_pixel_rate_hz: their rate
      (ON, as a leak), events per second.
    Leaks and hot pixels have been at it for a while when the first frame begins, each pixel by a
      drawn share of a threshold, so n seconds have n events per Hz on average, however short (not
      with timing "v2e", where all begin together).
    timing: "interpolated": each event at the time its pixel crosses the threshold, log level linear
      in time between frames; events inside the dead time are lost (ESIM). "v2e": the frame-wide
      time slots of v2e, where events inside the dead time are deferred.
    Source: v2e (Hu, Liu, Delbruck, CVPR-W 2021); Rebecq et al., ESIM, CoRL 2018.

    Example:
    >>> from codesign import events
    >>> sensor = events.SensorModel(theta_on=0.18, theta_off=0.22, theta_sigma=0.03, refractory_s=5e-4)
    >>> theta_on, theta_off = events.draw_thresholds(sensor, (180, 240), torch.Generator().manual_seed(0))
    >>> theta_on.shape, round(float(theta_on.mean()), 2), round(float(theta_on.std()), 2)
    (torch.Size([180, 240]), 0.18, 0.03)
    """

    theta_on: float = 0.2
    theta_off: float = 0.2
    theta_sigma: float = 0.0
    cutoff_hz: float = 0.0
    leak_rate_hz: float = 0.0
    leak_jitter: float = 0.0
    rate_cov_decades: float = 0.0
    shot_rate_hz: float = 0.0
    refractory_s: float = 0.0
    timing: str = "interpolated"
    photoreceptor_noise: bool = False
    hot_pixel_share: float = 0.0
    hot_pixel_rate_hz: float = 0.0

    def __post_init__(self):
        check_choice(self.timing, "timing", TIMINGS)
        check_flag(self.photoreceptor_noise, "SensorModel.photoreceptor_noise")
        for name, value in vars(self).items():
            if name in ("timing", "photoreceptor_noise"):
                continue
            positive = name in ("theta_on", "theta_off")
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not number or not 0 <= value <= MOST_NUMBER or (positive and value == 0):
                hint = (
                    "; for its gradient pass it to events.sensor_counts, or name it in learn of events.layer"
                    if isinstance(value, Tensor)
                    else ""
                )
                raise DomainError(
                    f"SensorModel.{name} is {shown(value)} ({type(value).__name__}); a finite Python "
                    f"number {'> 0' if positive else '>= 0'} is needed{hint}."
                )
        for name in ("theta_on", "theta_off"):
            remedy = "it is of the natural logarithm: log(1.2) = 0.18 for a contrast of 20 %"
            check_number(getattr(self, name), f"SensorModel.{name}", most=THETA_MOST, remedy=remedy)
        check_number(self.hot_pixel_share, "SensorModel.hot_pixel_share", 0.0, 1.0)
        if self.photoreceptor_noise and not (self.cutoff_hz > 0 and self.shot_rate_hz > 0):
            raise DomainError(
                "photoreceptor_noise needs cutoff_hz and shot_rate_hz above 0 (its strength follows from "
                f"both); they are {self.cutoff_hz} and {self.shot_rate_hz}."
            )

    @property
    def leaks(self) -> bool:
        """Whether the memorised level drifts by itself."""
        return self.leak_rate_hz > 0 or self.has_hot_pixels

    @property
    def leak_jitters(self) -> bool:
        """Whether the leak changes from frame to frame."""
        return self.leaks and self.leak_jitter > 0

    @property
    def leaks_unevenly(self) -> bool:
        """Whether the leak rate is drawn for every pixel."""
        return self.leak_rate_hz > 0 and self.rate_cov_decades > 0

    @property
    def has_hot_pixels(self) -> bool:
        """Whether some pixels fire by themselves."""
        return self.hot_pixel_share * self.hot_pixel_rate_hz > 0

    @property
    def has_shots(self) -> bool:
        """Whether separate noise events are drawn."""
        return self.shot_rate_hz > 0 and not self.photoreceptor_noise

    def noise_level(self) -> float:
        """Standard deviation of the photoreceptor noise at the comparator, natural log units; 0
        without ``photoreceptor_noise``.

        Source: v2e's fit of the threshold-to-noise ratio that gives a wanted noise rate R at
          bandwidth f: with x = log10(R / 2 f), the smaller of the two thresholds over 10^y, y =
          -0.0026 x^3 - 0.036 x^2 - 0.1949 x + 0.321. The mean of the smaller one is exact here
          (v2e draws 300).
        """
        if not self.photoreceptor_noise:
            return 0.0
        smaller = min(self.theta_on, self.theta_off)
        spread = math.sqrt(2) * self.theta_sigma
        if spread > 0:  # mean of the smaller of two independent normal numbers (Clark 1961)
            share = (self.theta_off - self.theta_on) / spread
            above = 0.5 * math.erfc(-share / math.sqrt(2))
            density = math.exp(-(share**2) / 2) / math.sqrt(2 * math.pi)
            smaller = self.theta_on * above + self.theta_off * (1 - above) - spread * density
        return smaller / threshold_to_noise(self.shot_rate_hz, self.cutoff_hz)


def threshold_to_noise(rate_hz: float, cutoff_hz: float) -> float:
    """Threshold over noise deviation at which a pixel of that bandwidth makes so many noise events
    per second.

    Source: v2e's fit (see ``SensorModel.noise_level``).
    """
    x = math.log10(rate_hz / (2 * cutoff_hz))
    return 10 ** (-0.0026 * x**3 - 0.036 * x**2 - 0.1949 * x + 0.321)


# v2e's presets and the defaults of its command line
PRESETS = {
    "ideal": SensorModel(),
    "clean": SensorModel(theta_sigma=0.02),
    "noisy": SensorModel(
        theta_sigma=0.05,
        cutoff_hz=30.0,
        leak_rate_hz=0.1,
        leak_jitter=0.1,
        rate_cov_decades=0.1,
        shot_rate_hz=5.0,
    ),
    "default": SensorModel(
        theta_sigma=0.03,
        cutoff_hz=300.0,
        leak_rate_hz=0.01,
        leak_jitter=0.1,
        rate_cov_decades=0.1,
        shot_rate_hz=0.001,
        refractory_s=0.0005,
    ),
}


def check_sensor(sensor: object) -> SensorModel:
    """Return ``sensor`` when it is a SensorModel; DomainError otherwise."""
    names = ", ".join(map(repr, PRESETS))
    check_kind(
        sensor,
        SensorModel,
        "the sensor",
        f"give an events.SensorModel, or one of events.PRESETS ({names})",
    )
    return sensor


def with_design(sensor: SensorModel, design: Mapping[str, Tensor | float]) -> SensorModel:
    """The sensor with the numbers of design variables in place of its own.

    Args:
      design: numbers or 0-dim tensors by name, of DESIGN.
    Raises: DomainError for another name, a value that is no number or outside the sensor's domain,
      and one of 0 that requires a gradient: what is switched off has none.
    """
    values = {}
    for name, value in design.items():
        if name not in DESIGN:
            raise DomainError(
                f"{name!r} cannot carry a gradient; design variables of the sensor are {', '.join(DESIGN)}."
            )
        if isinstance(value, Tensor) and (value.ndim or value.is_complex()):
            raise DomainError(
                f"{name} is {value.dtype} {list(value.shape)}; one real number, a 0-dim tensor, is needed."
            )
        values[name] = check_number(value, name)
        if isinstance(value, Tensor) and value.requires_grad and values[name] == 0:
            raise DomainError(
                f"{name} is 0, which switches it off, and requires a gradient, which is then none; start "
                "above 0."
            )
    return replace(check_sensor(sensor), **values)


def check_generator(generator: object) -> None:
    """Raise DomainError unless ``generator`` is a torch.Generator."""
    check_kind(generator, Generator, "the generator", "give torch.Generator().manual_seed(0)")


def apart(generators: Sequence[Generator]) -> list[Generator]:
    """Generators that go on as these will, which stay as they are; what is one stays one."""
    own = {each: each.clone_state() for each in generators}
    return [own[each] for each in generators]


def draw_thresholds(
    sensor: SensorModel,
    pixels: Sequence[int],
    generator: Generator,
    *,
    dtype: torch.dtype = torch.float32,
) -> tuple[Tensor, ...]:
    """Contrast thresholds of every pixel.

    Args:
      sensor: SensorModel. pixels: shape of one frame. generator: draws happen on its device;
        untouched when theta_sigma is 0.
    Returns: theta_on, theta_off: ``pixels`` each, natural log units: N(theta, sigma), values below
      0.01 set to 0.01; first all ON, then all OFF.
    Source: v2e (Hu et al., CVPR-W 2021), threshold mismatch.
    """
    check_generator(generator)
    check_dtype(dtype, fractions=True)
    pixels = _shape(pixels)
    draws = check_sensor(sensor).theta_sigma > 0
    deviates = draw_deviates(pixels, generator, dtype=dtype) if draws else (None, None)
    return thresholds(sensor, pixels, deviates, dtype=dtype, device="cpu")


def thresholds(sensor, pixels, deviates, *, dtype, device):
    """Thresholds ON and OFF of every pixel, [*pixels] each, of the standard normal numbers drawn
    for them; these are not looked at without a mismatch."""
    nominal = sensor.theta_on, sensor.theta_off
    if sensor.theta_sigma == 0:
        return tuple(
            torch.tensor(theta, dtype=dtype, device=device).expand(pixels) for theta in nominal
        )
    return tuple(
        mismatched(theta, sensor.theta_sigma, deviate).to(device, dtype)
        for theta, deviate in zip(nominal, deviates, strict=True)
    )


def draw_deviates(
    pixels: Sequence[int], generator: Generator, *, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Standard normal numbers behind the thresholds of every pixel, [2, *pixels] on the generator's
    device:
    first all ON, then all OFF."""
    place: dict[str, Any] = {"generator": generator, "dtype": dtype, "device": generator.device}
    return torch.stack([torch.randn(_shape(pixels), **place) for _ in range(2)])


def mismatched(theta: Tensor | float, sigma: Tensor | float, deviate: Tensor) -> Tensor:
    """Thresholds of every pixel: theta + sigma deviate, at least 0.01. Gradient: theta and sigma,
    none where the minimum holds."""
    return (theta + sigma * deviate).clamp(min=THETA_MINIMUM)


def of_pixels(theta: Any, sigma: Any, deviate: Tensor | None, like: Tensor) -> Tensor:
    """``mismatched`` in the type of another tensor; the nominal threshold where no number was
    drawn.
    Gradient: theta and sigma."""
    theta, sigma = (
        torch.as_tensor(x, dtype=like.dtype, device=like.device) for x in (theta, sigma)
    )
    return theta if deviate is None else mismatched(theta, sigma, deviate.to(like))


def draw_leaks(
    sensor: SensorModel,
    pixels: Sequence[int],
    generator: Generator,
    *,
    dtype: torch.dtype = torch.float32,
) -> tuple[Tensor | None, Tensor | None]:
    """What makes the leaks of pixels differ, drawn only where the sensor has it: standard normal
    numbers of the spread, then even ones in 0 to 1, by which pixels are hot. [*pixels] each, or
    None."""
    pixels = tuple(pixels)
    place: dict[str, Any] = {"generator": generator, "device": generator.device}
    return (
        torch.randn(pixels, dtype=dtype, **place) if sensor.leaks_unevenly else None,
        torch.rand(pixels, **place) if sensor.has_hot_pixels else None,
    )


def leak_rates(sensor, pixels, spread, heat, *, dtype, device):
    """Leak of every pixel in ON thresholds per second, [*pixels]: log-normal around leak_rate_hz,
    plus the rate of hot pixels, of the numbers from ``draw_leaks``.

    Source: v2e, noise_rate_cov_decades (a median of leak_rate_hz; the mean is higher by
      exp((ln 10 c)^2 / 2)).
    """
    rate_hz = torch.full(pixels, sensor.leak_rate_hz, dtype=dtype)
    if sensor.leaks_unevenly:
        rate_hz = rate_hz * torch.pow(10.0, sensor.rate_cov_decades * spread.cpu())
    if sensor.has_hot_pixels:
        rate_hz = rate_hz + sensor.hot_pixel_rate_hz * (heat.cpu() < sensor.hot_pixel_share).to(
            dtype
        )
    return rate_hz.to(device, dtype)


def draw_keys(shape, generator):
    """Random int32 of a shape."""
    whole = torch.iinfo(torch.int32)
    place: dict[str, Any] = {
        "generator": generator,
        "dtype": torch.int64,
        "device": generator.device,
    }
    return torch.randint(whole.min, whole.max, shape, **place).to(torch.int32)


def draw_shot_counts(
    sensor: SensorModel,
    pixels: Sequence[int],
    interval_s: Tensor | Sequence[float],
    generator: Generator,
    *,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Noise events per pixel and interval: Poisson, shot_rate_hz/2 per polarity. Add them to the
    counts of any event layer.

    The rate is shot_rate_hz at every intensity, and the memorised level stays: one fixed draw
    serves a whole optimisation.

    Args:
      sensor: SensorModel. pixels: shape of one frame. interval_s: [T-1] lengths of the intervals,
        seconds, > 0.
      generator: draws happen on its device, one interval after the other, so chunks draw what the
        whole draws; untouched when the rate is 0.
    Returns: [T-1, 2, *pixels] whole numbers >= 0, ON first.
    """
    check_generator(generator)
    check_sensor(sensor)
    check_dtype(dtype)
    pixels = _shape(pixels)
    interval_s = as_seconds(interval_s, "interval_s")
    if interval_s.ndim != 1:
        raise ShapeError(
            f"interval_s has shape {list(interval_s.shape)}; one length per interval is needed, [T-1]."
        )
    if not bool(((interval_s > 0) & interval_s.isfinite()).all()):
        raise DomainError(
            "interval_s holds a length that is not a finite number > 0; give t_s.diff() of increasing frame "
            "times."
        )
    shape = (len(interval_s), 2, *pixels)
    if sensor.shot_rate_hz == 0 or not math.prod(shape):
        return torch.zeros(shape, dtype=dtype)
    size = 2 * math.prod(pixels)
    means = sensor.shot_rate_hz / 2 * interval_s.double().to(generator.device)
    place: dict[str, Any] = {"generator": generator, "device": generator.device}
    many, places = {}, {}
    for k, (mean, total) in enumerate(zip(means.tolist(), size * means, strict=True)):
        if mean > 1:  # more places than pixels
            many[k] = torch.poisson(total.new_full((size,), mean), generator=generator)
        else:  # the sum of Poisson numbers is one too, and falls on them evenly
            events = int(torch.poisson(total, generator=generator))
            places[k] = k * size, torch.randint(size, (events,), **place)
    counts = torch.zeros(len(means), size, dtype=torch.int64, device=generator.device)
    if places:
        starts, within = zip(*places.values(), strict=True)
        lengths = counts.new_tensor([len(one) for one in within])
        at = torch.cat(within) + counts.new_tensor(starts).repeat_interleave(lengths)
        counts = torch.bincount(at, minlength=counts.numel()).reshape_as(counts)
    for k, row in many.items():
        counts[k] = row
    return exactly(counts.reshape(shape).cpu(), dtype, "noise events")


def _shape(pixels):
    """A shape as a tuple of whole numbers."""
    try:
        found = tuple(operator.index(side) for side in pixels)
    except (TypeError, RuntimeError):
        found = (-1,)
    if min(found, default=1) < 0 or max(*found, math.prod(found), 1) > MOST_VALUES:
        raise DomainError(f"pixels is {shown(pixels)}; the shape of one frame is needed, (H, W).")
    return found
