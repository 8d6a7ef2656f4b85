"""Figures of the DAVIS study: signed-count maps, event rates, scatter, rate ratios, and the cost of
timing."""

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.colors import LogNorm

from codesign import events
from studies.davis_fit.compare import LABELS
from studies.davis_fit.score import pooled, signed

FULL_SCALE = 8  # signed count of full colour
BIN_S = 5e-3
COLOURS = {
    "naive": "#8c564b",
    "naive_fitted": "#e377c2",
    "unfitted": "#ff7f0e",
    "fitted": "#17becf",
    "fitted_moved": "#1f77b4",
}


def maps(recorded, simulated, names, intervals, labels):
    """Signed counts side by side. recorded: [T-1, 2, H, W]; simulated: such counts by name; intervals:
    numbers; labels: one per interval."""
    columns = {"recorded": recorded, **{LABELS[name]: simulated[name] for name in names}}
    busy = recorded[intervals].sum((0, 1, 3))
    rows = (busy.cumsum(0) / busy.sum() > 0.01) & (
        busy.cumsum(0) / busy.sum() < 0.99
    )  # rows that hold 98 % of the events
    top = int(rows.nonzero()[0])
    bottom = int(rows.nonzero()[-1]) + 1
    height = 3.6 * (bottom - top) / recorded.shape[-1] + 0.1
    figure, axes = plt.subplots(
        len(intervals),
        len(columns),
        figsize=(3.6 * len(columns), height * len(intervals) + 0.4),
        squeeze=False,
        layout="compressed",
    )
    for k, (row, interval, label) in enumerate(zip(axes, intervals, labels, strict=True)):
        for axis, (title, counts) in zip(row, columns.items(), strict=True):
            shown = axis.imshow(
                signed(counts)[interval, top:bottom].numpy(),
                cmap="RdBu_r",
                vmin=-FULL_SCALE,
                vmax=FULL_SCALE,
                interpolation="nearest",
            )
            axis.set_xticks([])
            axis.set_yticks([])
            if k == 0:
                axis.set_title(title, fontsize=10)
        row[0].set_ylabel(label, fontsize=9)
    figure.colorbar(shown, ax=axes, shrink=0.7, pad=0.01, label="ON − OFF")
    return figure


