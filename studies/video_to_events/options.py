"""Options of video_to_events: the input, the sensor, and what is written."""

import dataclasses
import math
import re
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import tyro

from codesign.errors import DomainError
from codesign.events import PRESETS, SensorModel
from studies.frame.run import StudyConfig

POSITIVE = (
    "fps",
    "slow_motion",
    "white_level",
    "preview_slowdown",
    "upsample",
)


@dataclass(frozen=True)
class Options(StudyConfig):
    """Options that do not belong to the sensor."""

    GPU: ClassVar = True

    input: Path | None = None
    """Video (.mp4, .avi, .mov, .mkv, .gif …), folder of pictures (PNG, JPEG, TIFF, BMP, 8 or 16
    bits), stack (.npy, .npz), or Photron recording (.mraw)."""
    fps: float | None = None
    """Frames per second; in place of the container's, and needed for pictures and stacks without
    times."""
    timestamps: Path | None = None
    """Text file with the time of every frame, one number per line; in place of --fps."""
    timestamp_unit: Literal["s", "ms", "us", "ns"] = "s"
    """Unit of --timestamps."""
    slow_motion: float = 1.0
    """How many times slower than life the input plays: 10 for 300 frames per second stored as
    30."""
    start_s: float | None = None
    """Leave out frames before this time, in the time of the events (after --fps, --timestamps and
    --slow-motion)."""
    stop_s: float | None = None
    """Leave out frames after this time, likewise."""
    linear: bool = False
    """Undo the sRGB gamma, so that the sensor sees linear light; without it digital values are
    taken as they are, as in v2e."""
    white_level: float | None = None
    """Digital value of full light, 255 for the sensor; left out: 255 of 8 bits, 65535 of 16, and
    255 of floats. 4095 for 12 bits stored in 16."""
    sensor_size: tuple[int, int] | None = None
    """Width and height of the sensor, pixels; frames are brought to it, stretched where the
    proportions differ. Left out: that of the frames."""
    upsample: float | None = None
    """Put frames between the frames, along their optical flow, until nothing moves by more than
    this many pixels from one to the next; 0.5 is good. Left out: none."""
    preset: str = "default"
    """Sensor: ideal (no noise), clean, noisy, or default: those of v2e and of its command line."""
    events: tuple[str, ...] = ("events.h5",)
    """Names of the event files, in the folder of the run; the extension says the format; no name,
    no file. 0.05 GB of memory per million events."""
    preview: bool = True
    """Make the two videos, of events and of fading traces."""
    preview_slowdown: float | None = None
    """How many times slower than the scene the videos play; left out: at life's speed, or slower
    until they last 10 s or show four pictures per frame."""


def with_sensor_options(kind):
    """The dataclass ``kind`` with one more field per parameter of SensorModel, None by default."""
    hints = typing.get_type_hints(SensorModel)
    # the docstring of SensorModel says "name, name: sentence" of each, several to a paragraph
    text = " ".join((SensorModel.__doc__ or "").split("Source:")[0].split())
    parts = re.split(r"(?<=[ .])((?:[a-z_]+, )*[a-z_]+): ", text)
    meaning = {
        name: said
        for names, said in zip(parts[1::2], parts[2::2], strict=True)
        for name in names.split(", ")
    }
    added = []
    for field in dataclasses.fields(SensorModel):
        words = f"Sensor: {meaning[field.name].strip()} That of --preset when left out."
        hint = Annotated[hints[field.name] | None, tyro.conf.arg(help=words)]
        added.append((field.name, hint, dataclasses.field(default=None)))
    made = dataclasses.make_dataclass(
        "Config", added, bases=(kind,), frozen=True, namespace={"__doc__": kind.__doc__}
    )
    made.__module__ = kind.__module__
    return made


Config: type[Options] = with_sensor_options(Options)


def chosen_sensor(config):
    """SensorModel of a configuration: the preset with the given parameters in place of its own.
    Raises:
    DomainError for an unknown preset or an unfit value."""
    if config.preset not in PRESETS:
        raise DomainError(f"--preset is '{config.preset}'; there are {', '.join(PRESETS)}.")
    given = {field.name: getattr(config, field.name) for field in dataclasses.fields(SensorModel)}
    given = {name: value for name, value in given.items() if value is not None}
    return dataclasses.replace(PRESETS[config.preset], **given)


def checked(config):
    """The configuration. Raises: DomainError for options that cannot be, before anything is
    read."""
    if config.input is None:
        raise DomainError(
            "no input given; name a video, a folder of pictures, a .npy or .npz stack, or a .mraw recording "
            "with --input."
        )
    for name in POSITIVE:
        value = getattr(config, name)
        if value is not None and not 0 < value < math.inf:
            raise DomainError(
                f"--{name.replace('_', '-')} is {value:g}; a finite number above 0 is needed."
            )
    if config.sensor_size is not None and not all(
        1 <= side <= 65535 for side in config.sensor_size
    ):
        raise DomainError(
            f"--sensor-size is {config.sensor_size}; width and height of 1 to 65535 pixels are possible."
        )
    return config
