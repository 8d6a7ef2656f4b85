"""The page of the trade study: what the flow designer gained in each trade, the Pareto figures, and why."""

import math

import matplotlib.pyplot as plt
import torch

from codesign import lens
from codesign.errors import DomainError
from codesign.report import lens_figures
from studies.lens_opt.paired import of_differences
from studies.lens_opt.task import PITCH_MM
from studies.lens_trade.summary import gains
from studies.lens_trade.sweep import DESIGNERS, lens_file
from studies.lens_trade.trades import TRADES

LABELS = {
    "textbook": "least spot, even weights",
    "spots": "best spot designer",
    "flow": "flow designer",
}
COLOURS = {"textbook": "#9a9a9a", "spots": "#c0392b", "flow": "#1b6ca8"}
# what counts as a gain: 15 % shorter, an element, a stop (in f-numbers, a factor of the square root of 2)
ASKED = {"track": math.log(1 / 0.85), "elements": 1.0, "aperture": math.log(2) / 2}


def write(run, tables):
    """Fill and finish the page. tables: trade -> rows in the order of its values, or what went wrong in place of one."""
    generator = torch.Generator().manual_seed(run.config.seed)
    found = {
        name: Outcome(name, [row for row in rows if "error" not in row], generator)
        for name, rows in tables.items()
    }
    failed = [row for rows in tables.values() for row in rows if "error" in row]
    found = {name: outcome for name, outcome in found.items() if outcome.rows}
    if not found:
        raise DomainError(f"no trade could be worked out: {failed[0]['error']}")
    won = [name for name, outcome in found.items() if outcome.reaches_asked]
    for name, outcome in found.items():
        outcome.record(run)
        run.card(
            TRADES[name].label, outcome.headline(), "at the spot designer's error in the middle of the range"
        )
    run.record(trades_won=len(won), trades=len(found), points_failed=len(failed))
    run.section("The answer", _answer(found, won))
    for name, outcome in found.items():
        run.section(TRADES[name].label[0].upper() + TRADES[name].label[1:])
        run.figure(outcome.figure(), f"pareto_{name}", outcome.caption())
        run.table(
            "Held-out cases, hard sensor",
            [
                TRADES[name].label,
                "RMS spot, spots (px)",
                "RMS spot, flow (px)",
                "error, spots (mrad)",
                "error, flow (mrad)",
                "flow over spots",
                "gain at equal error",
                "95 % of it",
            ],
            outcome.table(),
        )
        _layouts(run, name, outcome)
    run.section(
        "Why",
        "Every lens that was looked at: its flow error on the development cases over its RMS spot, even weights over "
        "field and depth. Where one figure tells the other, whoever makes spots small makes flow true.",
    )
    shared = {name: outcome.explained() for name, outcome in found.items()}
    run.figure(
        _scatter(found),
        "error_over_spot",
        "Flow error relative to the middle of its trade, over the RMS spot of the lens; dots are lenses of the spot "
        "designer, crosses of the flow designer.",
    )
    run.record(**{f"error_variance_explained_by_spot_{name}": share for name, share in shared.items()})
    if failed:
        run.section(
            "What could not be worked out", "\n".join(f"- {r['trade']}: {r['error']}" for r in failed)
        )
    run.finish("Five trades of a lens for event flow", _lead(found, won))


