"""The page of the study: what was asked and found, tables, and pictures."""

from dataclasses import dataclass
from typing import Any

import torch
from matplotlib.figure import Figure

from codesign import events
from studies.spike_esim import score
from studies.spike_esim.sweeps import Sweeps

TITLES = {"sensor": "physical sensor", "thesis": "thesis network, SLAYER's reset", "own_reset": "thesis network, own reset", "smoothed": "thesis, smoothed, one threshold",
          "second_module": "thesis, smoothed, second module", "esim": "ESIM, best threshold", "ours": "ours", "ours_signal": "ours without noise", "ours_expected": "ours, expected noise",
          "sensor again": "sensor, another draw"}  # fmt: skip
COLOURS = {
    "sensor": "black",
    "thesis": "#cc79a7",
    "smoothed": "#e69f00",
    "esim": "#0072b2",
    "ours": "#d55e00",
}
PICTURED = ("thesis", "smoothed", "esim", "ours")
PICTURE_S = 0.03


@dataclass(frozen=True)
class Results:
    """Everything the page shows. sets: sequences by set. trained: generators by kind of training data. found:
    figures by (set, generator). crossed: (loss, rate ratio) by (training, set, generator). losses: training
    losses by name. met: rows of the goals."""

    sets: dict[str, list]
    trained: dict[str, Any]
    found: dict
    crossed: dict
    losses: dict[str, list]
    sweeps: Sweeps
    met: list


def show(run, results: Results):
    """Cards, sections, report.html."""
    missed = [row for row in results.met if row[-1] == "missed"]
    for kind in results.sets:
        ours, esim, thesis = (results.found[kind, name] for name in ("ours", "esim", "thesis"))
        run.card(
            f"van Rossum loss, {kind.replace('_', ' ')}",
            f"{ours['loss']:.3f}",
            f"ESIM {esim['loss']:.3f}, thesis network {thesis['loss']:.3f}, silence 1",
        )
    run.section("What was asked")
    run.table(
        "Goals",
        ["set", "goal", "found", "limit", "met"],
        results.met,
        "Every figure of ours is of hard events with drawn noise, untouched by the target's noise.",
    )
    _figures_of_merit(run, results)
    _pictures(run, results)
    _sweeps(run, results)
    kept = (
        "all goals met"
        if not missed
        else f"{len(missed)} of {len(results.met)} goals missed: "
        + "; ".join(f"{row[1]} ({row[0]}, {row[2]:.3f})" for row in missed)
    )
    run.finish(
        "Learnt event generators",
        "Spike-ESIM against a physical sensor, the spiking network of the thesis and ESIM with its best "
        f"threshold: {kept}.",
    )


def _figures_of_merit(run, results):
    run.section(
        "Figures",
        "Loss: van Rossum distance, 10 ms, over that of silence. Rates per polarity in bins of 10 ms; cells of 8 x 8 px; flicker: power of the rate above 50 Hz over the "
        "target's. *Sensor, another draw*: the physical sensor itself with other thresholds and noise, the floor of what hard events can reach. Brackets: 95 %, blocks of 16 x 16 px redrawn.",
    )
    for kind in results.sets:
        rows = []
        for (found_kind, name), f in results.found.items():
            if found_kind == kind:
                loss, rate = (
                    f"{f[key]:.3f} ({f[f'{key}_low']:.3f} to {f[f'{key}_high']:.3f})"
                    for key in ("loss", "rate_ratio")
                )
                rows.append((TITLES[name], loss, rate, f["rate_correlation_on"], f["rate_correlation_off"], f["cell_correlation"], f["patch_correlation"], f["flicker_ratio"], 1e3 * f["delay_s"],
                             f["median_rate_ratio"], f["median_rate_correlation"]))  # fmt: skip
        columns = "generator|loss|rate / target|r ON|r OFF|r cells|r patches|flicker|delay, ms|median: rate|median: r"
        run.table(kind.replace("_", " "), columns.split("|"), rows)
    names = dict.fromkeys(name for _, _, name in results.crossed)
    rows = [(source, kind.replace("_", " "), *(f"{results.crossed[source, kind, name][0].value:.3f} · {results.crossed[source, kind, name][1].value:.2f}" for name in names))
            for source in results.trained for kind in results.sets]  # fmt: skip
    run.table(
        "Trained on one, tested on the other: loss · rate over the target's",
        ["trained on", "tested on", *(TITLES[name] for name in names)],
        rows,
    )


