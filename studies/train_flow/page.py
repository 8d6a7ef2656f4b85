"""The page of a training run: figures against the closed form, curves, and flows seen beside their truth."""

import matplotlib.pyplot as plt
import numpy as np
import torch

from codesign import flow
from codesign.report.flow_colours import flow_colours
from codesign.train.batches import to_device

OURS = "#1b6ca8"
CLOSED = "firebrick"


def show(run, config, job, scores):
    """Cards, table, figures and text of a finished run."""
    progress = job.progress
    cpu = (progress.data_s + progress.training_s) / 60
    for name, (ours, closed) in scores.items():
        run.card(
            f"{'error' if ours.blur is None else 'blur'} over zero flow's, {name.replace('_', ' ')}",
            f"{ours.ratio:.3f}",
            f"closed form {closed.ratio:.3f}; worse than zero flow on {ours.worse_percent:.1f} %",
        )
    run.section(
        "On windows never trained on",
        "Error: mean endpoint error over valid pixels. Worse: windows whose own mean error is above that of "
        "zero flow. Windows without any true flow are judged by the blur of their warped events over that of zero flow.",
    )
    rows = [
        (
            name,
            ours.aee_px,
            closed.aee_px,
            ours.zero_flow_px,
            ours.ratio,
            closed.ratio,
            ours.worse_percent,
            closed.worse_percent,
            ours.windows,
        )
        for name, (ours, closed) in scores.items()
    ]
    columns = (
        "set",
        "error px",
        "closed form px",
        "zero flow px",
        "ratio",
        "closed form ratio",
        "worse %",
        "closed form worse %",
        "windows",
    )
    run.table("Errors", columns, rows)
    run.section(
        "Training",
        f"{progress.step} steps of {config.batch} windows. Processor time: {progress.data_s / 60:.2f} min "
        f"making windows, {progress.training_s / 60:.2f} min training, "
        f"{progress.validation_s / 60:.2f} min validation (not part of the budget). Gradients shortened in "
        f"{progress.clipped} of {progress.step} steps.",
    )
    run.figure(curves(progress), "curves", "Loss, gradient norm and validation by step. Dashed: closed form.")
    run.figure(
        pictures(job, scores),
        "flows",
        "One window of each set: events (ON less OFF), true flow, closed form, network. Hue: direction; "
        "white: no flow; grey: no truth.",
    )
    run.finish(
        f"Training of {config.network}",
        f"{cpu:.1f} processor minutes, seed {config.seed}, loss {config.loss}.",
    )


def curves(progress):
    """Figure of loss, gradient norm and validation."""
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.4), layout="constrained")
    steps = np.arange(1, progress.step + 1)
    for axis, values, label in ((axes[0], progress.loss, "loss"), (axes[1], progress.norm, "gradient norm")):
        axis.plot(steps, values, color=OURS, linewidth=0.5, alpha=0.4)
        width = max(1, min(50, len(values) // 5))
        axis.plot(steps[width - 1 :], np.convolve(values, np.ones(width) / width, "valid"), color=OURS)
        axis.set(xlabel="step", ylabel=label, yscale="log")
    names = [name for name in (progress.validation[-1] if progress.validation else {}) if name != "step"]
    for name, colour in zip(names, plt.rcParams["axes.prop_cycle"].by_key()["color"] * 4, strict=False):
        found = [
            (entry["step"], entry[name]["ratio"], entry[name]["closed_form_ratio"])
            for entry in progress.validation
            if name in entry
        ]
        at, ratio, closed = zip(*found, strict=True)
        axes[2].plot(at, ratio, ".-", color=colour, label=name)
        axes[2].plot(at, closed, "--", color=colour, linewidth=0.8)
    axes[2].set(xlabel="step", ylabel="error over zero flow's", ylim=(0, None))
    if names:
        axes[2].legend(fontsize=7)
    return figure


@torch.no_grad()
def pictures(job, scores):
    """Figure: one window of each set, in rows."""
    network = job.learner.delivered.eval()
    device = next(network.parameters()).device
    figure, axes = plt.subplots(
        len(scores), 4, figsize=(9, 2.3 * len(scores)), layout="constrained", squeeze=False
    )
    for row, name in zip(axes, scores, strict=True):
        windows = job.validation[name].batch([0])
        counts = windows.volume.counts[0]
        truth = windows.truth
        longest = max(
            float(truth.flow_px.square().sum(1).sqrt()[truth.valid].max())
            if bool(truth.valid.any())
            else 1.0,
            1e-6,
        )
        row[0].imshow((counts[0] - counts[1]).sum(0).clamp(-3, 3).numpy(), cmap="RdBu", vmin=-3, vmax=3)
        estimates = (
            truth.flow_px,
            flow.estimate_lk(windows.volume).flow_px,
            network(to_device(windows, device).volume).flow_px.float().cpu(),
        )
        for axis, field, valid in zip(row[1:], estimates, (truth.valid[0], None, None), strict=True):
            picture = flow_colours(field[0].numpy(), longest)
            axis.imshow(picture if valid is None else np.where(valid.numpy()[..., None], picture, 0.6))
        for axis, title in zip(
            row, (name, f"truth, up to {longest:.1f} px", "closed form", "network"), strict=True
        ):
            axis.set_title(title, fontsize=8)
            axis.axis("off")
    return figure
