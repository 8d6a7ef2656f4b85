"""What precision each surface needs: for a spot that grows by a tenth, and for a flow error that grows by a tenth.

The lens is scaled to the sensor of the main job and refocused on its wall after assembly. The squared spot is
forecast to second order, so the cheapest tolerances for a budget of spot follow (``lens.design.precision``). A flow
error is too noisy to differentiate error by error. But it follows the blur: lenses with random errors, scaled to
larger and larger spots, give flow error over squared spot; a line is fitted to its logarithm, and where that has grown
by 10 % is a budget of spot, to which the same kind of tolerances belongs. Fresh lenses judge it.
"""

import math
from dataclasses import replace
from functools import partial

import matplotlib.pyplot as plt
import torch

from codesign import flow, lens
from codesign.errors import DomainError
from codesign.lens.analysis.rays import source_rays, trace_source
from codesign.lens.design import Tolerances, precision
from codesign.lens.design.tolerance import (
    compensated,
    errors_of,
    forecast_spot,
    monte_carlo,
    perturbed,
    sensitivities,
    squared_spots,
)
from codesign.lens.solves import focus_rays
from studies.lens_opt.task import (
    DISTANCE_M,
    HELD_OUT,
    LIGHT,
    PITCH_MM,
    SENSOR_PX,
    draw_case,
    make_task,
    make_worlds,
)

GROWTH = 0.1
SHARE = 0.9
WIDEST_PX = 1.2  # RMS spot of the lens with the largest errors; far beyond it the flow error saturates
SAMPLES = 16
GRID = 8
TRIALS = 100  # that judge the spot


def report_needed(run):
    """Tables, figure and metrics of the precision that a spot and a flow error 10 % larger leave."""
    config = run.config
    if not config.flow_lenses:
        return
    run.section("What precision each surface needs")
    try:
        task = make_task(config.lens, config.seed)
    except DomainError as error:
        run.say(f"the precision that flow needs is left out: {error}")
        return
    fields = task.fields_rad
    everywhere = (*fields, *(-f for f in fields[1:]))
    refocus = partial(
        focus_rays, fields_rad=everywhere, wavelengths_um=LIGHT.wavelengths_um, grid=8, at_m=DISTANCE_M
    )
    errors = errors_of(
        task.nominal,
        Tolerances(
            radius_relative=config.radius_relative,
            thickness_mm=config.thickness_mm,
            index=config.index,
            element_decentre_mm=config.decentre_mm,
            element_tilt_deg=config.tilt_deg,
            element_wedge_deg=config.tilt_deg,
        ),
    )
    rays = partial(window_errors, fields)
    slopes = sensitivities(task.nominal, errors, rays, compensate=refocus)
    forecast = precision.of_spot(forecast_spot(compensated(rays, refocus)(task.nominal), slopes, len(fields)))
    for_spot = precision.cheapest(
        forecast, errors, ((1 + GROWTH) ** 2 - 1) * forecast.nominal, SHARE, most=config.widest
    )
    judge = FlowJudge(run, task, refocus, config.flow_cases)
    drawn = judge.grown(errors, for_spot.factors)
    offset, slope, error = line([(0.0, 0.0), *drawn])
    if not slope > 0:
        run.say(
            "the flow error did not grow with the spot of these lenses, so the precision that it needs is left out; judge "
            "more lenses (--flow-lenses) over more cases (--flow-cases)."
        )
        return
    limit_px2 = math.log1p(GROWTH) / slope
    for_flow = precision.cheapest(forecast, errors, limit_px2 * PITCH_MM**2, SHARE, most=config.widest)
    fresh = judge.fresh(for_flow.errors, config.flow_fresh)
    write(run, task, forecast, for_spot, for_flow, drawn, (offset, slope, error), fresh, rays, refocus)


def window_errors(fields_rad, used):
    """Ray errors [F * M * 2] as ``spot_errors`` gives them, of the fields at the windows of the film: on the
    sensor's diagonal, which a lens with decentres and tilts does not image as it does the upright."""
    pupil = lens.pupil_grid(GRID)
    rays = source_rays(used, fields_rad, pupil, DISTANCE_M)
    across, along = (-n / math.hypot(*SENSOR_PX) for n in SENSOR_PX)  # on the film the image is inverted
    turn = torch.tensor([[along, across, 0.0], [-across, along, 0.0], [0.0, 0.0, 1.0]], dtype=pupil.dtype)
    turned = replace(rays, origin_mm=rays.origin_mm @ turn.T, direction=rays.direction @ turn.T)
    found = [trace_source(used, turned, w) for w in LIGHT.wavelengths_um]
    if not all(bool(r.weight.bool().all()) for r in found):
        raise DomainError(f"{used.name}: rays fail; use smaller tolerances.")
    position = torch.cat([r.position_mm for r in found], 1)
    return ((position - position.mean(1, keepdim=True)) / position.shape[1] ** 0.5).reshape(-1)