def _pictures(run, results):
    run.section("Side by side")
    for kind, sequences in results.sets.items():
        generators = results.trained["recording" if kind == "unseen_half" else "rendered"]
        sequence = sequences[0]
        made = {"sensor": sequence.counts, **{name: generators(name, sequence) for name in PICTURED}}
        title = f"{kind.replace('_', ' ')}, {sequence.name}"
        run.figure(
            _event_pictures(made, sequence, median=False),
            f"{kind}_pictures",
            f"{title}: events of 30 ms. Red ON, blue OFF.",
        )
        run.figure(
            _event_pictures(made, sequence, median=True),
            f"{kind}_median",
            f"{title}: the same of 10 ms behind a 5 x 5 median.",
        )
        run.figure(
            _rates(made, sequence),
            f"{kind}_rates",
            f"{title}: events of the whole picture over time, bins of 10 ms.",
        )
        run.figure(
            _patches(made, sequence, run.config.seed),
            f"{kind}_patches",
            f"{title}: random patches of 8 x 8 pixels, both polarities.",
        )
    figure = Figure(figsize=(7, 3), layout="constrained")
    axis = figure.subplots()
    for name, losses in results.losses.items():
        window = max(1, len(losses) // 12)
        axis.plot(
            torch.tensor(losses).unfold(0, window, 1).mean(-1),
            label={"srm": "rendered, spike response layer"}.get(name, f"{name}, memory layer"),
        )
    axis.set(xlabel="step", ylabel="training loss", yscale="log")
    axis.legend(frameon=False)
    run.figure(
        figure,
        "training",
        "Training of ours, running mean. The two comparators start from the same generator.",
    )


def _sweeps(run, results):
    run.section("Changed conditions", "On two sequences of unseen worlds.")
    found = results.sweeps
    run.table(
        "Thresholds at test time",
        ["factor", "events over those of a noiseless sensor with that factor"],
        found.theta,
    )
    run.table(
        "Noise on the frames",
        ["standard deviation, of 255", "generator", "loss", "rate / target"],
        [(s, TITLES[n], a, b) for s, n, a, b in found.frame_noise],
    )
    run.table(
        "Noise events of the target",
        ["rate, Hz", "generator", "loss", "of another draw"],
        [(s, TITLES[n], a, b) for s, n, a, b in found.shot],
    )
    run.table(
        "Chunks",
        ["frames per chunk", "differing events, ours", "differing spikes, thesis network"],
        found.chunks,
    )


def _event_pictures(made, sequence, median):
    steps = max(1, round(PICTURE_S / sequence.dt_s))
    places = [len(sequence.counts) * k // 4 for k in (1, 2, 3)]
    figure = Figure(
        figsize=(2.2 * len(made), 6.4 * sequence.frames.shape[1] / sequence.frames.shape[2] + 0.6),
        layout="constrained",
    )
    axes = figure.subplots(len(places), len(made))
    for column, (name, counts) in enumerate(made.items()):
        for row, place in enumerate(places):
            some = counts[place : place + steps]
            shown = score.median_filtered(some, sequence.dt_s)[0] if median else some.sum(0)
            axes[row, column].imshow(events.picture(shown, 3.0).numpy())
            axes[row, column].set(xticks=[], yticks=[])
        axes[0, column].set_title(TITLES[name], fontsize=9)
    return figure


def _rates(made, sequence):
    figure = Figure(figsize=(9, 3), layout="constrained")
    for polarity, axis in enumerate(figure.subplots(1, 2, sharey=True)):
        for name, counts in made.items():
            totals = score.binned(counts, sequence.dt_s)[:, polarity, 0, 0] / score.BIN_S / 1e3
            axis.plot(
                1e3 * score.BIN_S * (torch.arange(len(totals)) + 0.5),
                totals,
                color=COLOURS[name],
                lw=2 if name == "sensor" else 1.2,
                label=TITLES[name],
            )
        axis.set(xlabel="time, ms", title=("ON", "OFF")[polarity])
    figure.axes[0].set_ylabel("thousand events per second")
    figure.axes[1].legend(frameon=False, fontsize=8)
    return figure


def _patches(made, sequence, seed):
    cells = {
        name: score.binned(counts, sequence.dt_s, score.CELL_PX).sum(1).flatten(1)
        for name, counts in made.items()
    }
    busy = (cells["sensor"].sum(0) > 0).nonzero()[:, 0]
    chosen = busy[torch.randperm(len(busy), generator=torch.Generator().manual_seed(seed))[:6]]
    figure = Figure(figsize=(9, 4), layout="constrained")
    for axis, place in zip(figure.subplots(2, 3, sharex=True).flat, chosen.tolist(), strict=False):
        for name, counts in cells.items():
            axis.plot(
                1e3 * score.BIN_S * (torch.arange(len(counts)) + 0.5),
                counts[:, place],
                color=COLOURS[name],
                lw=1.8 if name == "sensor" else 1,
            )
    figure.supxlabel("time, ms")
    figure.supylabel("events per 10 ms")
    return figure
