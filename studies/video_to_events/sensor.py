"""The sensor of a command line: a preset by name, and an option for every parameter of the sensor that
overrides it."""

import dataclasses
import re
import textwrap
import typing
from typing import Annotated

import tyro

from codesign.errors import DomainError
from codesign.events import SensorModel
from codesign.events.sensor.model import PRESETS


def with_sensor_options(kind):
    """The dataclass ``kind`` with one more field per parameter of SensorModel, None by default; the options
    of a study follow the sensor by themselves."""
    hints = typing.get_type_hints(SensorModel)
    meanings = _meanings()
    added = []
    for field in dataclasses.fields(SensorModel):
        hint = Annotated[
            hints[field.name] | None,
            tyro.conf.arg(
                help=f"Sensor: {meanings.get(field.name, field.name)} That of --preset when left out."
            ),
        ]
        added.append((field.name, hint, dataclasses.field(default=None)))
    made = dataclasses.make_dataclass(
        "Config", added, bases=(kind,), frozen=True, namespace={"__doc__": kind.__doc__}
    )
    made.__module__ = kind.__module__
    return made


def chosen_sensor(config):
    """SensorModel of a configuration: the preset with the given parameters in place of its own. Raises:
    DomainError for an unknown preset or an unfit value."""
    if config.preset not in PRESETS:
        raise DomainError(f"--preset is '{config.preset}'; there are {', '.join(PRESETS)}.")
    given = {field.name: getattr(config, field.name) for field in dataclasses.fields(SensorModel)}
    return dataclasses.replace(
        PRESETS[config.preset], **{name: value for name, value in given.items() if value is not None}
    )


def _meanings():
    """Parameter -> its sentence in the docstring of SensorModel, where they stand as ``name, name:
    sentence``, several to a paragraph."""
    names = {field.name for field in dataclasses.fields(SensorModel)}
    text = " ".join(textwrap.dedent(SensorModel.__doc__ or "").split("Source:")[0].split())
    label = re.compile(r"(?:^|(?<=[ .]))((?:[a-z_]+, )*[a-z_]+): ")
    found = [match for match in label.finditer(text) if set(match[1].split(", ")) <= names]
    meanings = {}
    for match, following in zip(found, [*found[1:], None], strict=True):
        sentence = text[match.end() : following.start() if following else None].strip()
        meanings |= {name: sentence[:1].upper() + sentence[1:] for name in match[1].split(", ")}
    return meanings
