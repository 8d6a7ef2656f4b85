"""Event layers by name: what a command line or a study's configuration says."""

import difflib
from dataclasses import fields
from typing import Any

from codesign.errors import DomainError
from codesign.events.layers import comparators
from codesign.events.layers.comparators import ComparatorLayer
from codesign.events.layers.layer import EventLayer
from codesign.events.layers.physical import PhysicalLayer
from codesign.events.sensor.model import SensorModel

COMPARATORS = {
    "sigmoid": comparators.Sigmoid,
    "counts": comparators.SoftCounts,
    "dense": comparators.Dense,
    "memory": comparators.Memory,
    "expected": comparators.Expected,
    "srm": comparators.Spikes,
}
LAYERS = (*COMPARATORS, "physical")


def layer(name: str = "memory", sensor: SensorModel | None = None, **options: Any) -> EventLayer:
    """The event layer of that name, a module with learnable thresholds.

    Args:
      name: "sigmoid" (per frame pair, no memory: the baseline), "counts" (the same without cap or ghosts),
        "dense" (comparator with surrogate, at most one event per frame), "memory" (memorised level,
        straight-through counts: the default), "expected" (mean counts under threshold mismatch), "srm"
        (spike response model, at most one event per frame), "physical" (the full sensor).
      sensor: SensorModel to start from. options: learn, log_input (see ``EventLayer``), and spread of
        "expected", sharpness of "sigmoid" and "dense", gradient ("play" or "surrogate") and steps (per frame
        interval) of "srm".
    Raises: DomainError for an unknown name, with the nearest one, an unknown option, or a value that cannot
      be learnt. A warning names what the sensor has and the layer does not know (leak, dead time, ...).

    Example:
    >>> import torch
    >>> from codesign import events
    >>> sensor = events.layer("memory", events.SensorModel(theta_on=0.2, theta_off=0.3))
    >>> frames = torch.tensor([40.0, 100.0, 30.0]).reshape(3, 1, 1)
    >>> sensor(frames, torch.tensor([0.0, 0.01, 0.02])).flatten(1).tolist()  # ON: ln(100/40)/0.2
    [[4.0, 0.0], [0.0, 3.0]]
    """
    if name not in LAYERS:
        near = difflib.get_close_matches(str(name), LAYERS, n=1)
        raise DomainError(
            f"there is no event layer {name!r}{f', did you mean {near[0]!r}?' if near else ''}; event layers "
            f"are {', '.join(map(repr, LAYERS))}."
        )
    own = () if name == "physical" else tuple(field.name for field in fields(COMPARATORS[name]))
    known = ("learn", "log_input", *own)
    if unknown := [option for option in options if option not in known]:
        raise DomainError(
            f"the event layer {name!r} has no option {unknown[0]!r}; its options are {', '.join(known)}."
        )
    if name == "physical":
        return PhysicalLayer(sensor, **options)
    values = {option: options.pop(option) for option in own if option in options}
    return ComparatorLayer(COMPARATORS[name](**values), sensor, **options)