class Outcome:
    """One trade: its rows and what follows from them."""

    def __init__(self, name, rows, generator):
        self.name = name
        self.rows = rows
        self.values = [row["value"] for row in rows]
        if not rows:
            return
        errors = {
            d: torch.tensor([row[d]["held_out"] for row in rows], dtype=torch.float64) for d in DESIGNERS
        }
        self.errors = errors
        self.ratios = [of_differences(e) for e in errors["flow"] - errors["spots"]]
        self.over_textbook = [of_differences(e) for e in errors["flow"] - errors["textbook"]]
        self.declined = sum(
            min(c["development"] for c in row["candidates"]["spots"])
            <= min(c["development"] for c in row["candidates"]["flow"])
            for row in rows
        )
        self.gains = gains(self.values, errors["spots"], errors["flow"], generator, name != "elements")

    @property
    def middle(self):
        return (len(self.rows) - 1) // 2

    @property
    def reaches_asked(self):
        """Whether the gain in the middle of the range is clear and as large as asked."""
        gain = self.gains[self.middle]
        return gain.low > 0 and gain.value >= ASKED.get(self.name, math.log(1.15))

    def headline(self):
        return self.shown(self.gains[self.middle].value)

    def shown(self, gain):
        """A gain in words."""
        if self.name == "elements":
            return f"{gain + 0.0:+.2f} elements fewer"
        if self.name == "aperture":
            return f"{gain / (math.log(2) / 2):+.2f} stops"
        return (
            f"{100 * (math.exp(gain) - 1):+.1f} %"
            if self.name != "track"
            else f"{100 * (1 - math.exp(-gain)):+.1f} %"
        )

    def record(self, run):
        for row, ratio, gain in zip(self.rows, self.ratios, self.gains, strict=True):
            at = f"{self.name}_{row['value']:g}".replace(".", "_")
            run.record(
                **{
                    f"flow_over_spots_percent_{at}": 100 * math.expm1(ratio.mean),
                    f"flow_over_spots_low95_percent_{at}": 100 * math.expm1(ratio.low),
                    f"flow_over_spots_high95_percent_{at}": 100 * math.expm1(ratio.high),
                    f"gain_{at}": gain.value,
                    f"gain_low95_{at}": gain.low,
                    f"gain_high95_{at}": gain.high,
                    **{f"error_mrad_{d}_{at}": _error(row[d]) for d in DESIGNERS},
                    **{f"rms_spot_px_{d}_{at}": row[d]["rms_px"] for d in DESIGNERS},
                }
            )

    def table(self):
        return [
            [
                row["value"],
                row["spots"]["rms_px"],
                row["flow"]["rms_px"],
                _error(row["spots"]),
                _error(row["flow"]),
                ratio.percent(),
                self.shown(gain.value),
                f"{self.shown(gain.low)} to {self.shown(gain.high)}",
            ]
            for row, ratio, gain in zip(self.rows, self.ratios, self.gains, strict=True)
        ]

    def figure(self):
        figure, axis = plt.subplots(figsize=(7, 4))
        for designer in DESIGNERS:
            logs = self.errors[designer]
            axis.plot(
                self.values,
                logs.mean(1).exp(),
                "o-" if designer != "textbook" else "o:",
                color=COLOURS[designer],
                label=LABELS[designer],
            )
        middle = self.errors["spots"].mean(1)
        low, high = (
            torch.tensor([getattr(r, side) for r in self.ratios], dtype=torch.float64)
            for side in ("low", "high")
        )
        axis.fill_between(
            self.values, (middle + low).exp(), (middle + high).exp(), color=COLOURS["flow"], alpha=0.2
        )
        axis.set(
            xlabel=TRADES[self.name].label
            + (f" ({TRADES[self.name].unit})" if TRADES[self.name].unit else ""),
            ylabel="flow error on held-out cases (mrad)",
        )
        axis.set_yscale("log")
        axis.invert_xaxis() if self.values[-1] < self.values[0] else None
        axis.legend(frameon=False)
        return figure

    def caption(self):
        return (
            f"Geometric mean over {self.errors['flow'].shape[1]} held-out cases, hard sensor; loose on the left, tight on "
            "the right. The band is the 95 % interval of the paired difference between the flow designer and the best "
            "spot designer."
        )

    def points(self):
        """(log RMS spot, log error relative to the trade's middle, of the flow designer) of every lens."""
        lenses = [
            (math.log(c["rms_px"]), c["development"] - math.log(PITCH_MM / row["efl_mm"]), group == "flow")
            for row in self.rows
            for group in ("spots", "flow")
            for c in row["candidates"][group]
        ]
        centre = sum(error for _, error, _ in lenses) / len(lenses)
        return [(spot, error - centre, flow) for spot, error, flow in lenses]

    def explained(self):
        """Share of the variance of the log error over lenses that a quadratic in the log spot explains."""
        points = torch.tensor([(spot, error) for spot, error, _ in self.points()], dtype=torch.float64)
        spot, error = points.unbind(1)
        basis = torch.stack([torch.ones_like(spot), spot, spot.square()], 1)
        left = error - basis @ torch.linalg.lstsq(basis, error[:, None]).solution[:, 0]
        return float(1 - left.var() / error.var().clamp_min(1e-12))


