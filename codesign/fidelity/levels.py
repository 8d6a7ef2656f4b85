"""The levels of fidelity of every stage, from cheap to fine, and the system that a choice of them
makes."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import torch

from codesign import events, flow, lens
from codesign.checks import check_choice
from codesign.errors import DomainError
from codesign.fidelity.task import Task
from codesign.render import Camera, psf_frames
from codesign.system import Batch, System

EVENTS = ("sigmoid", "srm", "memory", "physical", "hard")
BINS = (4, 6, 9, 13)
FLOWS: dict[str, Callable[..., Any]] = {
    "constant": partial(flow.estimate_lk, model="constant"),
    "affine": flow.estimate_lk,
    "quadratic": partial(flow.estimate_lk, model="quadratic"),
    "local": partial(flow.estimate_lk, model="local"),
    "chosen": flow.estimate,
}
GIVEN = "given"
COARSER = 4  # times fewer samples, level by level
NUMBERS = ("samples", "frames", "bins")  # their finest levels are the reference alone
# of a sensor that comparators do not know; they would warn
UNKNOWN = {
    "leak_rate_hz": 0.0,
    "hot_pixel_share": 0.0,
    "refractory_s": 0.0,
    "photoreceptor_noise": False,
}


@dataclass(frozen=True)
class Fidelity:
    """One level of every stage. camera: "pinhole", "thin" (paraxial), "psf" (blur by
    convolution, whose samples do not count) or "traced". samples: rays per pixel. frames: times at which there is a frame.
    events: name of the layer, "hard" for the sensor. bins: of the volume. flow: estimator."""

    camera: str
    samples: int
    frames: int
    events: str
    bins: int
    flow: str

    @staticmethod
    def finest(levels: "Levels") -> "Fidelity":
        """The last level of every stage, the reference."""
        return Fidelity(**{stage: found[-1] for stage, found in levels.items()})

    def __str__(self) -> str:
        return (
            f"{self.camera} camera, {self.samples} samples, {self.frames} frames, {self.events} "
            f"events, {self.bins} bins, {self.flow} flow"
        )


STAGES = tuple(field.name for field in fields(Fidelity))
Levels = dict[str, tuple[Any, ...]]


def levels_of(task: Task, only: Mapping[str, Any] | None = None) -> Levels:
    """The levels of every stage of a task, cheap to fine; the last of each is the reference.

    Args: only: stage -> levels to take instead, cheap to fine.
    Raises: DomainError for a stage or level that is not there.
    """
    optics, aperture = task.camera.lens, getattr(task.camera.lens, "entrance_pupil_diameter_mm", 0)
    traced = ("thin", "psf", "traced") if hasattr(optics, "thin") else ("psf", "thin")
    known: Levels = {
        "camera": ("pinhole", *traced) if aperture else ("pinhole",),
        "samples": _divided(
            task.camera.samples_per_pixel, COARSER, len(task.camera.colours), least=1
        ),
        "frames": tuple(n + 1 for n in _divided(len(task.t_s) - 1, 2, 1, least=2)),
        "events": EVENTS,
        "bins": BINS,
        "flow": tuple(FLOWS) if task.flow is None else (GIVEN,),
    }
    for stage, levels in dict(only or {}).items():
        if not isinstance(levels, tuple | list):
            raise DomainError(f"levels of {stage} are {levels!r}; give a list, cheap to fine.")
        check_choice(stage, "the stage of levels", STAGES)
        if wrong := [level for level in levels if stage != "bins" and level not in known[stage]]:
            raise DomainError(
                f"{stage} has no level {wrong[0]!r} here; it has {', '.join(map(str, known[stage]))}."
            )
        known[stage] = tuple(levels)
        if stage in NUMBERS and not (
            all(type(level) is int for level in levels) and list(levels) == sorted(set(levels))
        ):
            raise DomainError(
                f"{stage} has the levels {known[stage]}; give whole numbers that rise."
            )
    if empty := [stage for stage, found in pickable(task, known).items() if not found]:
        raise DomainError(f"{empty[0]} has no level to choose; give one ('hard' has no gradient).")
    return known


def _divided(most, by, shared, least):
    """most, most / by, ... as far as they are whole multiples of ``shared``; smallest first."""
    found = [most]
    while found[0] % by == 0 and found[0] // by % shared == 0 and found[0] // by >= least:
        found.insert(0, found[0] // by)
    return tuple(found)


def levels_in(fidelity: Fidelity) -> list[tuple[str, Any]]:
    """(stage, level) of a combination as far as they count: point spread functions need no
    samples."""
    left_out = "samples" if fidelity.camera == "psf" else ""
    return [(stage, getattr(fidelity, stage)) for stage in STAGES if stage != left_out]


def pickable(task: Task, levels: Levels) -> Levels:
    """The levels that may be chosen: numbers keep their finest as the reference, and where
    gradients are wanted so does the hard sensor."""
    found = dict(levels)
    for stage in NUMBERS:
        found[stage] = levels[stage][:-1] or levels[stage]
    if task.gradient:
        found["events"] = tuple(name for name in levels["events"] if name != "hard")
    return found


def finer(fidelity: Fidelity, levels: Levels) -> Fidelity:
    """Numbers one level finer, named levels at their finest."""
    above = {}
    for stage, level in levels_in(fidelity):
        if stage in NUMBERS:
            at = levels[stage].index(level)
            above[stage] = levels[stage][min(at + 1, len(levels[stage]) - 1)]
    return replace(Fidelity.finest(levels), **above)


def camera_at(camera: Camera, fidelity: Fidelity) -> Camera:
    """The camera with the lens and the samples of a level."""
    optics = camera.lens
    paraxial = optics.thin() if hasattr(optics, "thin") else optics
    if fidelity.camera == "pinhole":
        optics = lens.ThinLens(paraxial.efl_mm, 0.0, paraxial.image_distance_mm)
    elif fidelity.camera == "thin":
        optics = paraxial
    return camera.with_lens(optics).with_samples(fidelity.samples)


def events_at(task: Task, fidelity: Fidelity) -> Any:
    """The event layer of a level, with the task's sensor as far as it knows it."""
    if fidelity.events == "hard":
        return events.HardSensor(task.sensor, fidelity.bins)
    known = task.sensor if fidelity.events == "physical" else replace(task.sensor, **UNKNOWN)
    return events.layer(fidelity.events, known)


def system_of(scene: Any, task: Task, fidelity: Fidelity, **parts: Any) -> System:
    """The chain of a task at a fidelity; ``parts`` as of ``System``, in place of its own."""
    estimator = FLOWS.get(fidelity.flow, task.flow)
    own = {
        "camera": camera_at(task.camera, fidelity),
        "render": psf_frames if fidelity.camera == "psf" else None,
        "events": events_at(task, fidelity),
        "flow": estimator,
        "bins": fidelity.bins,
        "mount": task.mount,
        "estimate": task.estimate,
        "objectives": {task.name: task.judged},
        "scene": scene,
    }
    return System(**{**own, **parts})


def batch_of(task: Task, fidelity: Fidelity) -> Batch:
    """The drives of a task at the frame times of a fidelity."""
    every = (len(task.t_s) - 1) // (fidelity.frames - 1)
    times = torch.as_tensor(task.t_s, dtype=torch.float64)[::every]
    return Batch(task.T_world_body[..., ::every, :, :], times)
