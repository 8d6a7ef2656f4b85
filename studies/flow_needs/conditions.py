"""Conditions that the needs of flow are measured under, and the faults of a lens, in steps."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from codesign import events
from codesign.lens.spectrum import Spectrum, daylight_d65, silicon_response
from codesign.types import EventVolume
from studies.flow_needs.cases import EDGE_MM, EFL_MM, PITCH_MM
from studies.flow_needs.faulty_lens import FaultyLens

BINS = 8  # those of the refiner; the closed form takes any
SAMPLES = {"centre": 32, "corner": 16}  # rays per pixel; more where there is blur to sample
COLOURS = 4
DIM = 0.05  # of the light


@dataclass(frozen=True)
class View:
    """What is rendered: a kind of texture, and the motion in pixels per interval of 50 ms."""

    texture: str = "photos"
    speed_px: float = 2.0

    @property
    def name(self) -> str:
        return f"{self.texture} {self.speed_px:g} px"


@dataclass(frozen=True)
class Sensor:
    """A hard event sensor at a level of light, 1 for pictures on the 0..255 scale."""

    model: events.SensorModel
    light: float = 1.0

    def __call__(self, frames: Tensor, t_s: Tensor, generator: torch.Generator) -> EventVolume:
        """Events of frames [N, T, H, W] at t_s [T] seconds: EventVolume."""
        return events.HardSensor(self.model, BINS)(frames * self.light, t_s, generator)


TYPICAL = events.SensorModel(
    theta_on=0.2, theta_off=0.2, theta_sigma=0.03, shot_rate_hz=1.0, leak_rate_hz=0.1
)
SENSORS = {
    "theta 0.2": Sensor(TYPICAL),
    "theta 0.1": Sensor(replace(TYPICAL, theta_on=0.1, theta_off=0.1, theta_sigma=0.015)),
    "theta 0.4": Sensor(replace(TYPICAL, theta_on=0.4, theta_off=0.4, theta_sigma=0.06)),
    "no noise": Sensor(events.SensorModel(theta_on=0.2, theta_off=0.2)),
    "dim light": Sensor(replace(TYPICAL, cutoff_hz=200.0, shot_rate_hz=5.0), DIM),
}
BASE = "theta 0.2"
BASE_VIEW = View()
FAST = View(speed_px=4.0)
FINE = View("fine")
VIEWS = (
    BASE_VIEW,
    FINE,
    View("coarse"),
    View("rooms"),
    View(speed_px=0.5),
    FAST,
)
FEW_SENSORS = (BASE, "theta 0.4", "dim light")


def condition(view: View, sensor: str) -> str:
    """Name of a view and sensor, by what differs from the base."""
    if view == BASE_VIEW:
        return "photos, theta 0.2, 2 px" if sensor == BASE else sensor
    return view.texture if view.texture != BASE_VIEW.texture else f"{view.speed_px:g} px"


@dataclass(frozen=True)
class Fault:
    """A fault in rising steps.

    scale, levels: what the steps are in, and the steps, above 0. window, views: where it is judged. sensors: names of
    those it is judged by in the base view, others by the base sensor. coloured: in daylight instead of the d line.
    """

    name: str
    scale: str
    levels: tuple[float, ...]
    window: str = "corner"
    views: tuple[View, ...] = (BASE_VIEW,)
    sensors: tuple[str, ...] = FEW_SENSORS
    coloured: bool = False

    def unit(self, level: float, view: View) -> str:
        """Name of what is measured at a level; without a fault one for all faults of the window."""
        what = f"{self.name} {level:g}" if level else "none"
        return f"{what} / {self.window} / {view.name}"

    def sensors_of(self, view: View) -> dict[str, Sensor]:
        """The sensors before a view, by name."""
        return {name: SENSORS[name] for name in (self.sensors if view == BASE_VIEW else (BASE,))}

    def lens(self, level: float) -> FaultyLens:
        """The lens with the fault at a level; 0 is none."""
        faults = {
            "blur": {"blur_mm": level * PITCH_MM},
            "gaussian blur": {"blur_mm": level * PITCH_MM, "blur": "gaussian"},
            "flare": {"blur_mm": level * PITCH_MM, "blur": "flare"},
            "barrel": {"distortion_percent": -level},
            "pincushion": {"distortion_percent": level},
            "falloff": {"edge_illumination": 1 - level / 100},
            "lateral colour": {"lateral_colour_mm": level * PITCH_MM},
        }
        return FaultyLens(EFL_MM, EDGE_MM, **faults[self.name])

    @property
    def light(self) -> Spectrum | None:
        """Daylight on silicon where colour matters; None is the d line."""
        return Spectrum.from_curves(silicon_response(), daylight_d65(), COLOURS) if self.coloured else None


BLUR = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0)
FAULTS = (
    Fault("blur", "RMS radius, px", BLUR, "centre", VIEWS, tuple(SENSORS)),
    Fault("gaussian blur", "RMS radius, px", BLUR[1:], "centre", sensors=(BASE,)),
    Fault("flare", "RMS radius, px", BLUR[1:], "centre", sensors=(BASE,)),
    Fault("barrel", "% at the corner", (1.0, 2.0, 4.0, 8.0, 16.0, 32.0), views=(BASE_VIEW, FAST)),
    Fault("pincushion", "% at the corner", (1.0, 2.0, 4.0, 8.0, 16.0), views=(BASE_VIEW, FAST)),
    Fault(
        "falloff",
        "% of the light lost in the corner",
        (30.0, 50.0, 70.0, 80.0, 90.0),
        views=(BASE_VIEW, FINE),
    ),
    Fault(
        "lateral colour",
        "px from F to C in the corner",
        (0.5, 1.0, 1.5, 2.0, 3.0, 4.0),
        views=(BASE_VIEW, FINE),
        coloured=True,
    ),
)
