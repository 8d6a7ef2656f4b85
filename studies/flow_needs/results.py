"""What was measured, by name, and the curves and tables in it."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from studies.flow_needs.conditions import BASE, BASE_VIEW, FAULTS, Fault, View, condition
from studies.flow_needs.predictors import bearable, left_out_residual
from studies.flow_needs.summary import Curve, Limit

RISES = (0.1, 0.25)
TRIPLET = "triplet"
WAYS = {
    "barrel": ("corrected", "ignored"),
    "pincushion": ("corrected", "ignored"),
}  # ways to judge distortion


def triplet(family: str, blur_px: float) -> str:
    """Name of what is measured of a triplet."""
    return f"{TRIPLET} {family} / {blur_px:g} px RMS"


@dataclass(frozen=True)
class Row:
    """One curve of a fault: under which condition, by which estimator, judged how ("" where there is one way)."""

    fault: Fault
    condition: str
    estimator: str
    way: str
    curve: Curve
    limits: tuple[Limit, ...]
    events_per_pixel: float

    @property
    def error_px(self) -> float:
        """Mean error without the fault."""
        return float(self.curve.errors[0].mean())

    @property
    def label(self) -> str:
        """Beginning of the names of its metrics."""
        return "_".join(
            f"{self.fault.name} {self.way} {self.condition} {self.estimator}".replace(",", "").split()
        )


@dataclass(frozen=True)
class Results:
    """errors: "UNIT / SENSOR / ESTIMATOR" -> [cases] px, see measure.flow_errors_px. numbers: unit -> predictor ->
    number, of units with point images."""

    errors: Mapping[str, Tensor]
    numbers: Mapping[str, Mapping[str, float]]
    seed: int

    def curve(self, fault: Fault, view: View, sensor: str, judged: str) -> Curve:
        """Curve of an estimator (with " / ignored" behind it where distortion is) over the levels measured."""
        levels = [level for level in (0.0, *fault.levels) if fault.unit(level, view) in self.numbers]
        names = [f"{fault.unit(level, view)} / {sensor} / {judged}" for level in levels]
        return Curve(levels, np.stack([self.errors[name].numpy() for name in names]))

    def rows(self, estimators: list[str]) -> list[Row]:
        """Every curve, by fault, estimator and condition."""
        found = []
        for fault in FAULTS:
            for way in WAYS.get(fault.name, ("",)):
                for estimator in estimators:
                    judged = estimator + (" / ignored" if way == "ignored" else "")
                    for view, sensor in self._conditions(fault):
                        curve = self.curve(fault, view, sensor, judged)
                        limits = tuple(curve.limit(rise, self.seed) for rise in RISES)
                        events = float(self.errors[f"{fault.unit(0, view)} / {sensor} / events"].mean())
                        name = condition(view, sensor)
                        found.append(Row(fault, name, estimator, way, curve, limits, events))
        return found

    def _conditions(self, fault):
        for view in fault.views:
            if any(fault.unit(level, view) in self.numbers for level in fault.levels):
                yield from ((view, sensor) for sensor in fault.sensors_of(view))

    def lenses(self) -> dict[str, str]:
        """Unit -> family, of every lens with a point image of its own under the base condition."""
        found = {}
        for fault in FAULTS:
            if fault.window == "centre":
                units = [fault.unit(level, BASE_VIEW) for level in fault.levels]
                found |= {unit: fault.name for unit in units if unit in self.numbers}
        triplets = [unit for unit in self.numbers if unit.startswith(TRIPLET)]
        return found | {unit: unit.removeprefix(TRIPLET).split()[0].strip(",") for unit in triplets}

    def log_rise(self, unit: str, estimator: str) -> float:
        """Log of the error behind a lens over that of the ideal one, mean over cases."""
        ideal = FAULTS[0].unit(0, BASE_VIEW)
        ratio = self.errors[f"{unit} / {BASE} / {estimator}"] / self.errors[f"{ideal} / {BASE} / {estimator}"]
        return float(ratio.log().mean())

    def predictors(self, estimator: str) -> list[tuple[str, float, float]]:
        """Name, RMS residual of lenses left out (a logarithm) and number at an error of +10 %, best first."""
        family = self.lenses()
        logs = [self.log_rise(unit, estimator) for unit in family]
        found = []
        for name in self.numbers[next(iter(family))]:
            numbers = [self.numbers[unit][name] for unit in family]
            residual = left_out_residual(numbers, logs, list(family.values()))
            found.append((name, residual, bearable(numbers, logs, RISES[0])))
        return sorted(found, key=lambda row: row[1])
