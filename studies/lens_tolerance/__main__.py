"""What manufacturing errors do to a lens: forecast from derivatives, judged by Monte Carlo.

Radii, thicknesses, indices, decentres and tilts of every surface err independently. Focal lengths, distortion
and image shift are forecast linearly. The spot is not linear near an optimum, so its square is forecast by
the quadratic form of the ray errors, with the image plane fixed and refocused. Trials draw the same errors
for both, so forecast and truth are compared lens by lens. At the end the other way round: what precision each surface
needs for a spot, and for a flow error, that grows by 10 %.
"""

import dataclasses
import math
import sys
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import matplotlib.pyplot as plt
import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.lens import WAVELENGTH_UM
from codesign.lens.design.tolerance import (
    LINEAR_FIGURES,
    Tolerances,
    Trials,
    compare,
    compensated,
    errors_of,
    forecast_spot,
    linear_figures,
    monte_carlo,
    sensitivities,
    spot_errors,
    squared_spots,
    worst_offenders,
)
from codesign.lens.solves import focus_rays
from studies.frame.run import Run, StudyConfig, main
from studies.lens_tolerance.needed import report_needed

FIELDS = (0.0, 0.7, 1.0)
LINES = tuple(WAVELENGTH_UM[line] for line in "FdC")
CHUNK = 50  # trials per step of the progress
SHARES = (0.05, 0.5, 0.95)
DRAWS = 20000  # of the quadratic form, for its quantiles


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"trials": 150, "flow_lenses": 3, "flow_cases": 1, "flow_fresh": 0}
    lens: str = "cooke-triplet"
    """Lens: cooke-triplet, double-gauss, la1509, or a lens file."""
    trials: int = 1000
    """Lenses drawn at random."""
    half_field_deg: float | None = None
    """Half field; that of the lens when left out."""
    radius_relative: float = 1e-3
    """Standard deviation of every radius, as a share."""
    fringes: float = 1.0
    """Standard deviation of every surface's power, rings of Newton's fringes."""
    thickness_mm: float = 0.02
    """Standard deviation of every thickness but the last."""
    index: float = 5e-4
    """Standard deviation of every index."""
    decentre_mm: float = 0.01
    """Standard deviation of every surface's decentre, in x and in y."""
    tilt_deg: float = 0.02
    """Standard deviation of every surface's tilt, about x and about y."""
    flow_lenses: int = 12
    """Faulty lenses whose flow error is judged for the precision that flow needs; 0 leaves that out."""
    flow_cases: int = 4
    """Cases (worlds and motions) of each, the same for all lenses."""
    flow_fresh: int = 8
    """Lenses drawn afresh from the tolerances found, to judge them."""
    widest: float = 1000.0
    """Largest factor on a deviation given, where a surface needs no precision."""


def study(run: Run[Config]):
    config = run.config
    if config.trials < 3:
        raise DomainError(f"{config.trials} trials are too few to compare; give at least 3.")
    if config.flow_lenses < 0 or config.flow_fresh < 0 or config.flow_cases < 1 or not config.widest > 0:
        raise DomainError(
            f"{config.flow_lenses} lenses, {config.flow_fresh} fresh ones, {config.flow_cases} cases and a largest factor "
            f"of {config.widest}: give at least 0, 0, 1 and more than 0."
        )
    geo = lens.load(config.lens).freeze()
    half_field = half_field_of(geo, config)
    tolerances = Tolerances(
        **{f.name: getattr(config, f.name) for f in dataclasses.fields(Tolerances) if hasattr(config, f.name)}
    )
    angles = tuple(share * half_field for share in FIELDS)
    linear = linear_figures(half_field)
    refocus = partial(focus_rays, fields_rad=angles, wavelengths_um=LINES, grid=8)
    rays = {
        name: compensated(spot_errors(angles, LINES), compensate)
        for name, compensate in (("fixed", None), ("refocused", refocus))
    }
    slopes = sensitivities(geo, tolerances, linear)
    forecasts = {
        name: forecast_spot(figure(geo).detach(), sensitivities(geo, tolerances, figure), len(FIELDS))
        for name, figure in rays.items()
    }
    run.say(f"{geo.name}: {slopes.shape[1]} independent errors")
    trials = simulate(
        run,
        geo,
        tolerances,
        lambda faulty: torch.cat(
            [linear(faulty), *(squared_spots(figure(faulty), len(FIELDS)) for figure in rays.values())]
        ),
    )
    count = len(LINEAR_FIGURES)
    report_linear(
        run,
        slopes,
        dataclasses.replace(trials, figures=trials.figures[:, :count], nominal=trials.nominal[:count]),
    )
    squares = {
        name: trials.figures[:, count + k * len(FIELDS) :][:, : len(FIELDS)] for k, name in enumerate(rays)
    }
    for name, forecast in forecasts.items():
        report_spot(
            run, name, forecast, trials.amounts, squares[name], torch.Generator().manual_seed(config.seed + 1)
        )
    report_offenders(run, geo, tolerances, slopes, forecasts)
    report_needed(run)
    run.record(trials=trials.figures.shape[0], failed_trials=trials.failed, errors=slopes.shape[1])
    sentence = f"{geo.name}, half field {math.degrees(half_field):.3g} degrees, {trials.figures.shape[0]} trials of {slopes.shape[1]} errors, of which {trials.failed} failed."
    run.finish(
        "Tolerances", sentence + " Every tolerance is one standard deviation of an independent normal error."
    )