class FlowJudge:
    """Flow error of faulty lenses over the same cases as the lens without faults.

    grown and fresh give lists of (squared spot added in px^2, logarithm of the flow error over that of the nominal lens).
    """

    def __init__(self, run, task, refocus, cases):
        self.run = run
        self.task = task
        self.refocus = refocus
        pool = make_worlds(HELD_OUT)
        self.cases = [draw_case(pool, 9_500_000 + i, frames=17) for i in range(cases)]
        self.generator = torch.Generator().manual_seed(run.config.seed + 2)
        self.nominal_px2, self.nominal_mrad = self.of(task.nominal)

    def of(self, faulty):
        """Mean squared spot in px^2 and flow error in mrad of a lens after refocusing."""
        used = self.refocus(faulty)
        return self.blur_px2(used), self.flow_error_mrad(used)

    def blur_px2(self, used):
        """Squared RMS spot, mean over the fields."""
        errors = window_errors(self.task.fields_rad, used)
        return float(squared_spots(errors, len(self.task.fields_rad)).mean()) / PITCH_MM**2

    def flow_error_mrad(self, used):
        """Mean over the cases, hard events."""
        errors = [
            self.task.judge(used, case, flow.estimate_lk, SAMPLES)["flow_error_mrad"] for case in self.cases
        ]
        return sum(errors) / len(errors)

    def grown(self, errors, shape):
        """Lenses whose errors are drawn in these proportions and scaled until their spots are in even steps up to
        WIDEST_PX."""
        count = self.run.config.flow_lenses
        found = []
        with self.run.progress(count, "flow error of faulty lenses") as bar:
            for k in range(count):
                draw = shape * self._draw(errors)
                found.append(
                    self._ratio(errors, draw * self._scale(errors, draw, (WIDEST_PX * (k + 1) / count) ** 2))
                )
                bar.advance()
        return found

    def fresh(self, errors, count):
        """Lenses drawn from these errors."""
        found = []
        with self.run.progress(count, "flow error of fresh lenses") as bar:
            for _ in range(count):
                found.append(self._ratio(errors, self._draw(errors)))
                bar.advance()
        return found

    def _draw(self, errors):
        return torch.randn(len(errors), generator=self.generator, dtype=torch.float64)

    def _scale(self, errors, draw, aim_px2):
        """By how much to multiply errors so that the refocused lens has this squared spot beside its own."""
        low, high = 0.0, 1.0
        while self._blur(errors, draw * high) < aim_px2:
            low, high = high, 2 * high
        for _ in range(12):
            middle = (low + high) / 2
            low, high = (middle, high) if self._blur(errors, draw * middle) < aim_px2 else (low, middle)
        return high

    def _blur(self, errors, amounts):
        with torch.no_grad():
            used = self.refocus(perturbed(self.task.nominal, errors, amounts))
            return self.blur_px2(used) - self.nominal_px2

    def _ratio(self, errors, amounts):
        with torch.no_grad():
            spot, mrad = self.of(perturbed(self.task.nominal, errors, amounts))
        self.run.say(
            f"spot {math.sqrt(spot):.3f} px, flow error {mrad:.4f} mrad against {self.nominal_mrad:.4f}"
        )
        return spot - self.nominal_px2, math.log(mrad / self.nominal_mrad)


def line(points):
    """Offset and slope of the least-squares line, and the standard error of the slope as a share of it. The offset is
    the chance of the nominal lens, to which every growth is referred."""
    x, y = torch.tensor(points, dtype=torch.float64).unbind(1)
    slope = (x - x.mean()) @ (y - y.mean()) / (x - x.mean()).square().sum()
    offset = y.mean() - slope * x.mean()
    scatter = (y - offset - slope * x).square().sum() / max(len(points) - 2, 1)
    error = (scatter / (x - x.mean()).square().sum()).sqrt() / slope.abs()
    return float(offset), float(slope), float(error)