def _error(designed):
    held_out = designed["held_out"]
    return math.exp(sum(held_out) / len(held_out))


def _lead(found, won):
    if won:
        return (
            f"The flow designer wins clearly in {len(won)} of {len(found)} trades: "
            + ", ".join(f"{TRADES[n].label} {found[n].headline()}" for n in won)
            + "."
        )
    return (
        f"The best spot designer is not beaten in any of {len(found)} trades by what was asked: "
        "once it is told which weights and which spot the flow needs, the flow objective buys it little."
    )


def _answer(found, won):
    better = sum(r.outcome == "wins" for o in found.values() for r in o.ratios)
    worse = sum(r.outcome == "loses" for o in found.values() for r in o.ratios)
    count = sum(len(o.ratios) for o in found.values())
    over = sum(r.outcome == "wins" for o in found.values() for r in o.over_textbook)
    lines = [
        _lead(found, won),
        f"Of {count} values in all trades the flow designer's lens has the smaller held-out error in {better} (95 % "
        f"interval beyond 0), the best spot designer's in {worse}; the others are ties. Over the least spot at even weights, "
        f"which knows nothing of flow, the flow designer wins in {over}. In "
        f"{sum(o.declined for o in found.values())} of {count} its own development cases would rather keep the spot "
        "designer's lens that it began from.",
        "Gains at the spot designer's error in the middle of each range: "
        + "; ".join(
            f"{TRADES[n].label} {o.headline()} ({o.shown(o.gains[o.middle].low)} to {o.shown(o.gains[o.middle].high)})"
            for n, o in found.items()
        )
        + ".",
        "Asked for was 15 % shorter, one element fewer or one stop faster in two of the five.",
    ]
    return "\n\n".join(lines)


def _layouts(run, name, outcome):
    row = outcome.rows[outcome.middle]
    paths = {d: lens_file(run.folder / "lenses", name, row["at"], d) for d in ("spots", "flow")}
    if not all(path.exists() for path in paths.values()):
        return  # rows taken over from another run's table
    lenses = {LABELS[d]: lens.load(path).freeze() for d, path in paths.items()}
    half = math.radians(next(iter(lenses.values())).half_field_deg)
    run.figure(
        lens_figures.layouts(lenses, (0.0, 0.7 * half, half)),
        f"layout_{name}",
        f"The two designers' lenses at {TRADES[name].label} {row['value']:g}.",
    )


def _scatter(found):
    figure, axis = plt.subplots(figsize=(7, 4.5))
    for k, (name, outcome) in enumerate(found.items()):
        for flow in (False, True):
            points = [(math.exp(s), math.exp(e)) for s, e, f in outcome.points() if f is flow]
            axis.plot(
                *zip(*points, strict=True),
                "x" if flow else "o",
                color=f"C{k}",
                markersize=5 if flow else 3,
                label=None if flow else f"{name} ({100 * outcome.explained():.0f} % explained)",
            )
    axis.set(
        xlabel="RMS spot over field and depth (px)",
        ylabel="flow error over its trade's mean",
        xscale="log",
        yscale="log",
    )
    axis.legend(frameon=False)
    return figure