def half_field_of(geo, config):
    """Half field in radians, from the command line, the lens or the catalogue. Raises: DomainError when none
    says."""
    published = lens.half_field_deg(config.lens) if config.lens in lens.catalogue.LENSES else None
    found = next(
        (angle for angle in (config.half_field_deg, geo.half_field_deg, published) if angle is not None), None
    )
    if found is None or not 0 < found < 90:
        raise DomainError(
            f"lens {config.lens}: the half field is {found} degrees; give one between 0 and 90 with "
            "--half-field-deg."
        )
    return math.radians(found)


def simulate(run, geo, tolerances, figures):
    """Trials in chunks, going on where an earlier session stopped."""
    total = run.config.trials
    generator = torch.Generator().manual_seed(run.config.seed)
    parts = []
    if run.resumed and (stored := run.load_state()):
        generator.set_state(stored.tensors["generator"])
        parts.append(
            Trials(
                stored.tensors["amounts"],
                stored.tensors["figures"],
                stored.tensors["nominal"],
                int(stored.numbers["failed"]),
            )
        )

    def join():
        return Trials(
            torch.cat([p.amounts for p in parts]),
            torch.cat([p.figures for p in parts]),
            parts[0].nominal,
            sum(p.failed for p in parts),
        )

    def save():
        whole = join()
        run.save_state(
            {
                "amounts": whole.amounts,
                "figures": whole.figures,
                "nominal": whole.nominal,
                "generator": generator.get_state(),
            },
            {"failed": whole.failed},
        )

    run.on_interrupt(save)
    chunks = math.ceil(total / CHUNK)
    done = sum(math.ceil(p.figures.shape[0] / CHUNK) for p in parts)
    with run.progress(chunks, "trials", done) as progress:
        for chunk in range(done, chunks):
            parts.append(monte_carlo(geo, tolerances, figures, min(CHUNK, total - chunk * CHUNK), generator))
            progress.advance(failed=sum(p.failed for p in parts))
    save()
    return join()


def report_linear(run, slopes, trials):
    """Table, figure and metrics of the linear figures."""
    found = compare(slopes, trials)
    quantiles = trials.quantiles(SHARES)
    rows = []
    for k, name in enumerate(LINEAR_FIGURES):
        key = name.split(" (")[0].lower().replace(" ", "_")
        ratio = float(found.forecast[k] / found.simulated[k]) if float(found.simulated[k]) else 1.0
        run.record(
            **{
                f"{key}_deviation_forecast": found.forecast[k],
                f"{key}_deviation_simulated": found.simulated[k],
                f"{key}_deviation_ratio": ratio,
                f"{key}_correlation": found.correlation[k],
            }
        )
        rows.append(
            [
                name,
                f"{float(trials.nominal[k]):.5g}",
                f"{float(found.forecast[k]):.4g}",
                f"{float(found.simulated[k]):.4g}",
                f"{ratio:.3f}",
                f"{float(found.correlation[k]):.6f}",
                f"{float(found.bias[k]):+.3f}",
                *(f"{float(q):.5g}" for q in quantiles[:, k]),
            ]
        )
    noise = 1 / math.sqrt(2 * max(trials.figures.shape[0] - 1, 1))
    run.card(
        "Linear figures",
        f"{min(found.correlation.tolist()):.6f}",
        "lowest correlation of forecast and simulated change",
    )
    run.section("Linear figures")
    run.table(
        "Forecast and trials",
        [
            "figure",
            "nominal",
            "deviation forecast",
            "simulated",
            "ratio",
            "correlation",
            "mean shift / deviation",
            "5 %",
            "50 %",
            "95 %",
        ],
        rows,
        f"{trials.figures.shape[0]} trials know a standard deviation to {noise:.1%} (one standard error); "
        "the correlation is not limited by that.",
    )
    good = trials.figures.isfinite().all(1)
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.4), layout="constrained")
    for axis, k in zip(axes, (0, 2, 4), strict=True):
        _scatter(
            axis,
            (trials.amounts @ slopes[k])[good],
            (trials.figures[:, k] - trials.nominal[k])[good],
            f"change of {LINEAR_FIGURES[k]}",
        )
    run.figure(
        figure,
        "linear",
        "Change forecast from derivatives and change simulated, a mark per trial; the line is equality.",
    )


