"""What event flow needs of a lens: its error over blur, distortion, falloff and lateral colour, and how much of each it
bears, by texture, threshold, noise, speed and estimator.

An ideal lens gets one fault at a time, in steps, before the hard event sensor; cases, film samples and noise are the same
at every step. A triplet with defocus, spherical aberration, coma, astigmatism or errors of assembly shows which single
number of a point image tells the flow error best.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from codesign import flow, render
from codesign.errors import DomainError
from studies.flow_needs import page, real_lenses, results
from studies.flow_needs.conditions import BASE, BASE_VIEW, FAULTS, SENSORS, Sensor, View
from studies.flow_needs.measure import camera_of, flow_errors_px
from studies.flow_needs.predictors import point_images_px, predictors
from studies.frame.run import Run, StudyConfig, main

LEAST_CASES = 4


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"cases": 5}
    cases: int = 50
    """Places and motions per curve; every step of a fault sees the same ones."""


@dataclass(frozen=True)
class Unit:
    """The smallest piece of work, stored when done: a lens, where and on what it is judged."""

    name: str
    camera: render.Camera
    view: View
    sensors: dict[str, Sensor]
    distorted: bool = False
    blurred: bool = False


def units(quick: bool) -> Iterator[Unit]:
    """All the work in order, nothing twice; with ``quick`` every third step of every fault, the base view alone, and
    no triplets."""
    named = set()
    for fault in FAULTS:
        levels = fault.levels[1::3] if quick else fault.levels
        for view in (BASE_VIEW,) if quick else fault.views:
            sensors = fault.sensors_of(view)
            for level in (0.0, *levels):
                name = fault.unit(level, view)
                if name not in named:
                    named.add(name)
                    camera = camera_of(fault.lens(level), fault.window, fault.light)
                    distorted = fault.window == "corner" and (level == 0 or fault.name in results.WAYS)
                    yield Unit(name, camera, view, sensors, distorted, fault.window == "centre" and level > 0)
    for family, blur_px, optics in () if quick else real_lenses.judged():
        camera = camera_of(optics, "centre")
        yield Unit(results.triplet(family, blur_px), camera, BASE_VIEW, {BASE: SENSORS[BASE]}, blurred=True)


def study(run: Run[Config]) -> None:
    config = run.config
    if config.cases < LEAST_CASES:
        raise DomainError(f"--cases is {config.cases}; give at least {LEAST_CASES}, or there is no interval.")
    run.say("making the lenses")
    work = list(units(config.quick))
    estimators = {"closed form": flow.estimate_lk, "refiner": flow.load("refiner")}
    stored = run.load_state()
    errors: dict[str, Tensor] = {} if stored is None else stored.tensors
    numbers: dict[str, dict[str, float]] = {} if stored is None else stored.numbers["numbers"]

    def save():
        run.save_state(errors, {"numbers": numbers})

    run.on_interrupt(save)
    left = [unit for unit in work if unit.name not in numbers]
    with run.progress(len(work), "measuring flow", done=len(work) - len(left)) as bar:
        for unit in left:
            found = flow_errors_px(
                unit.camera, unit.view, unit.sensors, estimators, config.cases, config.seed, unit.distorted
            )
            errors |= {f"{unit.name} / {name}": error for name, error in found.items()}
            numbers[unit.name] = predictors(point_images_px(unit.camera)) if unit.blurred else {}
            save()
            bar.advance(error_px=float(found[f"{BASE} / closed form"].mean()))
    page.write(run, results.Results(errors, numbers, config.seed), list(estimators))


if __name__ == "__main__":
    sys.exit(main(study, Config))
