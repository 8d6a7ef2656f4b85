"""What manufacturing errors do to a lens: forecast from derivatives, judged by Monte Carlo.

Radii, thicknesses, indices, decentres and tilts of every surface err independently. Focal lengths,
distortion and image shift are forecast linearly. The spot is not linear near an optimum, so its
square is forecast by the quadratic form of the ray errors, with the image plane fixed and
refocused. Trials draw the same errors for both, so forecast and truth are compared lens by lens. At
the end the other way round: what precision each part needs for a spot that grows by 10 %.
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
from codesign.lens.design import precision
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
from studies.frame.show import table
from studies.frame.sweep import plain

FIELDS = (0.0, 0.7, 1.0)
LINES = tuple(WAVELENGTH_UM[line] for line in "FdC")
CHUNK = 50  # trials per step of the progress
QUANTILES = (0.05, 0.5, 0.95)
DRAWS = 20000  # of the quadratic form, for its quantiles
GROWTH = 0.1  # of the RMS spot, for the precision needed
SHARE = 0.9  # of the lenses that keep it
JUDGED = 100  # lenses of the precision needed


@dataclass(frozen=True)
class Config(StudyConfig):
    QUICK: ClassVar = {"trials": 150}
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
    widest: float = 1000.0
    """Largest factor on a deviation given, where a surface needs no precision."""


def study(run: Run[Config]):
    config = run.config
    if config.trials < 3 or not config.widest > 0:
        raise DomainError(
            f"{config.trials} trials and a largest factor of {config.widest}: give at least 3, which can be "
            "compared, and more than 0."
        )
    geo = lens.load(config.lens).freeze()
    half_field = half_field_of(geo, config)
    known = {field.name for field in dataclasses.fields(Tolerances)}
    tolerances = Tolerances(**{name: x for name, x in vars(config).items() if name in known})
    angles = tuple(share * half_field for share in FIELDS)
    linear = linear_figures(half_field)
    refocus = partial(focus_rays, fields_rad=angles, wavelengths_um=LINES, grid=8)
    fixed = spot_errors(angles, LINES)
    rays = {"fixed": fixed, "refocused": compensated(fixed, refocus)}
    slopes = sensitivities(geo, tolerances, linear)
    forecasts = {
        name: forecast_spot(
            figure(geo).detach(), sensitivities(geo, tolerances, figure), len(FIELDS)
        )
        for name, figure in rays.items()
    }
    errors = slopes.shape[1]
    run.say(f"{geo.name}: {errors} independent errors")

    def figures(faulty):
        squares = [squared_spots(figure(faulty), len(FIELDS)) for figure in rays.values()]
        return torch.cat([linear(faulty), *squares])

    trials = simulate(run, geo, tolerances, figures)
    count = len(LINEAR_FIGURES)
    first = dataclasses.replace(
        trials, figures=trials.figures[:, :count], nominal=trials.nominal[:count]
    )
    report_linear(run, slopes, first)
    grown = []
    spots = trials.figures[:, count:].split(len(FIELDS), 1)
    for (name, forecast), squares in zip(forecasts.items(), spots, strict=True):
        change = report_spot(run, name, forecast, trials.amounts, squares)
        grown.append(f"{change} (image plane {name})")
    report_offenders(run, geo, tolerances, slopes, forecasts)
    report_needed(run, geo, fixed, refocus)
    run.record(trials=config.trials, failed_trials=trials.failed, errors=errors)
    run.finish(
        "Tolerances",
        f"Such errors make the RMS spot go {' or '.join(grown)}: root mean square over the lenses, in the field where it "
        f"grows most. {geo.name}, half field {math.degrees(half_field):.3g} degrees, {config.trials} trials of {errors} "
        f"errors, of which {trials.failed} failed. Every tolerance is one standard deviation of an "
        "independent normal error.",
    )


def half_field_of(geo, config):
    """Half field in radians, from the command line or the lens. Raises: DomainError when none
    says."""
    found = geo.half_field_deg if config.half_field_deg is None else config.half_field_deg
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
    if stored := run.load_state():
        generator.set_state(stored.tensors.pop("generator"))
        parts.append(Trials(**stored.tensors, failed=int(stored.numbers["failed"])))

    def join():
        amounts, tables = (
            torch.cat([getattr(p, name) for p in parts]) for name in ("amounts", "figures")
        )
        return Trials(amounts, tables, parts[0].nominal, sum(p.failed for p in parts))

    def save():
        tensors = dataclasses.asdict(join()) | {"generator": generator.get_state()}
        run.save_state(tensors, {"failed": tensors.pop("failed")})

    run.on_interrupt(save)
    done = sum(math.ceil(part.figures.shape[0] / CHUNK) for part in parts)
    chunks = math.ceil(total / CHUNK)
    with run.progress(chunks, "trials", done) as progress:
        for chunk in range(done, chunks):
            parts.append(
                monte_carlo(geo, tolerances, figures, min(CHUNK, total - chunk * CHUNK), generator)
            )
            progress.advance(failed=sum(p.failed for p in parts))
    save()
    return join()


def report_linear(run, slopes, trials):
    found = compare(slopes, trials)
    quantiles = trials.quantiles(QUANTILES)
    rows = []
    for k, name in enumerate(LINEAR_FIGURES):
        known = {
            "deviation_forecast": found.forecast[k],
            "deviation_simulated": found.simulated[k],
            "correlation": found.correlation[k],
        }
        key = plain(name.split(" (")[0])
        run.record(**{f"{key}_{figure}": value for figure, value in known.items()})
        figures = {"nominal": trials.nominal[k], **known, "mean shift / deviation": found.bias[k]}
        figures |= {f"{q:.0%}": value for q, value in zip(QUANTILES, quantiles[:, k], strict=True)}
        # what is 0 by symmetry is shown as 0, not as its rounding
        said = {title: f"{round(float(x), 12) + 0.0:.6g}" for title, x in figures.items()}
        rows.append({"figure": name, **said})
    run.card(
        "Linear figures",
        f"{min(found.correlation.tolist()):.6f}",
        "lowest correlation of forecast and simulated change",
    )
    run.section("Linear figures")
    count = trials.figures.shape[0]
    run.table(
        "Forecast and trials",
        *table(rows),
        f"{count} trials know a standard deviation to {(2 * count - 2) ** -0.5:.1%} (one standard error); "
        "the correlation is not limited by that.",
    )
    good = trials.figures.isfinite().all(1)
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.4), layout="constrained")
    for axis, k in zip(axes, (0, 2, 4), strict=True):
        forecast = trials.amounts[good] @ slopes[k]
        ends = [float(forecast.min()), float(forecast.max())]
        simulated = trials.figures[good, k] - trials.nominal[k]
        # below the marks, which lie on it
        axis.plot(ends, ends, color="0.8", linewidth=4)
        axis.plot(forecast.numpy(), simulated.numpy(), ".", markersize=3, color="#1b6ca8")
        axis.set(xlabel="forecast", ylabel="simulated", title=f"change of {LINEAR_FIGURES[k]}")
    run.figure(
        figure,
        "linear",
        "Change forecast from derivatives and change simulated, a mark per trial; the line is equality.",
    )


def report_spot(run, name, forecast, amounts, squares):
    """Table, figure and metrics of the spot, with the image plane fixed or refocused; returns from
    what to what it grows in the field where it grows most."""
    good = squares.isfinite().all(1)
    squares = squares[good]
    predicted = forecast.at(amounts[good])
    generator = torch.Generator().manual_seed(run.config.seed + 1)
    draws = torch.randn(DRAWS, amounts.shape[1], generator=generator, dtype=amounts.dtype)
    drawn_um, truth_um, nominal_um = (
        v.clamp_min(0).sqrt() * 1e3 for v in (forecast.at(draws), squares, forecast.nominal)
    )
    mean, deviation = squares.mean(0), squares.std(0)
    added, spread = forecast.moments()
    known = {
        "mean_square_same_draws_ratio": predicted.mean(0) / mean,
        "deviation_same_draws_ratio": predicted.std(0) / deviation,
        "deviation_ratio": spread / deviation,
        "linear_deviation_ratio": torch.linalg.vector_norm(forecast.linear, dim=1) / deviation,
        "correlation": [
            torch.corrcoef(torch.stack(pair))[0, 1]
            for pair in zip(predicted.T, squares.T, strict=True)
        ],
    }
    expected = forecast.nominal + added
    quantiles = [v.quantile(v.new_tensor(QUANTILES), 0) for v in (drawn_um, truth_um)]
    rows = []
    for f, share in enumerate(FIELDS):
        figures = {figure: values[f] for figure, values in known.items()}
        key = f"spot_{name}_field{share:g}".replace(".", "_")
        figures_of = {"mean_square_ratio": expected[f] / mean[f], **figures}
        run.record(**{f"{key}_{figure}": value for figure, value in figures_of.items()})
        sizes = nominal_um[f], 1e3 * expected[f].sqrt(), 1e3 * mean[f].sqrt()
        cells = [f"{share:g}", *(f"{size:.2f}" for size in sizes)]
        cells += [f"{v:.5f}" for v in figures.values()]
        both = zip(*(q[:, f].tolist() for q in quantiles), strict=True)
        rows.append([*cells, *(f"{a:.2f} / {b:.2f}" for a, b in both)])
    worst = (known["mean_square_same_draws_ratio"] - 1).abs().max()
    run.card(
        f"Spot, {name}", f"{worst:.2%}", "largest error of the mean square spot over the same draws"
    )
    run.section(f"Spot with the image plane {name}")
    run.table(
        "Forecast and trials",
        [
            *("field", "nominal (µm)", "root mean square forecast (µm)", "simulated"),
            *("mean square of the same draws: forecast / simulated", "its deviation"),
            *("deviation of the square: quadratic / simulated", "linear / simulated"),
            *("correlation of squares", *(f"{q:.0%} forecast / simulated (µm)" for q in QUANTILES)),
        ],
        rows,
        "RMS spots over F, d and C. Over the same draws only the forecast errs; over all draws the trials' "
        "own scatter comes in (heavy tails: some 5 % of a deviation at a thousand trials). The linear column "
        "is the forecast from the slope of the squared spot alone.",
    )
    figure, axes = plt.subplots(1, len(FIELDS), figsize=(11, 3.4), layout="constrained")
    for f, axis in enumerate(axes):
        # all of both: a part alone would have another density
        both = torch.cat([truth_um[:, f], drawn_um[:, f]])
        shape = {"bins": 40, "range": (float(both.min()), float(both.max())), "density": True}
        axis.hist(truth_um[:, f].numpy(), color="#9cc3dd", label="simulated", **shape)
        shape |= {"histtype": "step", "color": "#c0392b", "label": "forecast"}
        axis.hist(drawn_um[:, f].numpy(), **shape)
        axis.axvline(float(nominal_um[f]), color="k", linewidth=1, label="nominal")
        axis.set(xlabel="RMS spot (µm)", title=f"field {FIELDS[f]:g}")
    axes[0].set_ylabel("share of the lenses per µm")
    axes[0].legend(frameon=False, fontsize=8)
    run.figure(
        figure,
        f"spot_{name}",
        "Distribution of the RMS spot: trials, and draws of the quadratic forecast.",
    )
    most = int((mean / forecast.nominal).argmax())
    return f"from {nominal_um[most]:.2f} to {1e3 * mean[most].sqrt():.2f} µm"


def report_offenders(run, geo, tolerances, slopes, forecasts):
    run.section("Worst offenders")
    errors = errors_of(geo, tolerances)
    for name, forecast in forecasts.items():
        added = forecast.added.mean(0)
        run.table(
            f"Spot, {name}",
            ["error", "mean square added (µm²)", "share"],
            [
                [errors[k].name, f"{1e6 * added[k]:.3f}", f"{added[k] / added.sum():.1%}"]
                for k in added.argsort(descending=True)[:10].tolist()
            ],
            "Mean over the fields, per one standard deviation of the error.",
        )
    for k in (0, 2):
        found = worst_offenders(geo, tolerances, slopes, k, 8)
        rows = [[name, f"{change:+.4g}", f"{share:.1%}"] for name, change, share in found]
        run.table(
            LINEAR_FIGURES[k], ["error", "change per standard deviation", "share of variance"], rows
        )


def report_needed(run, geo, figure, refocus):
    """Table and metrics of the cheapest precision of surfaces and elements that a spot 10 % larger
    leaves."""
    config = run.config
    tolerances = Tolerances(
        radius_relative=config.radius_relative,
        thickness_mm=config.thickness_mm,
        index=config.index,
        fringes=config.fringes,
        element_decentre_mm=config.decentre_mm,
        element_tilt_deg=config.tilt_deg,
        element_wedge_deg=config.tilt_deg,
    )
    errors = errors_of(geo, tolerances)
    slopes = sensitivities(geo, errors, figure, compensate=refocus)
    forecast = forecast_spot(compensated(figure, refocus)(geo), slopes, len(FIELDS)).averaged()
    budget = ((1 + GROWTH) ** 2 - 1) * float(forecast.nominal)
    needed = precision.cheapest(forecast, errors, budget, SHARE, most=config.widest)

    def square(faulty):
        return squared_spots(figure(faulty), len(FIELDS)).mean().reshape(1)

    generator = torch.Generator().manual_seed(config.seed + 3)
    trials = monte_carlo(geo, needed.errors, square, JUDGED, generator, compensate=refocus)
    kept = (trials.figures - trials.nominal <= budget).double().mean()
    run.record(needed_share_within_budget=kept, needed_cost=needed.cost)
    shares = dict.fromkeys((error.drawn for error in needed.errors), 0.0)
    deviations = {error.drawn: said(geo, error) for error in reversed(needed.errors)}
    for error, share in zip(needed.errors, needed.shares.tolist(), strict=True):
        shares[error.drawn] += share
    run.section("What precision each part needs")
    run.table(
        f"Standard deviations for which {SHARE:.0%} of lenses keep their spot within {GROWTH:.0%}",
        ["tolerance", "deviation", "share of the budget"],
        [[name, deviations[name], f"{share:.1%}"] for name, share in shares.items()],
        "Refocused after assembly; cheapest at costs of one over each tolerance in units of the one given. "
        f"{kept:.0%} of {JUDGED} simulated lenses keep the budget.",
    )


def said(geo, error):
    """The deviation of an error as a drawing says it."""
    size = error.deviation
    if error.tensor == "curvature_per_mm":
        c = float(geo.curvature_per_mm[error.at[0]])
        return f"{abs(size / c):.2%} of the radius" if c else f"{size:.2g} per mm"
    if error.tensor.endswith("rad"):
        return f"{math.degrees(size) * 60:.1f} arcmin"
    return f"{size:.5f}" if error.tensor == "index_offset" else f"{1e3 * size:.1f} µm"


if __name__ == "__main__":
    sys.exit(main(study, Config))