def report_spot(run, name, forecast, amounts, squares, generator):
    """Table, figure and metrics of the spot, with the image plane fixed or refocused."""
    good = squares.isfinite().all(1)
    squares = squares[good]
    predicted = forecast.at(amounts[good])
    drawn = (
        forecast.at(torch.randn(DRAWS, amounts.shape[1], generator=generator, dtype=amounts.dtype))
        .clamp_min(0)
        .sqrt()
        * 1e3
    )
    truth = squares.sqrt() * 1e3
    rows = []
    for f, share in enumerate(FIELDS):
        mean = float(squares[:, f].mean())
        deviation = float(squares[:, f].std())
        correlation = float(torch.corrcoef(torch.stack([predicted[:, f], squares[:, f]]))[0, 1])
        key = f"spot_{name}_field{share:g}".replace(".", "_")
        same = float(predicted[:, f].mean()) / mean
        same_deviation = float(predicted[:, f].std()) / deviation
        run.record(
            **{
                f"{key}_mean_square_ratio": float(forecast.mean[f]) / mean,
                f"{key}_mean_square_same_draws_ratio": same,
                f"{key}_deviation_same_draws_ratio": same_deviation,
                f"{key}_deviation_ratio": float(forecast.deviation[f]) / deviation,
                f"{key}_linear_deviation_ratio": float(forecast.linear_deviation[f]) / deviation,
                f"{key}_correlation": correlation,
            }
        )
        both = [
            f"{float(torch.quantile(drawn[:, f], q)):.2f} / {float(torch.quantile(truth[:, f], q)):.2f}"
            for q in SHARES
        ]
        rows.append(
            [
                f"{share:g}",
                f"{1e3 * float(forecast.nominal[f]) ** 0.5:.2f}",
                f"{1e3 * float(forecast.mean[f]) ** 0.5:.2f}",
                f"{1e3 * mean**0.5:.2f}",
                f"{same:.4f}",
                f"{same_deviation:.4f}",
                f"{float(forecast.deviation[f]) / deviation:.3f}",
                f"{float(forecast.linear_deviation[f]) / deviation:.3f}",
                f"{correlation:.5f}",
                *both,
            ]
        )
    metrics = [
        run.metrics[f"spot_{name}_field{share:g}_mean_square_same_draws_ratio".replace(".", "_")]
        for share in FIELDS
    ]
    run.card(
        f"Spot, {name}",
        f"{max(abs(m - 1) for m in metrics):.2%}",
        "largest error of the forecast mean square spot over the same draws",
    )
    run.section(f"Spot with the image plane {name}")
    columns = [
        "field",
        "nominal (µm)",
        "root mean square forecast (µm)",
        "simulated",
        "mean square of the same draws: forecast / simulated",
        "its deviation",
    ]
    columns += [
        "deviation of the square: quadratic / simulated",
        "linear / simulated",
        "correlation of squares",
        *(f"{q:.0%} forecast / simulated (µm)" for q in SHARES),
    ]
    run.table(
        "Forecast and trials",
        columns,
        rows,
        "RMS spots over F, d and C. Over the same draws only the forecast errs; over all draws the trials' "
        "own scatter comes in (heavy tails: some 5 % of a deviation "
        "at a thousand trials). The linear column is the forecast from the slope of the squared spot alone.",
    )
    figure, axes = plt.subplots(1, len(FIELDS), figsize=(11, 3.4), layout="constrained")
    for axis, f in zip(axes, range(len(FIELDS)), strict=True):
        edges = torch.linspace(float(truth[:, f].min()), float(truth[:, f].max()), 31).tolist()
        axis.hist(truth[:, f].tolist(), bins=edges, density=True, color="#9cc3dd", label="simulated")
        axis.hist(
            drawn[:, f].tolist(), bins=edges, density=True, histtype="step", color="#c0392b", label="forecast"
        )
        axis.axvline(1e3 * float(forecast.nominal[f]) ** 0.5, color="k", linewidth=1, label="nominal")
        axis.set(xlabel="RMS spot (µm)", title=f"field {FIELDS[f]:g}")
    axes[0].legend(frameon=False, fontsize=8)
    run.figure(
        figure, f"spot_{name}", "Distribution of the RMS spot: trials, and draws of the quadratic forecast."
    )


def report_offenders(run, geo, tolerances, slopes, forecasts):
    """The errors that matter most."""
    run.section("Worst offenders")
    for name, forecast in forecasts.items():
        added = forecast.added.mean(0)
        order = added.argsort(descending=True)[:10].tolist()
        errors = errors_of(geo, tolerances)
        run.table(
            f"Spot, {name}",
            ["error", "mean square added (µm²)", "share"],
            [
                [errors[k].name, f"{1e6 * float(added[k]):.3f}", f"{float(added[k] / added.sum()):.1%}"]
                for k in order
            ],
            "Mean over the fields, per one standard deviation of the error.",
        )
    for k in (0, 2):
        rows = [
            [name, f"{change:+.4g}", f"{share:.1%}"]
            for name, change, share in worst_offenders(geo, tolerances, slopes, k, 8)
        ]
        run.table(LINEAR_FIGURES[k], ["error", "change per standard deviation", "share of variance"], rows)


def _scatter(axis, forecast, simulated, label):
    axis.plot(forecast.tolist(), simulated.tolist(), ".", markersize=3, color="#1b6ca8")
    ends = [float(forecast.min()), float(forecast.max())]
    axis.plot(ends, ends, color="k", linewidth=0.8)
    axis.set(xlabel="forecast", ylabel="simulated", title=label)


if __name__ == "__main__":
    sys.exit(main(study, Config))