def rates(recording, folds, clips, sensors, simulated):
    """Event rates over time per polarity: recorded, fitted (each half with the parameters of the other),
    unfitted and naive."""
    best = "moved" if "moved" in clips else "frames"
    clip = clips[best]
    start_s = float(recording.mid_s[0])
    t_s = start_s + torch.arange(len(clip.sharp), dtype=torch.float64) * clip.step_s
    figure, axes = plt.subplots(2, 1, figsize=(10, 6), sharex=True, layout="constrained")
    for fold in folds:
        sensor = sensors[fold.judged][best]
        names = simulated[fold.judged]
        edges = _edges(recording, fold)
        with torch.no_grad():
            levels = sensor.levels(clip)
            noise = sensor.noise(clip)[fold.test].sum((2, 3)) / (clip.step_s * clip.per_interval)
            now = {name: float(value) for name, value in sensor.values().items()}
        model = events.SensorModel(now["theta_on"], now["theta_off"])
        fitted = events.rates(
            events.to_counts(events.simulate(levels.double(), t_s, model, log_input=True), edges), edges
        )[1]
        middle_s, recorded = events.rates(events.to_counts(recording.stream, edges), edges)
        interval = (torch.searchsorted(recording.mid_s, middle_s) - 1 - fold.test.start).clamp(
            0, len(noise) - 1
        )
        for polarity, axis in enumerate(axes):
            named = fold is folds[0]  # one entry in the legend for both halves
            axis.plot(
                1e3 * middle_s,
                recorded[:, polarity] / 1e3,
                color="black",
                lw=2,
                label="recorded" if named else None,
            )
            model_name = "fitted_moved" if best == "moved" else "fitted"
            rate = fitted[:, polarity] + noise[interval, polarity]
            axis.plot(
                1e3 * middle_s,
                rate / 1e3,
                color=COLOURS[model_name],
                lw=1.5,
                label=LABELS[model_name] if named else None,
            )
            steps = recording.mid_s[fold.test.start : fold.test.stop + 1]
            for name in ("unfitted", "naive_fitted", "naive"):
                rate = events.rates(names[name][fold.test], steps)[1][:, polarity]
                axis.stairs(
                    (rate / 1e3).numpy(),
                    (1e3 * steps).numpy(),
                    baseline=None,
                    color=COLOURS[name],
                    lw=1.2,
                    label=LABELS[name] if named else None,
                )
    for axis, name in zip(axes, ("ON", "OFF"), strict=True):
        for mid_s in recording.mid_s.tolist():
            axis.axvspan(
                1e3 * (mid_s - recording.exposure_s / 2),
                1e3 * (mid_s + recording.exposure_s / 2),
                color="0.93",
                zorder=0,
            )
        axis.axvline(1e3 * float(recording.mid_s[folds[0].test.start]), color="0.3", lw=0.8, ls="--")
        axis.set(ylabel=f"{name}, thousand events / s", ylim=(0, None))
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(frameon=False, fontsize=8, ncols=5, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    axes[1].set_xlabel("time, ms (grey: shutter open; dashed: where the halves meet)")
    return figure


def scatter(recorded, simulated, names, fold, side_px):
    """Simulated over recorded signed counts, summed over squares of pixels, as densities on a logarithmic
    scale."""
    figure, axes = plt.subplots(
        1, len(names), figsize=(3.9 * len(names), 4.1), sharex=True, sharey=True, layout="constrained"
    )
    truth = pooled(signed(recorded[fold.test]), side_px).flatten().numpy()
    top = float(np.quantile(np.abs(truth), 0.9995))
    grid = np.linspace(-top, top, 90)
    for axis, name in zip(axes, names, strict=True):
        found = pooled(signed(simulated[name][fold.test]), side_px).flatten().numpy()
        density, _, _ = np.histogram2d(truth, found.clip(-top, top), bins=(grid, grid))
        shown = axis.pcolormesh(grid, grid, density.T, norm=LogNorm(1, 1e4), cmap="viridis")
        axis.plot([-top, top], [-top, top], color="crimson", lw=1)
        axis.set(title=LABELS[name], xlabel="recorded ON − OFF", aspect="equal")
    axes[0].set_ylabel("simulated ON − OFF")
    figure.colorbar(shown, ax=axes, shrink=0.8, pad=0.01, label="squares")
    return figure


def ratios(folds, figures, names):
    """Simulated over recorded events per interval, judged intervals of both halves."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.8), sharey=True, layout="constrained")
    for name in names:
        at = [k for fold in folds for k in range(fold.test.start, fold.test.stop)]
        values = torch.cat([figures[fold.judged][name].ratio_by_interval for fold in folds])
        order = np.argsort(at)
        for polarity, axis in enumerate(axes):
            axis.plot(
                np.array(at)[order],
                values[:, polarity].numpy()[order],
                "o-",
                ms=4,
                lw=1.2,
                color=COLOURS[name],
                label=LABELS[name],
            )
    for axis, title in zip(axes, ("ON", "OFF"), strict=True):
        axis.axhline(1, color="black", lw=1)
        axis.set(yscale="log", title=title, xlabel="interval between frames", yticks=[0.2, 0.5, 1, 2, 4])
        axis.set_yticklabels(["0.2", "0.5", "1", "2", "4"])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("simulated / recorded events")
    figure.legend(
        *axes[0].get_legend_handles_labels(),
        loc="outside upper center",
        ncols=len(names),
        frameon=False,
        fontsize=8,
    )
    return figure


def offsets(offsets_s, curves, folds):
    """Correlation at 1 px over the offset of the recorded events' times."""
    figure, axes = plt.subplots(1, len(folds), figsize=(10, 3.6), sharey=True, layout="constrained")
    for axis, fold in zip(axes, folds, strict=True):
        for (name, judged), curve in curves.items():
            if judged == fold.judged:
                label, colour = (
                    (LABELS[name], COLOURS[name])
                    if name in LABELS
                    else ("the recording against itself", "black")
                )
                axis.plot(
                    [1e3 * offset_s for offset_s in offsets_s], curve, "o-", ms=3.5, label=label, color=colour
                )
        axis.set(title=f"{fold.judged} half", xlabel="recorded times moved by, ms")
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("correlation of signed counts, 1 px")
    axes[0].legend(frameon=False, fontsize=8)
    return figure


def _edges(recording, fold):
    """Bin edges of about BIN_S over the judged half."""
    start_s = float(recording.mid_s[fold.test.start])
    end_s = float(recording.mid_s[fold.test.stop])
    return torch.linspace(start_s, end_s, max(1, round((end_s - start_s) / BIN_S)) + 1, dtype=torch.float64)
