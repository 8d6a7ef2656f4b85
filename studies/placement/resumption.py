"""Whether a run that goes on is still the one that was begun."""

import hashlib
import json
from dataclasses import asdict
from typing import Any

import numpy as np

from codesign.errors import DomainError
from scenes.robot_pair import RobotPair
from studies.frame.config import StudyConfig, to_json

ELSEWHERE = ("study", "out", "device", "resume")  # on which no result depends
DESIGNS = ("low", "high", "design")
SETTINGS = ("axes", "prior", "depth", "look_ahead", "housing_radius_m", "margin_m")
MORE = ("own_body_share", "cable", "ground_z_m", "page")


def asked(config: StudyConfig, pair: RobotPair) -> dict[str, Any]:
    """Name -> what results depend on: options, the pair's settings, and digests of its meshes,
    first drive and files."""
    options = json.loads(to_json("", config))
    named = {f"--{name.replace('_', '-')}": value for name, value in options.items() if name not in ELSEWHERE}
    designs = {
        f"the robot's {name}, {field}": repr(value)
        for name in DESIGNS
        for field, value in asdict(getattr(pair, name)).items()
    }
    settings = designs | {f"the robot's {name}": repr(getattr(pair, name)) for name in (*SETTINGS, *MORE)}
    meshes = [part for body in pair.bodies.values() for part in (body.vertices_m, body.faces)]
    poses, _ = pair.drive(0, 1)
    files = {f"'{path}'": hashlib.sha256(path.read_bytes()).hexdigest()[:12] for path in pair.files}
    return (
        named
        | settings
        | files
        | {"the robot's shape": _digest(meshes), "the robot's drives": _digest([poses])}
    )


def check_same(stored: dict[str, Any], now: dict[str, Any]) -> None:
    """Raise DomainError where a run that goes on is asked for something else than it was begun with."""
    for name in stored:
        if name.startswith("'") and name not in now:
            raise DomainError(
                f"{name} belongs to this run's robot or world no more; change it back, or start a new run."
            )
    for name, value in now.items():
        if name in stored and stored[name] != value:
            raise DomainError(
                f"{name} changed since this run was begun ({stored[name]}, now {value}); what it has found holds no "
                "more: change it back, or start a new run."
            )


def _digest(arrays):
    """Of numbers to a millionth."""
    found = hashlib.sha256()
    for each in arrays:
        found.update((np.round(np.asarray(each, dtype=np.float64), 6) + 0.0).tobytes())
    return found.hexdigest()[:12]