def write(run, task, forecast, for_spot, for_flow, drawn, fit, fresh, rays, refocus):
    """Metrics, tables and figure."""
    offset, slope, error = fit
    limit_px = math.sqrt(forecast.nominal / PITCH_MM**2 + math.log1p(GROWTH) / slope)
    looser = (for_flow.factors / for_spot.factors).log().mean().exp()
    kept = {}
    for name, found, budget in (
        ("spot", for_spot, ((1 + GROWTH) ** 2 - 1) * forecast.nominal),
        ("flow", for_flow, math.log1p(GROWTH) / slope * PITCH_MM**2),
    ):
        trials = monte_carlo(
            task.nominal,
            found.errors,
            lambda faulty: squared_spots(rays(faulty), len(task.fields_rad)).mean().reshape(1),
            TRIALS,
            torch.Generator().manual_seed(run.config.seed + 3),
            compensate=refocus,
        )
        inside = (trials.figures[:, 0] - trials.nominal[0] <= budget).double().mean()
        kept[name] = float(inside)
    growths = sorted(math.expm1(y - offset) for _, y in fresh)
    run.record(
        needed_nominal_spot_px=math.sqrt(forecast.nominal) / PITCH_MM,
        needed_spot_px_for_flow=limit_px,
        needed_flow_slope_relative_error=error,
        needed_looser_for_flow=looser,
        needed_share_within_spot_budget=kept["spot"],
        needed_share_within_flow_budget=kept["flow"],
    )
    if growths:
        run.record(
            needed_fresh_flow_growth_mean=sum(growths) / len(growths),
            needed_fresh_share_within=sum(g <= GROWTH for g in growths) / len(growths),
        )
    run.card(
        "Precision for flow",
        f"{float(looser):.1f} x looser",
        "tolerances for flow error + 10 % over spot + 10 %",
    )
    rows = {}
    for tight, loose, share in zip(for_spot.errors, for_flow.errors, for_flow.shares.tolist(), strict=True):
        row = rows.setdefault(tight.drawn, [tight.drawn, *map(in_words(task.nominal), (tight, loose)), 0.0])
        row[3] += share
    run.table(
        "Standard deviations for which 90 % of lenses keep the budget",
        ["tolerance", "spot + 10 %", "flow error + 10 %", "share of the budget"],
        [[*row[:3], f"{row[3]:.1%}"] for row in rows.values()],
        f"Scaled to {float(task.nominal.first_order().efl_mm):.4g} mm, refocused at {DISTANCE_M:g} m, cheapest at "
        "costs of one over each tolerance in units of the one given. The spot without faults is "
        f"{math.sqrt(forecast.nominal) / PITCH_MM:.3f} px RMS; flow error + 10 % allows {limit_px:.2f} px (slope known "
        f"to {error:.0%}). {kept['spot']:.0%} and {kept['flow']:.0%} of simulated lenses keep their budgets of spot"
        + (
            f"; the flow error of {len(growths)} fresh lenses grew by {sum(growths) / len(growths):+.1%} in the mean and "
            f"{growths[-1]:+.1%} at most."
            if growths
            else "."
        ),
    )
    figure, axis = plt.subplots(figsize=(6, 3.6), layout="constrained")
    for label, points, colour in (("drawn", drawn, "#1b6ca8"), ("fresh", fresh, "#c0392b")):
        x = [math.sqrt(max(s + forecast.nominal / PITCH_MM**2, 0)) for s, _ in points]
        axis.plot(x, [100 * math.expm1(y - offset) for _, y in points], "o", color=colour, label=label)
    line = torch.linspace(0, WIDEST_PX**2, 50).tolist()
    axis.plot(
        [math.sqrt(x + forecast.nominal / PITCH_MM**2) for x in line],
        [100 * math.expm1(slope * x) for x in line],
        color="k",
        linewidth=0.8,
    )
    axis.axhline(100 * GROWTH, color="k", linestyle=":", linewidth=0.8)
    axis.set(xlabel="RMS spot after refocus (px)", ylabel="flow error grown (%)")
    axis.legend(frameon=False, fontsize=8)
    run.figure(figure, "needed", "Flow error of faulty lenses over their spot, and the line fitted to it.")


def in_words(nominal):
    """A function from an error to its deviation as a drawing says it."""

    def said(error):
        size = error.deviation
        if error.tensor == "curvature_per_mm":
            c = float(nominal.curvature_per_mm[error.at[0]])
            return f"{abs(size / c):.2%} of the radius" if c else f"{size:.2g} per mm"
        if error.tensor.endswith("rad"):
            return f"{math.degrees(size) * 60:.1f} arcmin"
        return f"{size:.5f}" if error.tensor == "index_offset" else f"{1e3 * size:.1f} µm"

    return said
