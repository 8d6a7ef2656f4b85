"""The five trades: what is to be had cheaply, from loose to tight, and the problem at each value."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch

from codesign.errors import DomainError
from codesign.events import SensorModel
from codesign.lens import GeoLens
from codesign.lens.design import Limits, Tolerances, elements, without_element
from studies.lens_opt.task import HALF_DIAGONAL_MM
from studies.lens_trade.cases import Light
from studies.lens_trade.designers import by_spots
from studies.lens_trade.problem import FLAT, Problem, scaled_triplet

HALF_FIELD_DEG = 20.0
FNO = 2.8
SHAKEN = 0.2  # relative errors of a random start
# a sensor in the dusk: bandwidth and contrast fall with the light, noise rises
DIM = Light(
    SensorModel(theta_on=0.2, theta_off=0.2, theta_sigma=0.03, cutoff_hz=100.0, shot_rate_hz=5.0), share=0.1
)
# one standard deviation at scale 1, for a lens of 11 mm
PRECISION = {
    "radius_relative": 2e-3,
    "thickness_mm": 0.02,
    "index": 5e-4,
    "decentre_mm": 0.01,
    "tilt_deg": 0.05,
}


@dataclass(frozen=True)
class Trade:
    """What is traded against the flow error.

    label, unit: of the axis. values: from loose to tight. problem: value and template -> Problem. template: value ->
    the lens whose glasses and aperture are designed around. removes: whether tighter means one element less.
    """

    name: str
    label: str
    unit: str
    values: tuple[float, ...]
    problem: Callable[[float, GeoLens], Problem]
    template: Callable[[float], GeoLens]
    light: Light = field(default_factory=Light)
    removes: bool = False


def limits(efl_mm: float, track: float = 1.3) -> Limits:
    return Limits(
        glass_centre_mm=0.045 * efl_mm,
        glass_centre_most_mm=0.27 * efl_mm,
        glass_edge_mm=0.03 * efl_mm,
        air_gap_mm=0.007 * efl_mm,
        track_mm=track * efl_mm,
        back_focus_mm=0.2 * efl_mm,
        steepness=0.85,
        scale_mm=0.01 * efl_mm,
    )


def efl_of(half_field_deg: float) -> float:
    return HALF_DIAGONAL_MM / math.tan(math.radians(half_field_deg))


def _triplet(fno: float = FNO, half_field_deg: float = HALF_FIELD_DEG) -> GeoLens:
    return scaled_triplet(efl_of(half_field_deg), fno, half_field_deg)


def _problem(template: GeoLens, track: float = 1.3, made: Tolerances | None = None) -> Problem:
    return Problem(
        template,
        math.radians(template.half_field_deg),
        limits(float(template.first_order().efl_mm), track),
        made,
    )


def _precision(scale: float) -> Tolerances:
    return Tolerances(**{name: scale * value for name, value in PRECISION.items()})


TRADES = {
    trade.name: trade
    for trade in (
        Trade(
            "track",
            "track over focal length",
            "",
            (1.2, 1.0, 0.9, 0.8),
            lambda value, template: _problem(template, value),
            lambda value: _triplet(),
        ),
        Trade(
            "elements",
            "elements",
            "",
            (3, 2, 1),
            lambda value, template: _problem(template),
            lambda value: _triplet(4.0),
            removes=True,
        ),
        Trade(
            "aperture",
            "f-number, dim light",
            "",
            (4.0, 2.8, 2.0, 1.6),
            lambda value, template: _problem(template),
            lambda value: _triplet(value),
            DIM,
        ),
        Trade(
            "tolerance",
            "errors of manufacture",
            "x",
            (2.0, 8.0, 16.0),
            lambda value, template: _problem(template, made=_precision(value)),
            lambda value: _triplet(),
        ),
        Trade(
            "field",
            "half field",
            "deg",
            (26.0, 34.0, 42.0),
            lambda value, template: _problem(template),
            lambda value: _triplet(half_field_deg=value),
        ),
    )
}


def spot_chain(trade: Trade, seed: int, steps: int = 60) -> list[GeoLens]:
    """Spot optima of one random start at every value: each led on from the looser one, and back from the tighter one
    where that is better."""
    generator = torch.Generator().manual_seed(seed)
    found: list[GeoLens] = []
    for value in trade.values:
        if not found:
            template = trade.template(value)
            problem = trade.problem(value, template)
            candidates = [(problem, _shaken(problem, problem.variables(template), generator))]
        elif trade.removes:
            problems = _fewer(trade, value, found[-1])
            candidates = [(problem, problem.variables(problem.template)) for problem in problems]
        else:
            candidates = [_from(trade, value, found[-1])]
        found.append(_least(candidates, steps))
    if not trade.removes:
        for k in range(len(found) - 2, -1, -1):
            back = _least([_from(trade, trade.values[k], found[k + 1])], steps)
            problem = trade.problem(trade.values[k], found[k])
            found[k] = min(found[k], back, key=lambda g: _merit(problem, g))
    return found


def _from(trade, value, geo):
    """The problem at a value, and the variables there of a lens found at another."""
    problem = trade.problem(value, trade.template(value))
    return problem, problem.variables(geo)


def _least(candidates, steps):
    """The best spot optimum from several (problem, variables), as a lens of its own."""
    solved = [(problem, by_spots(problem, x, FLAT, steps)) for problem, x in candidates]
    return owned(min((p.lens(x) for p, x in solved), key=lambda g: _merit(solved[0][0], g)))


def _merit(problem, geo):
    return float(problem.rms_px(geo) ** 2 + problem.limit_rows(geo).detach().square().sum())


def _shaken(problem, x, generator):
    """A random start around a lens: relative errors of SHAKEN, or less until every ray of it passes."""
    errors = torch.randn(len(x), generator=generator, dtype=x.dtype)
    errors[-1] = -1 / SHAKEN  # at the paraxial focus
    for halving in range(6):
        start = x * (1 + SHAKEN * 0.5**halving * errors)
        with torch.no_grad():
            if not bool(problem.spot_rows(problem.lens(start), FLAT)[1].any()):
                return start
    return x


def _fewer(trade: Trade, value: float, geo: GeoLens) -> Sequence[Problem]:
    """Problems with one element less, of those that can be."""
    found = []
    for element in range(len(elements(geo))):
        try:
            found.append(trade.problem(value, without_element(geo, element).freeze()))
        except DomainError:
            continue  # without this element there is no image behind the lens
    return found


def owned(geo: GeoLens) -> GeoLens:
    """A lens with its own numbers, as a file would bring it."""
    surfaces = geo.to_surfaces()
    return GeoLens(
        surfaces, geo.entrance_pupil_diameter_mm, name=geo.name, half_field_deg=geo.half_field_deg
    ).freeze()
